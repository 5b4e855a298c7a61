"""Evidence of single beams, ray by ray: of lidars, whose neighbours are far apart, and of points without order.

    hits      voxels of the end points
    misses    voxels that a beam passes up to where it is certainly clear, except the voxel where it ends

Each voxel gets one count at most, and a hit wins over a miss, so the result depends neither on the order of the rays
nor on the number of pixels that a voxel fills. One ray is cast per end voxel (the first that ends there): the others
would pass through nearly the same voxels again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_fusion.mapping.beam_returns import Returns, margins_m
from cairn_fusion.mapping.cast_kernels import (
    END,
    HIT,
    Marks,
    carry_into,
    clear_ends_into,
    count_seen_into,
    mark_ends_into,
    mark_misses_into,
    pack_seen_into,
)
from cairn_map.arrays import Floats, Ints, Words32
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import BRICK_DEPTH, CELL_LIMIT, CellKey, Geometry, split_voxels, voxels_of_points
from cairn_map.kernels.morton_kernels import UInts, interleave

Sums = Callable[[Ints, int], Ints]
"""From the number of each point's voxel (N,) and the count of voxels to (count, P) sums of samples."""

BOX_BRICKS_MAX = 1 << 27
"""Bricks in the box around one scan: 512 MB of index. 40 m at 1 cm."""


@dataclass(frozen=True, slots=True)
class SeenBricks:
    """Bricks that one scan touched, in order of cell and of number in the cell, with a mark for each voxel."""

    cells: UInts
    """(B,) cell of each brick."""
    numbers: Words32
    """(B,) Morton number of each within its cell."""
    slots: Ints
    """(B,) its row of `marks`."""
    marks: Marks
    """(M, 512) bits `MISS` and `HIT` of the voxels; a hit wins."""

    def evidence(self, samples: "Samples | None", geometry: Geometry) -> dict[CellKey, Evidence]:
        """Hits, misses and samples by cell."""
        # How many voxels of each brick are known, and so where those of each begin.
        known = np.empty(len(self.slots), np.int64)
        count_seen_into(self.slots, self.marks, known)
        # One array for all cells: fresh pages cost more than everything that is written to them.
        ends = np.concatenate([[0], np.cumsum(known)])
        places, counts = np.empty(int(ends[-1]), np.uint32), np.empty((int(ends[-1]), 2), np.int32)
        pack_seen_into(self.slots, self.numbers, self.marks, places, counts)
        found: dict[CellKey, Evidence] = {}
        cells, first = np.unique(self.cells, return_index=True)
        # Bricks are in order of their cells, so a cell is one slice of all.
        bounds = ends[np.append(first, len(self.cells))].tolist()
        no_rows, none_sampled = np.empty((0, geometry.plane_count), np.int64), np.empty(0, np.uint32)
        for cell, start, stop in zip(cells, bounds[:-1], bounds[1:], strict=True):
            if start == stop:
                continue
            sampled, rows = none_sampled, no_rows
            if samples is not None:
                # A cell's hits, and its rows of samples, are of the same voxels in the same order.
                rows = samples.of(cell)
                some = (rows != 0).any(axis=1)
                sampled, rows = np.flatnonzero(counts[start:stop, 0])[some].astype(np.uint32), rows[some]
            found[CellKey(int(cell))] = Evidence(places[start:stop], counts[start:stop], sampled, rows)
        return found


class Samples:
    """Sums of samples of the voxels that a scan hit, by cell, rising in place."""

    def __init__(self, voxels: Ints, sums: Ints, geometry: Geometry) -> None:
        """Args: voxels: (U, 3) numbers, all different. sums: (U, P) of them."""
        cells, places = split_voxels(voxels, geometry)
        order = np.lexsort((places, cells))
        self._cells, self._sums = cells[order], sums[order]

    def of(self, cell: np.uint64) -> Ints:
        """(U, P) sums of the voxels in a cell."""
        return self._sums[slice(*np.searchsorted(self._cells, [cell, cell + np.uint64(1)]))]


