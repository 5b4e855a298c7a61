"""Votes of the returns in each column: surfaces from below, and the bins that beams crossed on their last way.

tests/cairn_fusion/mapping/test_level_votes.py has the slow twin.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Flags, Floats, Ints
from cairn_map.evidence.grid import NANOMETRES

NO_VOTE = -1
"""Offset of a voxel that was hit or missed without a vote."""
GAP_STEPS = 2
"""Steps of height between surfaces, at least: so the bins of two votes always differ."""
TALL_BINS = 2
"""Bins from a surface's vote to its top beyond which the top is hit, too."""
CROSSED_BINS = 64
"""Bins above a column's lowest return in which crossing beams are looked for: 3.2 m of 5 cm."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def column_votes(
    order: Ints,
    numbers: Ints,
    voxels: Ints,
    points_m: Floats,
    origin_m: Floats,
    size_nm: Ints,
    gap_nm: int,
    offset_nm: int,
) -> tuple[Ints, Ints, Flags]:
    """Voxels that a scan hit or crossed, (M, 3), all different; offset of each one's vote; True for hits.

    Args:
        order: (N,) rows of the returns, column by column.
        numbers: (N,) number of each return's column.
        voxels: (N, 3) voxel of each return.
        points_m: (N, 3) returns, metres.
        origin_m: (3,) place of the sensor.
        size_nm: (3,) edges of a voxel.
        offset_nm: unit of the offsets.
        gap_nm: height without a return that parts two surfaces; `GAP_STEPS` steps or more.
    """
    N, step_nm = len(order), size_nm[2]
    # A return gives at most a vote or a top and the 63 crossed bins of its column; the array grows with them.
    room = N // 4 + 2 * CROSSED_BINS
    found, offsets, is_hit, count = np.empty((room, 3), np.int64), np.empty(room, np.int64), np.empty(room, np.bool_), 0
    heights, start = np.empty(N, np.int64), 0
    while start < N:
        # Stage 1: the returns of one column, from below.
        stop = start + 1
        while stop < N and numbers[order[stop]] == numbers[order[start]]:
            stop += 1
        K = stop - start
        for n in range(K):
            heights[n] = np.int64(np.rint(points_m[order[start + n], 2] * NANOMETRES))
        _sort_into(heights[:K])
        x, y, lowest = voxels[order[start], 0], voxels[order[start], 1], heights[0] // step_nm
        if count + 2 * K + CROSSED_BINS > len(offsets):
            found, offsets, is_hit = _grown(found, offsets, is_hit, 2 * (len(offsets) + K))
        # Stage 2: bins that beams crossed, as bits from the lowest return's on: above the reach of a vote there, and
        # below another return.
        crossed, highest = np.uint64(0), heights[K - 1] // step_nm - lowest
        if highest > TALL_BINS + 1:
            crossed = _crossed_bins(order[start:stop], voxels, points_m, origin_m, size_nm, lowest, highest)
        # Stage 3: surfaces; each votes for the mean of the returns within a step above its lowest.
        low = 0
        while low < K:
            high, total, near = low, np.int64(0), 0
            while high < K and (high == low or heights[high] - heights[high - 1] < gap_nm):
                if heights[high] - heights[low] < step_nm:
                    total += heights[high] - heights[low]
                    near += 1
                high += 1
            vote = heights[low] + total // near
            own, top = vote // step_nm, heights[high - 1] // step_nm
            found[count, 0], found[count, 1], found[count, 2] = x, y, own
            offsets[count], is_hit[count] = (vote - own * step_nm + offset_nm // 2) // offset_nm, True
            count += 1
            if own - lowest < CROSSED_BINS:
                crossed &= ~(np.uint64(1) << np.uint64(own - lowest))
            if top - own > TALL_BINS:
                found[count, 0], found[count, 1], found[count, 2] = x, y, top
                offsets[count], is_hit[count] = NO_VOTE, True
                count += 1
            low = high
        # Stage 4: of these, the ones from which nothing came back.
        each = 0
        while crossed != 0:
            if crossed & np.uint64(1):
                found[count, 0], found[count, 1], found[count, 2] = x, y, lowest + each
                offsets[count], is_hit[count] = NO_VOTE, False
                count += 1
            crossed >>= np.uint64(1)
            each += 1
        start = stop
    return found[:count], offsets[:count], is_hit[:count]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _crossed_bins(
    rows: Ints, voxels: Ints, points_m: Floats, origin_m: Floats, size_nm: Ints, lowest: int, highest: int
) -> np.uint64:
    """Bits of the bins of one column, from its lowest return's on, that beams crossed and from which none came back."""
    taken, crossed, one = np.uint64(0), np.uint64(0), np.uint64(1)
    for n in rows:
        own = voxels[n, 2] - lowest
        if own < CROSSED_BINS:
            taken |= one << np.uint64(own)
        # A beam from above crossed the bins over its end, one from below those under it.
        entry = _entry_bin(points_m[n], origin_m, voxels[n, 0], voxels[n, 1], size_nm) - lowest
        for each in range(own + 1, min(entry, CROSSED_BINS - 1) + 1):
            crossed |= one << np.uint64(each)
        for each in range(max(entry, 0), min(own, CROSSED_BINS)):
            crossed |= one << np.uint64(each)
    # Within reach of a vote no top is hit; above the highest return nothing hinders.
    crossed &= ~taken & ~((one << np.uint64(TALL_BINS + 1)) - one)
    if highest < CROSSED_BINS:
        crossed &= (one << np.uint64(highest)) - one
    return crossed


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _entry_bin(point_m: Floats, origin_m: Floats, x: int, y: int, size_nm: Ints) -> int:
    """Bin in which the beam to a return came into the column; of a beam from within the column, the sensor's."""
    share = 1.0
    for axis, column in ((0, x), (1, y)):
        way_m = origin_m[axis] - point_m[axis]
        border_m = (column + 1 if way_m > 0 else column) * size_nm[axis] / NANOMETRES - point_m[axis]
        if way_m != 0:
            share = min(share, max(border_m / way_m, 0.0))
    return int(np.floor((point_m[2] + share * (origin_m[2] - point_m[2])) / (size_nm[2] / NANOMETRES)))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _sort_into(heights: Ints) -> None:
    """Sort in place; a column has few returns, or many on a wall, which come in order, ring by ring."""
    if len(heights) > 32:
        heights.sort()
        return
    for n in range(1, len(heights)):
        own, place = heights[n], n
        while place > 0 and heights[place - 1] > own:
            heights[place] = heights[place - 1]
            place -= 1
        heights[place] = own


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _grown(found: Ints, offsets: Ints, is_hit: Flags, room: int) -> tuple[Ints, Ints, Flags]:
    """The arrays with more room."""
    N = len(offsets)
    more, further, others = np.empty((room, 3), np.int64), np.empty(room, np.int64), np.empty(room, np.bool_)
    more[:N], further[:N], others[:N] = found, offsets, is_hit
    return more, further, others
