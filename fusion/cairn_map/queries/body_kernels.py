"""Collision tests: does a solid, a box or a sphere, overlap occupied or unknown voxels? Lengths are in voxel edges.

The search goes from cells over bricks and 4^3 blocks down to voxels; each is entered only where the solid overlaps it
and it holds something that could change the answer. These kernels check nothing.
"""

from typing import NamedTuple

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Floats, Ints
from cairn_map.kernels.integer_kernels import U, signed
from cairn_map.queries.occupancy_kernels import (
    FREE,
    KNOWN_BITS,
    OCCUPIED,
    OCCUPIED_BITS,
    UNKNOWN,
    Grid,
    place_of,
    slot_of,
    x_in_block,
)

TOUCH = 1e-6
"""Depth of overlap, voxel edges, up to which solids only touch: what stands on a floor does not collide with it."""
PARALLEL = 1e-9
"""Slack of the edge tests: of edges that are nearly parallel the cross product is nearly 0, and no direction."""


class CollisionBody(NamedTuple):
    """A box of half lengths `half` along the columns of R, or a sphere if `radius` is not 0."""

    centre: Floats
    """(3,)"""
    R: Floats
    """(3, 3)"""
    half: Floats
    """(3,)"""
    radius: float


@nb.njit(cache=True, nogil=True)
def body_states_into(grid: Grid, centres: Floats, R: Floats, half: Floats, radius: float, out: Bytes) -> None:
    """Write (N,) OCCUPIED, UNKNOWN or FREE, in this order of weight, for (N, 3) centres and (N, 3, 3) rotations."""
    for n in range(centres.shape[0]):
        out[n] = body_state(grid, CollisionBody(centres[n], R[n], half, radius))


@nb.njit(nogil=True)
def body_state(grid: Grid, body: CollisionBody) -> np.uint8:
    """OCCUPIED if the solid overlaps an occupied voxel, else UNKNOWN if it overlaps an unknown one, else FREE."""
    # Voxels of the box around the solid, aligned with the axes.
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        reach = body.radius
        for side in range(3):
            reach += abs(body.R[axis, side]) * body.half[side]
        low[axis] = int(np.floor(body.centre[axis] - reach))
        high[axis] = int(np.floor(body.centre[axis] + reach))
    # Cells of the box. An absent cell is unknown; an occupied voxel settles the answer.
    meets_unknown = False
    side = 1 << grid.depth
    for i in range(low[0] >> grid.depth, (high[0] >> grid.depth) + 1):
        for j in range(low[1] >> grid.depth, (high[1] >> grid.depth) + 1):
            for k in range(low[2] >> grid.depth, (high[2] >> grid.depth) + 1):
                if not overlaps(body, i * side, j * side, k * side, side):
                    continue
                slot = slot_of(grid, i, j, k)
                if slot < 0:
                    meets_unknown = True
                    continue
                state = state_in_cell(grid, body, slot, low, high, meets_unknown)
                if state == OCCUPIED:
                    return OCCUPIED
                meets_unknown |= state == UNKNOWN
    return UNKNOWN if meets_unknown else FREE


@nb.njit(nogil=True)
def state_in_cell(grid: Grid, body: CollisionBody, slot: int, low: Ints, high: Ints, meets_unknown: bool) -> np.uint8:
    """State that the solid meets in the bricks of one cell, within its bounds `low` to `high`."""
    # Bricks between the bounds of the solid and of the cell.
    side = 1 << grid.depth
    x0, y0, z0 = (
        signed(grid.cells[slot, 0]) * side,
        signed(grid.cells[slot, 1]) * side,
        signed(grid.cells[slot, 2]) * side,
    )
    # `& -8` is the first voxel of a brick.
    for x in range(max(low[0] & -8, x0), min(high[0] + 1, x0 + side), 8):
        for y in range(max(low[1] & -8, y0), min(high[1] + 1, y0 + side), 8):
            for z in range(max(low[2] & -8, z0), min(high[2] + 1, z0 + side), 8):
                if not overlaps(body, x, y, z, 8):
                    continue
                brick = signed(grid.bricks[slot, place_of(x, y, z, side - 1) >> 9])
                if brick < 0:
                    meets_unknown = True
                    continue
                state = state_in_brick(grid, body, brick, x, y, z, meets_unknown)
                if state == OCCUPIED:
                    return OCCUPIED
                meets_unknown |= state == UNKNOWN
    return UNKNOWN if meets_unknown else FREE


