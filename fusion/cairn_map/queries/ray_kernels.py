"""Rays through a map's states; no checks, but they say whether an origin was inside the numbered space.

Amanatides and Woo's walk from border to border, over blocks instead of voxels: an absent cell, an absent brick, or 4^3
voxels without one that ends the ray are crossed in one step. Lengths are in voxel edges.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Floats, Ints
from cairn_map.codec.entropy.arithmetic_kernels import signed
from cairn_map.evidence.grid import NANOMETRES
from cairn_map.queries.occupancy_kernels import (
    FREE,
    KNOWN_BITS,
    NONE,
    OCCUPIED,
    OCCUPIED_BITS,
    UNKNOWN,
    Grid,
    U,
    place_of,
    slot_of,
    voxel_of,
)
from cairn_map.queries.point_kernels import is_within

NOWHERE = 1 << 62
"""No cell's number."""


@nb.njit(cache=True, nogil=True)
def cast_into(
    grid: Grid,
    origins: Floats,
    directions: Floats,
    reach_m: float,
    range_max: float,
    unknown_ends: np.uint64,
    ranges: Floats,
    states: Bytes,
    voxels: Ints,
) -> bool:
    """How far each ray of (N, 3) origins (metres) and unit directions comes.

    Writes (N,) the range at which it enters the voxel that ends it, infinite if none does within `range_max`; (N,) that
    voxel's state, FREE if there is none; and (N, 3) its number. `unknown_ends` is all ones if unknown voxels end a ray,
    else 0.
    """
    inside = True
    start, voxel = np.empty(3), np.empty(3, np.int64)
    for n in range(origins.shape[0]):
        inside &= is_within(origins, n, reach_m)
        for axis in range(3):
            start[axis] = np.rint(origins[n, axis] * NANOMETRES) / grid.edge_nm
            voxel[axis] = voxel_of(origins[n, axis], grid.edge_nm)
        at = 0.0 if unknown_ends else enter_box_into(grid, start, directions[n], voxel)
        ranges[n], states[n] = walk_into(grid, start, directions[n], at, range_max, unknown_ends, voxel)
        voxels[n] = voxel
    return inside


@nb.njit(nogil=True)
def enter_box_into(grid: Grid, start: Floats, direction: Floats, voxel: Ints) -> float:
    """Where a ray enters the box of all cells, and with which voxel; infinite if it does not."""
    if is_in_box(grid, voxel):
        return 0.0
    enters, leaves = 0.0, np.inf
    for axis in range(3):
        if direction[axis] == 0:
            if not grid.low[axis] <= voxel[axis] < grid.high[axis]:
                return np.inf
            continue
        a = (grid.low[axis] - start[axis]) / direction[axis]
        b = (grid.high[axis] - start[axis]) / direction[axis]
        enters, leaves = max(enters, min(a, b)), min(leaves, max(a, b))
    if not enters < leaves:
        return np.inf
    for axis in range(3):
        reached = int(np.floor(start[axis] + enters * direction[axis]))
        voxel[axis] = min(max(reached, grid.low[axis]), grid.high[axis] - 1)
    return enters


@nb.njit(nogil=True, forceinline=True)
def is_in_box(grid: Grid, voxel: Ints) -> bool:
    """Whether a voxel lies in the box of all cells."""
    inside = True
    for axis in range(3):
        inside &= (voxel[axis] >= grid.low[axis]) & (voxel[axis] < grid.high[axis])
    return inside