def seen_bricks(origin_m: Floats, hits: Ints, clear_m: Floats, geometry: Geometry) -> SeenBricks:
    """Bricks whose voxels rays from one origin hit or passed.

    Args:
        origin_m: (3,) metres, map frame.
        hits: (M, 3) voxels that were hit; any may come several times.
        clear_m: (N, 3) metres, map frame: ends of the rays. Of those that end in one voxel the first is cast. A ray
            counts nothing in the voxel where it ends: if none was hit there, it is clear only so far.
        geometry: of the map.

    Raises:
        BadInputError: the scan reaches beyond the numbered space, or spans more bricks than fit in memory; limit the
            range or coarsen the map.
    """
    # Stage 1: the box of bricks around all rays and hits.
    start, ends = voxels_of_points(origin_m, geometry), voxels_of_points(clear_m, geometry)
    reached = [each for each in (ends, hits, start) if len(each)]
    low = np.min([each.min(axis=0) for each in reached], axis=0) >> BRICK_DEPTH
    high = np.max([each.max(axis=0) for each in reached], axis=0) >> BRICK_DEPTH
    dims = high - low + 1
    if float(np.prod(dims.astype(np.float64))) > BOX_BRICKS_MAX:
        size_m = dims * 8 * geometry.voxel_edge_m
        raise BadInputError(
            "scan_too_large",
            f"one scan spans {size_m.round(1).tolist()} m, too much at {geometry.voxel_edge_m} m voxels; "
            "limit its range or use a coarser map",
        )
    # Stage 2: a dense index of the box's bricks, and a pool of marks for those that are touched.
    corner = low << BRICK_DEPTH
    brick_of = np.full(int(np.prod(dims)), -1, np.int32)
    bricks = np.empty(min(len(brick_of), len(hits) + len(ends)) + 1024, np.int64)
    marks = np.empty((len(bricks), 512), np.uint8)
    firsts = np.empty(max(len(hits), len(ends)), np.int64)
    # Stage 3: voxels that were hit, and one ray for each voxel in which clear parts end.
    used, _ = mark_ends_into(hits - corner, HIT, dims, brick_of, bricks, marks, 0, firsts)
    box_ends = ends - corner
    used, count = mark_ends_into(box_ends, END, dims, brick_of, bricks, marks, used, firsts)
    # Stage 4: the rays, with a larger pool whenever one might not fit.
    origin = _inside(origin_m, start[0], geometry) - corner
    targets, rays = clear_m / geometry.voxel_edge_m - corner, firsts[:count]
    ray = 0
    while ray < count:
        ray, used = mark_misses_into(origin, targets, box_ends, rays, ray, dims, brick_of, bricks, marks, used)
        if ray < count:
            room = len(bricks) + max(len(bricks) // 2, int(dims.sum()) + 1)
            bricks, marks = np.resize(bricks, room), _with_room(marks, room, used)
    return _in_order(bricks[:used], marks, dims, low, geometry)


def _inside(origin_m: Floats, start: Ints, geometry: Geometry) -> Floats:
    """The origin in voxels, moved by rounding at most, so that its floor is its voxel by the grid's own rule."""
    exact = np.asarray(origin_m, dtype=np.float64) / geometry.voxel_edge_m
    inside: Floats = np.clip(exact, start, np.nextafter(start + 1.0, start))
    return inside


def _with_room(marks: Marks, room: int, used: int) -> Marks:
    grown = np.empty((room, 512), np.uint8)
    grown[:used] = marks[:used]
    return grown


def _in_order(bricks: Ints, marks: Marks, dims: Ints, low: Ints, geometry: Geometry) -> SeenBricks:
    # Coordinates of the bricks; then their order by cell and Morton number.
    xyz = np.stack([bricks % dims[0], bricks // dims[0] % dims[1], bricks // (dims[0] * dims[1])], axis=1) + low
    up = geometry.depth - BRICK_DEPTH
    cells = interleave((xyz >> up) + CELL_LIMIT)
    numbers = interleave(xyz & ((1 << up) - 1)).astype(np.uint32)
    order = np.lexsort((numbers, cells))
    return SeenBricks(cells[order], numbers[order], order, marks)


def clear_ends(
    origin_m: Floats, points_map: Floats, sigma_m: Floats, *, voxel_edge_m: float, noise_sigmas: float
) -> Floats:
    """(M, 3) ends of the clear part of beams to (N, 3) points, metres; without beams that are not clear at all."""
    margin_m = margins_m(sigma_m, voxel_edge_m=voxel_edge_m, noise_sigmas=noise_sigmas)
    ends = np.empty(points_map.shape)
    return ends[: clear_ends_into(origin_m, points_map, margin_m.astype(np.float64), ends)]


def carried(points: Floats, T_map_sensor: Transform) -> Floats:
    """(N, 3) points of a sensor, in the map's frame."""
    out = np.empty(points.shape)
    carry_into(points, T_map_sensor, out)
    return out


def silent_ends(returns: Returns, rays: Floats) -> Floats:
    """(M, 3) ends of the clear part of silent beams, metres, where silence means empty space."""
    T = returns.T_map_tof
    beams = rays[returns.silent] @ T[:3, :3].T
    beams = beams[~np.isnan(beams[:, 0])]
    return np.asarray(T[:3, 3] + returns.silent_m * beams)


def beam_evidence(
    origin_m: Floats, points_map: Floats, clear_m: Floats, geometry: Geometry, *, sums_of: Sums | None
) -> dict[CellKey, Evidence]:
    """The evidence of beams from one place, by cell.

    Args:
        origin_m: (3,) metres, map frame.
        points_map: (N, 3) their ends, metres.
        clear_m: (M, 3) ends of their clear parts, metres.
        geometry: of the map.
        sums_of: samples of the voxels that were hit; None: there are none.

    Raises:
        BadInputError: they reach beyond the numbered space, or span more than fits in memory.
    """
    # Voxels need numbers only where there are samples to be summed up for each.
    hits = voxels_of_points(points_map, geometry)
    seen = seen_bricks(origin_m, hits, clear_m, geometry)
    if sums_of is None or not geometry.plane_count:
        return seen.evidence(None, geometry)
    different, voxel_of = unique_voxels(hits)
    sums = sums_of(voxel_of, len(different))
    return seen.evidence(Samples(different, sums, geometry) if sums.any() else None, geometry)


def unique_voxels(voxels: Ints) -> tuple[Ints, Ints]:
    """Different voxels (U, 3), and the number of each point's voxel (N,)."""
    if not len(voxels):
        return voxels, np.empty(0, np.int64)
    # One number a voxel, by its place in the box of all of them.
    low = voxels.min(axis=0)
    span = voxels.max(axis=0) - low + 1
    shifted = voxels - low
    flat = (shifted[:, 2] * span[1] + shifted[:, 1]) * span[0] + shifted[:, 0]
    _, first, voxel_of = np.unique(flat, return_index=True, return_inverse=True)
    return voxels[first], voxel_of
