"""Rays through the states of a map: where each ray ends. Lengths are in voxel edges.

The walk is that of Amanatides and Woo ("A fast voxel traversal algorithm for ray tracing", 1987), from border to
border, over blocks instead of voxels: an absent cell, an absent brick, or 4^3 voxels that cannot end the ray are
crossed in one step. `Ray`, `walk_block` and `leave_block` are the steps of the walk; `render_kernels` takes them too.

These kernels check nothing, but return whether all origins were inside the numbered space.
"""

from typing import NamedTuple

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Floats, Ints
from cairn_map.evidence.grid import NANOMETRES
from cairn_map.kernels.integer_kernels import U, signed
from cairn_map.queries.occupancy_kernels import (
    FREE,
    KNOWN_BITS,
    NONE,
    OCCUPIED,
    OCCUPIED_BITS,
    UNKNOWN,
    Grid,
    place_of,
    slot_of,
    voxel_of,
)
from cairn_map.queries.point_kernels import is_within

NOWHERE = 1 << 62
"""A number that no cell has."""
LEAST_DIRECTION = 1e-30
"""A smaller part of a unit direction counts as 0: its inverse could be infinite, and a walk of NaN never ends."""
Axes = tuple[float, float, float]


class Ray(NamedTuple):
    """A ray prepared for the walk: everything that stays the same from step to step, as (x, y, z)."""

    start: Axes
    """Origin."""
    inverse: Axes
    """1 / direction: a length along the axis times this is the range at which the ray has come so far."""
    up: tuple[int, int, int]
    """-1, which is all bits set, if the ray rises along the axis; 0 if it falls. `up & size` is size or 0."""
    direction: Axes
    """Unit direction."""


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
    """Cast (N, 3) rays from origins (metres) along unit directions.

    Writes (N,) the range at which each ray enters the voxel that ends it, infinite if none does within `range_max`;
    (N,) that voxel's state, FREE if there is none; and (N, 3) its number. `unknown_ends` is all ones if unknown voxels
    end a ray, else 0.
    """
    inside = True
    start, voxel = np.empty(3), np.empty(3, np.int64)
    for n in range(origins.shape[0]):
        inside &= is_within(origins, n, reach_m)
        # The caller refuses all rays if one begins outside; and from NaN a walk might never come to an end.
        if not inside:
            break
        for axis in range(3):
            start[axis] = np.rint(origins[n, axis] * NANOMETRES) / grid.edge_nm
            voxel[axis] = voxel_of(origins[n, axis], grid.edge_nm)
        # Outside of the box all is unknown: that ends the ray at once, or is crossed in one step.
        at = 0.0 if unknown_ends else enter_box_into(grid, start, directions[n], 0.0, voxel)
        ranges[n], states[n] = walk_into(grid, start, directions[n], at, range_max, unknown_ends, voxel)
        # `voxel` has become the one that ends the ray.
        voxels[n] = voxel
    return inside


@nb.njit(nogil=True)
def enter_box_into(grid: Grid, start: Floats, direction: Floats, at: float, voxel: Ints) -> float:
    """Range, from `at` on, at which a ray enters the box of all cells; infinite if it misses the box.

    `voxel` is the one that the ray is in at `at`, and becomes the one through which it enters.
    """
    if is_in_box(grid, voxel):
        return at
    # The ray is in the box while it is between all three pairs of planes.
    enters, leaves = at, np.inf
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
        # Rounding may put the point beyond a border that it lies on.
        reached = int(np.floor(start[axis] + enters * direction[axis]))
        voxel[axis] = min(max(reached, grid.low[axis]), grid.high[axis] - 1)
    return enters


@nb.njit(nogil=True, forceinline=True)
def is_in_box(grid: Grid, voxel: Ints) -> bool:
    """True if a voxel lies in the box of all cells."""
    inside = True
    for axis in range(3):
        inside &= (voxel[axis] >= grid.low[axis]) & (voxel[axis] < grid.high[axis])
    return inside


@nb.njit(nogil=True)
def walk_into(
    grid: Grid, start: Floats, direction: Floats, at: float, range_max: float, unknown_ends: np.uint64, voxel: Ints
) -> tuple[float, np.uint8]:
    """Range and state of the voxel that ends a ray, which enters `voxel` at `at`; `voxel` becomes that voxel."""
    depth, mask = grid.depth, (1 << grid.depth) - 1
    x, y, z = voxel[0], voxel[1], voxel[2]
    ray = ray_through(start, direction, x, y, z)
    cell_x, cell_y, cell_z, slot = NOWHERE, NOWHERE, NOWHERE, NONE
    end, state = np.inf, FREE
    # Invariant: the ray enters voxel (x, y, z) at range `at`, and nothing before it ends the ray.
    while at <= range_max:
        # The cell: looked up only when another one is entered.
        if (x >> depth != cell_x) | (y >> depth != cell_y) | (z >> depth != cell_z):
            voxel[0], voxel[1], voxel[2] = x, y, z
            if not is_in_box(grid, voxel):
                if unknown_ends:
                    end, state = at, UNKNOWN
                break
            cell_x, cell_y, cell_z = x >> depth, y >> depth, z >> depth
            slot = slot_of(grid, cell_x, cell_y, cell_z)
        # The block that can be crossed in one step: the cell if it is absent, else the brick if that is absent.
        size = 1 << depth
        brick = NONE
        place = 0
        if slot >= 0:
            place = place_of(x, y, z, mask)
            brick = signed(grid.bricks[U(slot), U(place >> 9)])
            size = 8
        if brick >= 0:
            # Else 4^3 voxels, one word of bits each for "occupied" and "known".
            b, w = U(brick), U((place >> 6) & 7)
            occupied = grid.words[b, w, OCCUPIED_BITS]
            ends = occupied | (~grid.words[b, w, KNOWN_BITS] & unknown_ends)
            size = 4
            if ends != U(0):
                x, y, z, at, bit, is_met = walk_block(ray, x, y, z, at, ends, U(place & 63))
                if not is_met:
                    continue
                if at <= range_max:
                    end = at
                    state = OCCUPIED if (occupied >> bit) & U(1) else UNKNOWN
                break
        elif unknown_ends:
            end, state = at, UNKNOWN
            break
        x, y, z, at = leave_block(ray, x, y, z, at, size)
    voxel[0], voxel[1], voxel[2] = x, y, z
    return end, state


