"""Neighbours of an octree's leaves, on which context models are based (FORMAT.md section 14, "Neighbours").

A leaf's neighbours are those next to its first voxel, its lower corner. Leaves come in Morton order; a neighbour that
is lower along every axis, or equal, comes before.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Int32s, Ints, Words32
from cairn_map.kernels.integer_kernels import U, signed

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


@nb.njit(nogil=True, forceinline=True)
def leaf_at(brick_of: Int32s, leaf_of: Int32s, place: int) -> int:
    """Leaf that holds a place, or NONE."""
    found = NONE
    if place >= 0:
        table = signed(brick_of[U(place >> 9)])
        if table >= 0:
            found = signed(leaf_of[U(table), U(place & 511)])
        elif table <= -2:
            found = -2 - table
    # As in `mixing_kernels.code_number`: no references are counted.
    _ = brick_of.shape, leaf_of.shape
    return found


@nb.njit(nogil=True, forceinline=True)
def along(place: int, axis: int, depth: int) -> tuple[int, int, int]:
    """Bits that say where a place is along an axis: of the place one step below, its own, and of that one step above.

    NONE beyond the cell. Three axes' bits joined by `|` are a place, or NONE if one of them is, for NONE has all bits.
    """
    # Arithmetic on every third bit of a Morton code: the bits between are filled with ones, which pass a carry on.
    mask = (AXIS << axis) & ((1 << (3 * depth)) - 1)
    own = place & mask
    return (NONE if own == 0 else (own - 1) & mask, own, NONE if own == mask else ((own | ~mask) + 1) & mask)


@nb.njit(nogil=True, forceinline=True)
def lower_places(place: int, depth: int) -> tuple[int, int, int, int, int, int, int]:
    """Places of the seven neighbours that come before, or NONE: across three faces, three edges and the corner."""
    (x0, x1, _), (y0, y1, _), (z0, z1, _) = along(place, 0, depth), along(place, 1, depth), along(place, 2, depth)
    return (
        x0 | y1 | z1,
        x1 | y0 | z1,
        x1 | y1 | z0,
        x0 | y0 | z1,
        x0 | y1 | z0,
        x1 | y0 | z0,
        x0 | y0 | z0,
    )


@nb.njit(nogil=True, forceinline=True)
def upper_places(place: int, depth: int) -> tuple[int, int, int]:
    """Places of the three neighbours one step up along each axis, or NONE."""
    (_, x1, x2), (_, y1, y2), (_, z1, z2) = along(place, 0, depth), along(place, 1, depth), along(place, 2, depth)
    return x2 | y1 | z1, x1 | y2 | z1, x1 | y1 | z2


@nb.njit(cache=True, nogil=True)
def earlier_rows(starts: Words32, leaves: Ints, brick_of: Int32s, leaf_of: Int32s, depth: int) -> Int32s:
    """(S, 13) for each of the listed leaves, the rows in the list of its neighbours that come before, or NONE.

    Columns are in the order of `STEPS`; `leaves` rises.
    """
    rows = np.full((leaves.shape[0], STEPS.shape[0]), NONE, np.int32)
    row_of = np.full(starts.shape[0], NONE, np.int32)
    for s in range(U(leaves.shape[0])):
        own = U(leaves[s])
        place = signed(starts[own])
        (x0, x, x2), (y0, y, y2), (z0, z, z2) = along(place, 0, depth), along(place, 1, depth), along(place, 2, depth)
        # In the order of `STEPS`.
        faces = x0 | y | z, x | y0 | z, x | y | z0
        lower_edges = x0 | y0 | z, x0 | y | z0, x | y0 | z0
        mixed = x2 | y0 | z, x2 | y | z0, x0 | y2 | z, x | y2 | z0, x0 | y | z2, x | y0 | z2
        column = U(0)
        for near in (*faces, *lower_edges, *mixed, x0 | y0 | z0):
            # A leaf that comes later has no row yet; its places are higher.
            if near != NONE and near < place:
                leaf = leaf_at(brick_of, leaf_of, near)
                if leaf != NONE:
                    rows[s, column] = row_of[U(leaf)]
            column += U(1)
        row_of[own] = s
    return rows
