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
import numpy.typing as npt

from cairn_fusion.mapping.beam_returns import Returns, margins_m
from cairn_fusion.mapping.cast_kernels import HIT, mark_hits_into, mark_misses_into
from cairn_map.arrays import Floats, Ints
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import BRICK_DEPTH, CELL_LIMIT, CellKey, Geometry, split_voxels, voxels_of_points
from cairn_map.kernels.morton_kernels import interleave

Sums = Callable[[Ints, int], Ints]
"""From the number of each point's voxel (N,) and the count of voxels to (count, P) sums of samples."""

BOX_BRICKS_MAX = 1 << 27
"""Bricks in the box around one scan: 512 MB of index. 40 m at 1 cm."""


@dataclass(frozen=True, slots=True)
class SeenVoxels:
    """Hits and misses of one scan, by cell, ready to be packed.

    cells (N,) uint64 cell numbers, rising; places (N,) uint32 Morton codes, rising inside a cell; hit (N,) bool.
    """

    cells: npt.NDArray[np.uint64]
    places: npt.NDArray[np.uint32]
    hit: npt.NDArray[np.bool_]


def seen_voxels(
    origin_m: Floats, ends_m: Floats, ends: Ints, geometry: Geometry, *, hits: Ints | None = None
) -> SeenVoxels:
    """Voxels that rays from one origin hit or passed.

    Args:
        origin_m: (3,) metres, map frame.
        ends_m: (N, 3) metres, map frame: one end point in each voxel of `ends`.
        ends: (N, 3) voxel numbers, all different.
        geometry: of the map.
        hits: (M, 3) voxels that were hit, all different; None: those where the rays end. A ray that ends in a voxel
            which was not hit, because it is clear only so far, counts nothing in that voxel.

    Raises:
        BadInputError: the scan spans more bricks than fit in memory; limit the range or coarsen the map.
    """
    # Stage 1: the box of bricks around all rays and hits.
    start = voxels_of_points(origin_m, geometry)
    struck = ends if hits is None else hits
    reached = np.concatenate([ends, struck, start])
    low, high = reached.min(axis=0) >> BRICK_DEPTH, reached.max(axis=0) >> BRICK_DEPTH
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
    bricks = np.empty(len(struck) + 1024, np.int64)
    marks = np.empty((len(bricks), 512), np.uint8)
    box_ends = ends - corner
    origin = _inside(origin_m, start[0], geometry) - corner
    targets = ends_m / geometry.voxel_edge_m - corner
    # Stage 3: hits first, since they win over misses; then rays, with a larger pool whenever one might not fit.
    used = mark_hits_into(struck - corner, dims, brick_of, bricks, marks, 0)
    ray = 0
    while ray < len(ends):
        ray, used = mark_misses_into(origin, targets, box_ends, ray, dims, brick_of, bricks, marks, used)
        if ray < len(ends):
            room = len(bricks) + max(len(bricks) // 2, int(dims.sum()) + 1)
            bricks, marks = np.resize(bricks, room), _with_room(marks, room, used)
    return _by_cell(bricks[:used], marks[:used], dims, low, geometry)


def _inside(origin_m: Floats, start: Ints, geometry: Geometry) -> Floats:
    """The origin in voxels, moved by rounding at most, so that its floor is its voxel by the grid's own rule."""
    exact = np.asarray(origin_m, dtype=np.float64) / geometry.voxel_edge_m
    inside: Floats = np.clip(exact, start, np.nextafter(start + 1.0, start))
    return inside


def _with_room(marks: npt.NDArray[np.uint8], room: int, used: int) -> npt.NDArray[np.uint8]:
    grown = np.empty((room, 512), np.uint8)
    grown[:used] = marks[:used]
    return grown


def _by_cell(bricks: Ints, marks: npt.NDArray[np.uint8], dims: Ints, low: Ints, geometry: Geometry) -> SeenVoxels:
    # Coordinates of the bricks; then marks in order of cell and Morton place.
    xyz = np.stack([bricks % dims[0], bricks // dims[0] % dims[1], bricks // (dims[0] * dims[1])], axis=1) + low
    up = geometry.depth - BRICK_DEPTH
    cells = interleave((xyz >> up) + CELL_LIMIT)
    numbers = interleave(xyz & ((1 << up) - 1)).astype(np.uint32)
    order = np.lexsort((numbers, cells))
    marks = marks[order]
    row, inner = np.nonzero(marks)
    places = (numbers[order][row] << np.uint32(9)) | inner.astype(np.uint32)
    return SeenVoxels(cells[order][row], places, marks[row, inner] == HIT)


def clear_ends(
    origin_m: Floats, points_map: Floats, sigma_m: Floats, *, voxel_edge_m: float, noise_sigmas: float
) -> Floats:
    """(M, 3) ends of the clear part of beams to (N, 3) points, metres; without beams that are not clear at all."""
    # Shorter by the margin; what is left may be nothing.
    beams = points_map - origin_m
    range_m = np.linalg.norm(beams, axis=1)
    left_m = range_m - margins_m(sigma_m, voxel_edge_m=voxel_edge_m, noise_sigmas=noise_sigmas)
    some = left_m > 0
    return np.asarray(origin_m + beams[some] * (left_m[some] / range_m[some])[:, None])


def silent_ends(returns: Returns, rays: Floats) -> Floats:
    """(M, 3) ends of the clear part of silent beams, metres, where silence means empty space."""
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
        points_map: (N, 3) their ends, metres.
        clear_m: (M, 3) ends of their clear parts, metres.
        geometry: of the map.
        sums_of: samples of the voxels that were hit.

    Raises:
        BadInputError: they reach beyond the numbered space, or span more than fits in memory.
    """
    # One ray for each voxel in which clear parts end.
    hits, _, voxel_of = unique_voxels(voxels_of_points(points_map, geometry))
    targets, first, _ = unique_voxels(voxels_of_points(clear_m, geometry))
    seen = seen_voxels(origin_m, clear_m[first], targets, geometry, hits=hits)
    return _packed_by_cell(seen, hits, sums_of(voxel_of, len(hits)), geometry)


def unique_voxels(voxels: Ints) -> tuple[Ints, Ints, Ints]:
    """Different voxels (U, 3), the first point in each (U,), and the number of each point's voxel (N,)."""
    if not len(voxels):
        return voxels, np.empty(0, np.int64), np.empty(0, np.int64)
    # One number a voxel, by its place in the box of all of them.
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
    # Both are in order of cell and place, so a cell is one slice of each.
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