@nb.njit(nogil=True, forceinline=True)
def ray_through(start: Floats, direction: Floats, x: int, y: int, z: int) -> Ray:
    """The ray of an origin and a unit direction, whose walk begins in voxel (x, y, z)."""
    start_x, inverse_x, up_x = along(start[0], direction[0], x)
    start_y, inverse_y, up_y = along(start[1], direction[1], y)
    start_z, inverse_z, up_z = along(start[2], direction[2], z)
    return Ray(
        (start_x, start_y, start_z),
        (inverse_x, inverse_y, inverse_z),
        (up_x, up_y, up_z),
        (direction[0], direction[1], direction[2]),
    )


@nb.njit(nogil=True, forceinline=True)
def along(start: float, direction: float, voxel: int) -> tuple[float, float, int]:
    """One axis of a `Ray`: its start, inverse direction, and -1 if it rises, else 0."""
    if abs(direction) < LEAST_DIRECTION:
        # No border is ever met: infinite ranges. In the middle of a voxel, because on a border 0 times infinity is NaN.
        return voxel + 0.5, np.inf, -1
    return start, 1 / direction, -1 if direction > 0 else 0


@nb.njit(nogil=True, forceinline=True)
def walk_block(
    ray: Ray, x: int, y: int, z: int, at: float, ends: np.uint64, bit: np.uint64
) -> tuple[int, int, int, float, np.uint64, bool]:
    """Walk voxel by voxel through a block of 4^3, until a voxel ends the ray or the block is left.

    The ray enters voxel (x, y, z), number `bit` of the block in Morton order, at range `at`; bit n of `ends` is set if
    voxel n ends the ray. Returns the voxel reached, its range and bit; and True if it ends the ray, False if it is
    beyond the block.
    """
    block_x, block_y, block_z = x & -4, y & -4, z & -4
    while (ends >> bit) & U(1) == U(0):
        # Ranges of the voxel's far borders; `up & 1` adds 1 on a rising axis.
        to_x = (x + (ray.up[0] & 1) - ray.start[0]) * ray.inverse[0]
        to_y = (y + (ray.up[1] & 1) - ray.start[1]) * ray.inverse[1]
        to_z = (z + (ray.up[2] & 1) - ray.start[2]) * ray.inverse[2]
        leaves = min(to_x, to_y, to_z)
        # Rounding must not lead back.
        at = max(at, leaves)
        # One step across each border that is met at that range: across an edge or a corner, too. `up | 1` is -1 or 1.
        x += (ray.up[0] | 1) * -int(to_x == leaves)
        y += (ray.up[1] | 1) * -int(to_y == leaves)
        z += (ray.up[2] | 1) * -int(to_z == leaves)
        if ((x ^ block_x) | (y ^ block_y) | (z ^ block_z)) & -4 != 0:
            return x, y, z, at, bit, False
        bit = U(place_of(x, y, z, 3))
    return x, y, z, at, bit, True


@nb.njit(nogil=True, forceinline=True)
def leave_block(ray: Ray, x: int, y: int, z: int, at: float, size: int) -> tuple[int, int, int, float]:
    """The voxel beyond the aligned block of `size`^3 voxels that holds (x, y, z), and the range of its border."""
    to_x = ((x & -size) + (ray.up[0] & size) - ray.start[0]) * ray.inverse[0]
    to_y = ((y & -size) + (ray.up[1] & size) - ray.start[1]) * ray.inverse[1]
    to_z = ((z & -size) + (ray.up[2] & size) - ray.start[2]) * ray.inverse[2]
    at = max(at, min(to_x, to_y, to_z))
    x = beyond(x, size, ray.up[0], ray.start[0] + at * ray.direction[0], to_x <= at)
    y = beyond(y, size, ray.up[1], ray.start[1] + at * ray.direction[1], to_y <= at)
    z = beyond(z, size, ray.up[2], ray.start[2] + at * ray.direction[2], to_z <= at)
    return x, y, z, at


@nb.njit(nogil=True, forceinline=True)
def beyond(voxel: int, size: int, up: int, reached: float, is_left: bool) -> int:
    """Voxel number along one axis when a block is left: the first beyond its border, or one inside it, not behind."""
    # `-size` is all bits set but those inside a block.
    low = voxel & -size
    if is_left:
        return low + size if up else low - 1
    # Within the block along this axis: rounding must lead neither behind the voxel nor out of the block.
    inside = int(np.floor(reached))
    return min(max(inside, voxel if up else low), low + size - 1 if up else voxel)
