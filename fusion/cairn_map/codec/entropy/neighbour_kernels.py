"""Neighbours of an octree's leaves, on which context models are based (FORMAT.md section 14, "Neighbours").

A leaf's neighbours are those next to its first voxel, its lower corner. Leaves come in Morton order; a neighbour that
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
"""Steps to neighbours that may come before: faces, lower edges, mixed edges, the corner."""
LOWER = np.array([0, 1, 2, 3, 4, 5, 12], np.int64)
"""Indices of the `STEPS` to neighbours that always come before, if they exist."""


@nb.njit(cache=True, nogil=True)
def index_leaves(starts: Words32, sizes: Ints, depth: int) -> tuple[Int32s, Int32s]:
    """Index of leaves by place: for each brick of 8^3 its table, or -2 - its only leaf, or -1; and (T, 512) tables."""
    # Bricks: those inside one large leaf, and those with smaller leaves, which take a table.
    brick_of = np.full(8 ** max(depth - 3, 0), NONE, np.int32)
    tables = 0
    for n in range(starts.shape[0]):
        brick = signed(starts[n]) >> 9
        if sizes[n] >= 512:
            brick_of[brick : brick + (sizes[n] >> 9)] = -2 - n
        elif brick_of[brick] == NONE:
            brick_of[brick] = tables
            tables += 1
    # Tables: the leaf of each voxel.
    leaf_of = np.full((tables, 512), NONE, np.int32)
    for n in range(starts.shape[0]):
        if sizes[n] < 512:
            place = signed(starts[n]) & 511
            leaf_of[brick_of[signed(starts[n]) >> 9], place : place + sizes[n]] = n
    return brick_of, leaf_of


@nb.njit(nogil=True)
def leaf_at(brick_of: Int32s, leaf_of: Int32s, place: int) -> int:
    """Leaf that holds a place, or NONE."""
    if place < 0:
        return NONE
    table = signed(brick_of[place >> 9])
    if table >= 0:
        return signed(leaf_of[table, place & 511])
    return -2 - table if table <= -2 else NONE


@nb.njit(nogil=True)
def stepped(place: int, axis: int, step: int, depth: int) -> int:
    """Place one step along an axis, -1, 0 or 1; NONE outside the cell or from NONE."""
    if step == 0 or place < 0:
        return place
    # Arithmetic on every third bit of a Morton code: the bits between are filled with ones, which pass a carry on.
    mask = (AXIS << axis) & ((1 << (3 * depth)) - 1)
    own, rest = place & mask, place & ~mask
    if step < 0:
        return NONE if own == 0 else ((own - 1) & mask) | rest
    return NONE if own == mask else (((own | ~mask) + 1) & mask) | rest


@nb.njit(nogil=True)
def beside(place: int, step: int, depth: int) -> int:
    """Place next to another, by an index of `STEPS`, or NONE."""
    for axis in range(3):
        place = stepped(place, axis, STEPS[step, axis], depth)
    return place


@nb.njit(cache=True, nogil=True)
def earlier_rows(starts: Words32, leaves: Ints, brick_of: Int32s, leaf_of: Int32s, depth: int) -> Int32s:
    """(S, 13) for each of the listed leaves, the rows in the list of its neighbours that come before, or NONE.

    Columns are in the order of `STEPS`; `leaves` rises.
    """
    rows = np.full((leaves.shape[0], STEPS.shape[0]), NONE, np.int32)
    row_of = np.full(starts.shape[0], NONE, np.int32)
    for s in range(leaves.shape[0]):
        place = signed(starts[signed(leaves[s])])
        for i in range(STEPS.shape[0]):
            leaf = leaf_at(brick_of, leaf_of, beside(place, i, depth))
            # A leaf that comes later has no row yet.
            if leaf != NONE:
                rows[s, i] = row_of[leaf]
        row_of[leaves[s]] = s
    return rows
