"""Sets of voxels of a whole map: the frontier between free and unknown, and the highest voxel of each column.

Each brick is read as eight blocks of 4^3 voxels, one word of 64 bits each. These kernels check nothing.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Ints, Words
from cairn_map.kernels.integer_kernels import U
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, OCCUPIED_BITS, Grid, brick_of, place_of, x_in_block

ALL = ~U(0)
"""The word of a block whose voxels are all in the set."""


@nb.njit(cache=True, nogil=True)
def frontier_into(grid: Grid, corners: Ints, frontier: Words) -> int:
    """Write (B, 8) bits of the free voxels of which a face borders on an unknown voxel; returns their number."""
    count = 0
    beside = np.empty(6, np.int64)
    for b in range(grid.words.shape[0]):
        # The six bricks across the faces, or NONE: side 2 * axis is below, side 2 * axis + 1 above.
        for side in range(6):
            step = 8 if side & 1 else -8
            x = corners[b, 0] + (step if side >> 1 == 0 else 0)
            y = corners[b, 1] + (step if side >> 1 == 1 else 0)
            z = corners[b, 2] + (step if side >> 1 == 2 else 0)
            beside[side] = brick_of(grid, x, y, z)
        for w in range(8):
            known = grid.words[b, w, KNOWN_BITS]
            free = known & ~grid.words[b, w, OCCUPIED_BITS]
            frontier[b, w] = 0
            # Most blocks lie within known space: seven words tell, and no voxel is looked at.
            if free == U(0) or (known == ALL and are_known_beside(grid, beside, b, w)):
                continue
            # Else voxel by voxel.
            for n in range(64):
                if (free >> U(n)) & U(1) and has_unknown_beside(grid, beside, b, w, n):
                    frontier[b, w] |= U(1) << U(n)
                    count += 1
    return count


@nb.njit(nogil=True)
def are_known_beside(grid: Grid, beside: Ints, b: int, w: int) -> bool:
    """True if all voxels of the six blocks next to block w of brick b are known."""
    for axis in range(3):
        # A brick has two blocks along an axis: one neighbour is the other block, one lies in the next brick.
        other = w ^ (1 << axis)
        if grid.words[b, other, KNOWN_BITS] != ALL:
            return False
        brick = beside[2 * axis + ((w >> axis) & 1)]
        if brick < 0 or grid.words[brick, other, KNOWN_BITS] != ALL:
            return False
    return True


@nb.njit(nogil=True)
def has_unknown_beside(grid: Grid, beside: Ints, b: int, w: int, n: int) -> bool:
    """True if one of the six voxels next to voxel n of block w of brick b is unknown."""
    x, y, z = 4 * (w & 1) + x_in_block(n), 2 * (w & 2) + x_in_block(n >> 1), (w & 4) + x_in_block(n >> 2)
    for side in range(6):
        step = 1 if side & 1 else -1
        vx = x + (step if side >> 1 == 0 else 0)
        vy = y + (step if side >> 1 == 1 else 0)
        vz = z + (step if side >> 1 == 2 else 0)
        brick = b if (vx | vy | vz) & -8 == 0 else beside[side]  # any of them is -1 or 8: outside of the brick
        if brick < 0:
            return True
        place = place_of(vx, vy, vz, 7)
        if (grid.words[brick, place >> 6, KNOWN_BITS] >> U(place & 63)) & U(1) == U(0):
            return True
    return False


@nb.njit(cache=True, nogil=True)
def tops_into(grid: Grid, corners: Ints, low: Ints, high: Ints, tops: Ints) -> None:
    """Raise (H, W) z numbers to those of the occupied voxels in the box from `low` up to, but without, `high`."""
    for b in range(grid.words.shape[0]):
        for w in range(8):
            occupied = grid.words[b, w, OCCUPIED_BITS]
            if occupied == U(0):
                continue
            for n in range(64):
                if (occupied >> U(n)) & U(1) == U(0):
                    continue
                # Number of the voxel: of its brick, its block in the brick, and its place in the block.
                x = corners[b, 0] + 4 * (w & 1) + x_in_block(n)
                y = corners[b, 1] + 2 * (w & 2) + x_in_block(n >> 1)
                z = corners[b, 2] + (w & 4) + x_in_block(n >> 2)
                if low[0] <= x < high[0] and low[1] <= y < high[1] and low[2] <= z < high[2]:
                    row, column = y - low[1], x - low[0]
                    tops[row, column] = max(tops[row, column], z)
