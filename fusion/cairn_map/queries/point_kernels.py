"""States and sums of the voxels that hold given points.

Sums are read in three steps: `locate_into` finds each point's cell and voxel, `group_into` lists the points cell by
cell, and one call for each cell gathers its sums, with all it needs in the processor's cache. These kernels check
nothing, but return whether all points were inside the numbered space.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Floats, Int32s, Ints
from cairn_map.kernels.integer_kernels import U
from cairn_map.queries.occupancy_kernels import NONE, UNKNOWN, Grid, Pool, place_of, slot_of, state_in, voxel_of

Places = npt.NDArray[np.uint32]
BLOCK = 256
"""Points that `states_into` looks up at a time: 4 KiB of bricks and places stay in the processor's first cache."""


@nb.njit(nogil=True, forceinline=True)
def is_within(points: Floats, n: int | np.uint64, reach_m: float) -> bool:
    """True if point n is finite and within reach along every axis."""
    return bool((abs(points[n, 0]) < reach_m) & (abs(points[n, 1]) < reach_m) & (abs(points[n, 2]) < reach_m))


@nb.njit(cache=True, nogil=True)
def states_into(grid: Grid, points: Floats, reach_m: float, out: Bytes) -> bool:
    """Write (N,) states of the voxels that hold (N, 3) points; returns True if all are finite and within reach."""
    inside = True
    bricks, places = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    for start in range(U(0), U(points.shape[0]), U(BLOCK)):
        count = min(U(BLOCK), U(points.shape[0]) - start)
        # All bricks of a block of points first, then all their bits: so the processor fetches many at a time.
        for n in range(count):
            inside &= is_within(points, start + n, reach_m)
            x = voxel_of(points[start + n, 0], grid.edge_nm)
            y = voxel_of(points[start + n, 1], grid.edge_nm)
            z = voxel_of(points[start + n, 2], grid.edge_nm)
            slot = slot_of(grid, x >> grid.depth, y >> grid.depth, z >> grid.depth)
            places[n] = place_of(x, y, z, (1 << grid.depth) - 1)
            bricks[n] = grid.bricks[U(slot), U(places[n] >> 9)] if slot >= 0 else NONE
        for n in range(count):
            out[start + n] = state_in(grid.words, bricks[n], places[n]) if bricks[n] >= 0 else UNKNOWN
    return inside


@nb.njit(cache=True, nogil=True)
def locate_into(grid: Grid, points: Floats, reach_m: float, slots: Int32s, places: Places) -> bool:
    """Write (N,) slots of the cells that hold (N, 3) points, -1 where there is no brick, and Morton codes in the cell.

    Returns True if all points are finite and within reach.
    """
    inside = True
    for n in range(U(points.shape[0])):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        inside &= (abs(px) < reach_m) & (abs(py) < reach_m) & (abs(pz) < reach_m)
        x, y, z = voxel_of(px, grid.edge_nm), voxel_of(py, grid.edge_nm), voxel_of(pz, grid.edge_nm)
        slot = slot_of(grid, x >> grid.depth, y >> grid.depth, z >> grid.depth)
        place = place_of(x, y, z, (1 << grid.depth) - 1)
        places[n] = place
        # A place in no brick has neither counts nor samples.
        if slot >= 0 and grid.bricks[U(slot), U(place >> 9)] < 0:
            slot = -1
        slots[n] = slot
    return inside


@nb.njit(cache=True, nogil=True)
def group_into(slots: Int32s, starts: Ints, order: Int32s) -> None:
    """List the points of each slot: those of slot c are order[starts[c] : starts[c + 1]], of (C + 1,) starts."""
    # A counting sort: how many points each slot has, in the place after its own,
    starts[:] = 0
    for n in range(U(slots.shape[0])):
        if slots[n] >= 0:
            starts[U(slots[n]) + U(1)] += 1
    # then where each slot's run begins,
    for c in range(1, starts.shape[0]):
        starts[c] += starts[c - 1]
    # then each point to the next free place of its run.
    at = starts.copy()
    for n in range(U(slots.shape[0])):
        if slots[n] >= 0:
            order[at[U(slots[n])]] = n
            at[U(slots[n])] += 1