@nb.njit(nogil=True)
def state_in_brick(
    grid: Grid, body: CollisionBody, brick: int, x0: int, y0: int, z0: int, meets_unknown: bool
) -> np.uint8:
    """State that the solid meets in the brick whose first voxel is (x0, y0, z0)."""
    for w in range(8):
        occupied, unknown = grid.words[brick, w, OCCUPIED_BITS], ~grid.words[brick, w, KNOWN_BITS]
        # Once an unknown voxel is met, only an occupied one can change the answer.
        wanted = occupied if meets_unknown else occupied | unknown
        x, y, z = x0 + 4 * (w & 1), y0 + 2 * (w & 2), z0 + (w & 4)
        if wanted == U(0) or not overlaps(body, x, y, z, 4):
            continue
        # Voxel by voxel, but only those that could change the answer.
        for n in range(64):
            if (wanted >> U(n)) & U(1) == U(0):
                continue
            if overlaps(body, x + x_in_block(n), y + x_in_block(n >> 1), z + x_in_block(n >> 2), 1):
                if (occupied >> U(n)) & U(1) != U(0):
                    return OCCUPIED
                meets_unknown = True
                wanted = occupied
    return UNKNOWN if meets_unknown else FREE


@nb.njit(nogil=True)
def overlaps(body: CollisionBody, x: int, y: int, z: int, size: int) -> bool:
    """True if the solid overlaps the cube of `size` whose lowest corner is (x, y, z), deeper than TOUCH."""
    half = size / 2
    tx, ty, tz = body.centre[0] - (x + half), body.centre[1] - (y + half), body.centre[2] - (z + half)
    if body.radius > 0:
        # A sphere: the distance from its centre to the cube's nearest point.
        gx, gy, gz = max(abs(tx) - half, 0.0), max(abs(ty) - half, 0.0), max(abs(tz) - half, 0.0)
        return gx * gx + gy * gy + gz * gz < (body.radius - TOUCH) ** 2  # type: ignore[no-any-return]
    return not boxes_apart(body.R, body.half, tx, ty, tz, half)


@nb.njit(nogil=True)
def boxes_apart(R: Floats, h: Floats, tx: float, ty: float, tz: float, half: float) -> bool:
    """True if some axis separates a box from a cube whose centre is at (-tx, -ty, -tz) from the box's.

    The separating axis test of Gottschalk, Lin and Manocha ("OBBTree", 1996): 15 axes, which are the normals of both
    boxes' faces and the cross products of their edges. Two boxes are apart along an axis if their centres are farther
    apart than the sum of what the half boxes reach.
    """
    t = (tx, ty, tz)
    # Normals of the cube's faces: the map's axes.
    for axis in range(3):
        reach = half + h[0] * abs(R[axis, 0]) + h[1] * abs(R[axis, 1]) + h[2] * abs(R[axis, 2])
        if abs(t[axis]) > reach - TOUCH:
            return True
    # Normals of the box's faces: the columns of R.
    for side in range(3):
        along = tx * R[0, side] + ty * R[1, side] + tz * R[2, side]
        reach = h[side] + half * (abs(R[0, side]) + abs(R[1, side]) + abs(R[2, side]))
        if abs(along) > reach - TOUCH:
            return True
    # Cross products of an edge of the cube and one of the box.
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in range(3):
            p, q = (side + 1) % 3, (side + 2) % 3
            along = t[v] * R[u, side] - t[u] * R[v, side]
            cube = half * (abs(R[u, side]) + abs(R[v, side]))
            box = h[p] * abs(R[axis, q]) + h[q] * abs(R[axis, p])
            if abs(along) > cube + box + PARALLEL:
                return True
    return False
