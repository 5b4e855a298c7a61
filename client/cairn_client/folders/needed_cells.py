"""Cells of a server's map that a question needs: others are not downloaded.

    points, nearest voxels    cells within the radius
    a ray                     cells that it passes through, as far as it is asked about

Each test is generous by a voxel, so that no rounding leaves a cell out: one more changes no answer.
"""

from collections.abc import Callable, Sequence

import numpy as np

from cairn_map.arrays import Flags, Floats
from cairn_map.evidence.grid import CellKey, Geometry, cells_of_keys

Needs = Callable[[Floats, Floats], Flags]
"""Test of cells, (N, 3) lowest and highest corners, metres: (N,) True for those that a question needs."""


def near_points(points: Sequence[Sequence[float]], *, radius_m: float = 0.0) -> Needs:
    """Cells within a radius of any of the points, metres, map frame."""
    places = np.asarray(points, np.float64)

    def are_near(low: Floats, high: Floats) -> Flags:
        found = np.zeros(len(low), np.bool_)
        for place in places:
            gaps = np.maximum(np.maximum(low - place, place - high), 0.0)
            found |= np.linalg.norm(gaps, axis=1) <= radius_m
        return found

    return are_near


def along_ray(origin: Sequence[float], direction: Sequence[float], *, range_m: float) -> Needs:
    """Cells that a ray passes through; of a direction of no length all, so that the query refuses it."""
    start, way = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    length = float(np.linalg.norm(way))

    def are_crossed(low: Floats, high: Floats) -> Flags:
        if not length > 0:
            return np.ones(len(low), np.bool_)
        # Along each axis the ray is between two planes from one distance to another: within a cell where all overlap.
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (low - start) / (way / length), (high - start) / (way / length)
        # Parallel to both planes it is always between them, or never.
        is_between = (low <= start) & (start <= high)
        enters = np.where(way == 0, np.where(is_between, -np.inf, np.inf), np.minimum(first, second))
        leaves = np.where(way == 0, np.where(is_between, np.inf, -np.inf), np.maximum(first, second))
        begin, end = np.maximum(enters.max(axis=1), 0.0), np.minimum(leaves.min(axis=1), range_m)
        return np.asarray(begin <= end)

    return are_crossed


def needed_cells(keys: Sequence[CellKey], needs: Needs, geometry: Geometry) -> list[CellKey]:
    """Those of the cells that a question needs, in their order."""
    edges_m = np.array(geometry.cell_edges_m)
    low_m = cells_of_keys(np.array(keys, np.uint64)).astype(np.float64) * edges_m
    margin_m = geometry.voxel_edge_m
    are_needed = needs(low_m - np.float64(margin_m), low_m + (edges_m + margin_m))
    return [key for key, is_needed in zip(keys, are_needed.tolist(), strict=True) if is_needed]