@nb.njit(nogil=True)
def walk_into(
    grid: Grid, start: Floats, direction: Floats, at: float, range_max: float, unknown_ends: np.uint64, voxel: Ints
) -> tuple[float, np.uint8]:
    """Walk from `voxel`, entered at `at`, to the voxel that ends the ray, which it becomes; its range and state."""
    depth, mask = grid.depth, (1 << grid.depth) - 1
    x, y, z = voxel[0], voxel[1], voxel[2]
    start_x, inverse_x, up_x = along(start[0], direction[0], x)
    start_y, inverse_y, up_y = along(start[1], direction[1], y)
    start_z, inverse_z, up_z = along(start[2], direction[2], z)
    cell_x, cell_y, cell_z, slot = NOWHERE, NOWHERE, NOWHERE, NONE
    end, state = np.inf, FREE
    while at <= range_max:
        if (x >> depth != cell_x) | (y >> depth != cell_y) | (z >> depth != cell_z):
            voxel[0], voxel[1], voxel[2] = x, y, z
            if not is_in_box(grid, voxel):
                if unknown_ends:
                    end, state = at, UNKNOWN
                break
            cell_x, cell_y, cell_z = x >> depth, y >> depth, z >> depth
            slot = slot_of(grid, cell_x, cell_y, cell_z)
        size = 1 << depth
        brick = NONE
        place = 0
        if slot >= 0:
            place = place_of(x, y, z, mask)
            brick = signed(grid.bricks[U(slot), U(place >> 9)])
            size = 8
        if brick >= 0:
            b, w = U(brick), U((place >> 6) & 7)
            occupied = grid.words[b, w, OCCUPIED_BITS]
            ends = occupied | (~grid.words[b, w, KNOWN_BITS] & unknown_ends)
            size = 4
            if ends != U(0):
                # Voxel by voxel, until one ends it or the block is left.
                block_x, block_y, block_z = x & -4, y & -4, z & -4
                bit = U(place & 63)
                while (ends >> bit) & U(1) == U(0):
                    to_x = (x + (up_x & 1) - start_x) * inverse_x
                    to_y = (y + (up_y & 1) - start_y) * inverse_y
                    to_z = (z + (up_z & 1) - start_z) * inverse_z
                    leaves = min(to_x, to_y, to_z)
                    at = max(at, leaves)
                    x += (up_x | 1) * -int(to_x == leaves)
                    y += (up_y | 1) * -int(to_y == leaves)
                    z += (up_z | 1) * -int(to_z == leaves)
                    if ((x ^ block_x) | (y ^ block_y) | (z ^ block_z)) & -4 != 0:
                        break
                    bit = U(place_of(x, y, z, 3))
                else:
                    if at <= range_max:
                        end = at
                        state = OCCUPIED if (occupied >> bit) & U(1) else UNKNOWN
                    break
                continue
        elif unknown_ends:
            end, state = at, UNKNOWN
            break
        to_x = ((x & -size) + (up_x & size) - start_x) * inverse_x
        to_y = ((y & -size) + (up_y & size) - start_y) * inverse_y
        to_z = ((z & -size) + (up_z & size) - start_z) * inverse_z
        at = max(at, min(to_x, to_y, to_z))
        x = beyond(x, size, up_x, start_x + at * direction[0], to_x <= at)
        y = beyond(y, size, up_y, start_y + at * direction[1], to_y <= at)
        z = beyond(z, size, up_z, start_z + at * direction[2], to_z <= at)
    voxel[0], voxel[1], voxel[2] = x, y, z
    return end, state


@nb.njit(nogil=True, forceinline=True)
def along(start: float, direction: float, voxel: int) -> tuple[float, float, int]:
    """A ray along one axis: start, what to multiply a length by for the range, and -1 if it goes up, else 0."""
    if direction == 0:
        return voxel + 0.5, np.inf, -1  # never on a border, where infinity times zero would be met
    return start, 1 / direction, -1 if direction > 0 else 0


@nb.njit(nogil=True, forceinline=True)
def beyond(voxel: int, size: int, up: int, reached: float, is_left: bool) -> int:
    """The voxel along one axis when a block is left: the first beyond its border, or one inside it, not behind."""
    low = voxel & -size
    if is_left:
        return low + size if up else low - 1
    inside = int(np.floor(reached))
    return min(max(inside, voxel if up else low), low + size - 1 if up else voxel)
