"""Evidence of single beams, ray by ray: of lidars, whose neighbours are far apart, and of points without order.

points   hits, one count a voxel
clear    where each beam is certainly free so far: misses on the way there, but for the voxel where it ends
"""

from collections.abc import Callable

import numpy as np

from cairn_fusion.mapping.beam_returns import Returns
from cairn_fusion.mapping.clear_range import margins_m
from cairn_fusion.mapping.ray_casting import SeenVoxels, seen_voxels
from cairn_map.arrays import Floats, Ints
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels, voxels_of_points

Sums = Callable[[Ints, int], Ints]
"""From the number of each point's voxel (N,) and the count of voxels to (count, P) sums of samples."""


def clear_ends(
    origin_m: Floats, points_map: Floats, sigma_m: Floats, *, voxel_edge_m: float, noise_sigmas: float
) -> Floats:
    """(M, 3) how far the beams to (N, 3) points are certainly clear; without those that are not clear at all."""
    beams = points_map - origin_m
    range_m = np.linalg.norm(beams, axis=1)
    left_m = range_m - margins_m(sigma_m, voxel_edge_m=voxel_edge_m, noise_sigmas=noise_sigmas)
    some = left_m > 0
    return np.asarray(origin_m + beams[some] * (left_m[some] / range_m[some])[:, None])


def silent_ends(returns: Returns, rays: Floats) -> Floats:
    """(M, 3) how far the beams are clear to which nothing came back, where that means something."""
    T = returns.T_map_tof
    beams = rays[returns.silent] @ T[:3, :3].T
    beams = beams[~np.isnan(beams[:, 0])]
    return np.asarray(T[:3, 3] + returns.silent_m * beams)


def beam_evidence(
    origin_m: Floats, points_map: Floats, clear_m: Floats, geometry: Geometry, *, sums_of: Sums
) -> dict[CellKey, Evidence]:
    """The evidence of beams from one place, by cell.

    Args:
        origin_m: (3,) metres, map frame.
        points_map: (N, 3) where they ended.
        clear_m: (M, 3) up to where they are clear.
        geometry: of the map.
        sums_of: what else is known of the voxels that were hit.

    Raises:
        BadInputError: they reach beyond the numbered space, or span more than fits in memory.
    """
    hits, _, voxel_of = unique_voxels(voxels_of_points(points_map, geometry))
    targets, first, _ = unique_voxels(voxels_of_points(clear_m, geometry))
    seen = seen_voxels(origin_m, clear_m[first], targets, geometry, hits=hits)
    return _packed_by_cell(seen, hits, sums_of(voxel_of, len(hits)), geometry)


def unique_voxels(voxels: Ints) -> tuple[Ints, Ints, Ints]:
    """Different voxels (U, 3), the first point in each (U,), and the number of each point's voxel (N,)."""
    if not len(voxels):
        return voxels, np.empty(0, np.int64), np.empty(0, np.int64)
    low = voxels.min(axis=0)
    span = voxels.max(axis=0) - low + 1
    shifted = voxels - low
    flat = (shifted[:, 2] * span[1] + shifted[:, 1]) * span[0] + shifted[:, 0]
    _, first, voxel_of = np.unique(flat, return_index=True, return_inverse=True)
    return voxels[first], first, voxel_of


def _packed_by_cell(seen: SeenVoxels, ends: Ints, samples: Ints, geometry: Geometry) -> dict[CellKey, Evidence]:
    end_cells, end_places = split_voxels(ends, geometry)
    order = np.lexsort((end_places, end_cells))
    end_cells, end_places, samples = end_cells[order], end_places[order], samples[order]
    cells, starts = np.unique(seen.cells, return_index=True)
    bounds = np.append(starts, len(seen.cells))
    packed: dict[CellKey, Evidence] = {}
    for cell, start, stop in zip(cells, bounds[:-1], bounds[1:], strict=True):
        hit = seen.hit[start:stop]
        mine = slice(*np.searchsorted(end_cells, [cell, cell + np.uint64(1)]))
        full = np.zeros((stop - start, geometry.plane_count), np.int64)
        # Hits and end points of a cell are the same voxels in the same order.
        full[hit] = samples[mine]
        counts = np.stack([hit, ~hit], axis=1).astype(np.int32)
        packed[CellKey(int(cell))] = packed_evidence(seen.places[start:stop], counts, full, geometry)
    return packed
