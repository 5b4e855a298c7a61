"""Which leaf of an octree lies beside another: the ground that context models stand on.

A leaf's neighbours are those beside its first voxel, its lower corner. Leaves come in Morton order; a neighbour that
is lower along every axis, or equal, comes before.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Int32s, Ints, Words32
from cairn_map.kernels.integer_kernels import signed

AXIS = 0x09249249
"""Every third bit of a place: x; shifted by 1 y, by 2 z."""
NONE = -1
STEPS = np.array(
    [
        *[(-1, 0, 0), (0, -1, 0), (0, 0, -1)],
        *[(-1, -1, 0), (-1, 0, -1), (0, -1, -1)],
        *[(1, -1, 0), (1, 0, -1), (-1, 1, 0), (0, 1, -1), (-1, 0, 1), (0, -1, 1)],
        (-1, -1, -1),
    ],
    np.int64,
)
"""Neighbours that may come before: faces, lower edges, mixed edges, the corner."""
LOWER = np.array([0, 1, 2, 3, 4, 5, 12], np.int64)
"""Those of `STEPS` that always come before, if they are there."""


@nb.njit(cache=True, nogil=True)
def index_leaves(starts: Words32, sizes: Ints, depth: int) -> tuple[Int32s, Int32s]:
    """From places to leaves: for each brick of 8^3 its table, or -2 - its only leaf, or -1; and (T, 512) tables."""
    brick_of = np.full(8 ** max(depth - 3, 0), NONE, np.int32)
    tables = 0
    for n in range(starts.shape[0]):
        brick = signed(starts[n]) >> 9
        if sizes[n] >= 512:
            brick_of[brick : brick + (sizes[n] >> 9)] = -2 - n
        elif brick_of[brick] == NONE:
            brick_of[brick] = tables
            tables += 1
    leaf_of = np.full((tables, 512), NONE, np.int32)
    for n in range(starts.shape[0]):
        if sizes[n] < 512:
            place = signed(starts[n]) & 511
            leaf_of[brick_of[signed(starts[n]) >> 9], place : place + sizes[n]] = n
    return brick_of, leaf_of


@nb.njit(nogil=True)
def leaf_at(brick_of: Int32s, leaf_of: Int32s, place: int) -> int:
    """The leaf that holds a place, or NONE."""
    if place < 0:
        return NONE
    table = signed(brick_of[place >> 9])
    if table >= 0:
        return signed(leaf_of[table, place & 511])
    return -2 - table if table <= -2 else NONE


@nb.njit(nogil=True)
def stepped(place: int, axis: int, step: int, depth: int) -> int:
    """The place one step along an axis, -1, 0 or 1; NONE outside the cell or from NONE."""
    if step == 0 or place < 0:
        return place
    mask = (AXIS << axis) & ((1 << (3 * depth)) - 1)
    own, rest = place & mask, place & ~mask
    if step < 0:
        return NONE if own == 0 else ((own - 1) & mask) | rest
    return NONE if own == mask else (((own | ~mask) + 1) & mask) | rest


@nb.njit(nogil=True)
def beside(place: int, step: int, depth: int) -> int:
    """The place beside another by `STEPS`, or NONE."""
    for axis in range(3):
        place = stepped(place, axis, STEPS[step, axis], depth)
    return place


@nb.njit(cache=True, nogil=True)
def earlier_rows(starts: Words32, leaves: Ints, brick_of: Int32s, leaf_of: Int32s, depth: int) -> Int32s:
    """(S, 13) for each of the listed leaves the numbers in the list of those beside it that come before, or NONE.

    In the order of `STEPS`; `leaves` rises.
    """
    rows = np.full((leaves.shape[0], STEPS.shape[0]), NONE, np.int32)
    row_of = np.full(starts.shape[0], NONE, np.int32)
    for s in range(leaves.shape[0]):
        place = signed(starts[signed(leaves[s])])
        for i in range(STEPS.shape[0]):
            leaf = leaf_at(brick_of, leaf_of, beside(place, i, depth))
            # What comes later has no number yet.
            if leaf != NONE:
                rows[s, i] = row_of[leaf]
        row_of[leaves[s]] = s
    return rows