@nb.njit(cache=True, nogil=True)
def counts_into(rows: Int32s, places: Places, bricks: npt.NDArray[np.int16], pool: Pool, out: Int32s) -> None:
    """Write (N, 2) hits and misses of the listed points of one cell, all in its bricks."""
    for n in range(U(rows.shape[0])):
        # A place without its lowest 9 bits is the number of its brick.
        row = U(rows[n])
        place = U(places[row])
        brick = U(bricks[place >> U(9)])
        out[row, 0] = pool[brick, place & U(511), 0]
        out[row, 1] = pool[brick, place & U(511), 1]


@nb.njit(cache=True, nogil=True)
def log_odds_into(
    rows: Int32s,
    places: Places,
    bricks: npt.NDArray[np.int16],
    pool: Pool,
    of_hits: Floats,
    of_misses: Floats,
    least: float,
    most: float,
    out: Floats,
) -> None:
    """Write (N,) clamped log-odds of the listed points of one cell, with a pool of 16 bits; NaN where unknown.

    `of_hits` and `of_misses` are the tables of `occupancy_kernels.states_of_counts_into`.
    """
    for n in range(U(rows.shape[0])):
        row = U(rows[n])
        place = U(places[row])
        brick = U(bricks[place >> U(9)])
        hits, misses = pool[brick, place & U(511), 0], pool[brick, place & U(511), 1]
        # L(n) = hits l_hit + misses l_miss, clamped (OctoMap, Eq. 2 and 4), both products from tables.
        odds = of_hits[np.uint16(hits)] + of_misses[np.uint16(misses)]
        out[row] = min(max(odds, least), most) if hits | misses != 0 else np.nan


@nb.njit(cache=True, nogil=True)
def read_odds_into(
    rows: Int32s,
    places: Places,
    bricks: npt.NDArray[np.int16],
    pool: Pool,
    steps: npt.NDArray[np.int16],
    step: float,
    zero: float,
    least: float,
    most: float,
    out: Floats,
) -> None:
    """Write (N,) clamped log-odds of the listed points of one cell that is a reading; NaN where unknown."""
    for n in range(U(rows.shape[0])):
        # A place without its lowest 9 bits is the number of its brick.
        row = U(rows[n])
        place = U(places[row])
        brick = U(bricks[place >> U(9)])
        # Only counts make a voxel known.
        seen = pool[brick, place & U(511), 0] | pool[brick, place & U(511), 1] != 0
        # Steps count from the threshold; at a bound they reach beyond it, so that clamping gives the bound itself.
        odds = zero + steps[brick, place & U(511)] * step
        out[row] = min(max(odds, least), most) if seen else np.nan


@nb.njit(cache=True, nogil=True)
def samples_into(
    rows: Int32s,
    places: Places,
    known: Places,
    row_of: Int32s,
    narrow: npt.NDArray[np.int32],
    wide_planes: Ints,
    wide: Ints,
    first_plane: int,
    out: Ints,
) -> None:
    """Write (N, P) sums of P planes from `first_plane` on, of the listed points of one cell.

    Rows of points without samples stay unchanged.
    """
    P = out.shape[1]
    for n in range(rows.shape[0]):
        # Binary search: `known` rises, and all before `at` is below `place`, nothing from `end` on is.
        place = places[rows[n]]
        at, end = 0, known.shape[0]
        while at < end:
            middle = (at + end) >> 1
            if known[middle] < place:
                at = middle + 1
            else:
                end = middle
        if at == known.shape[0] or known[at] != place:
            continue
        # Planes of 32 bits; then those few that need 64.
        row = row_of[at]
        for p in range(P):
            out[rows[n], p] = narrow[row, first_plane + p]
        for w in range(wide_planes.shape[0]):
            if 0 <= wide_planes[w] - first_plane < P:
                out[rows[n], wide_planes[w] - first_plane] = wide[row, w]
