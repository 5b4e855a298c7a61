"""Sets of voxels of a whole map: the frontier, and the highest of each column; no checks."""

import numba as nb
import numpy as np

from cairn_map.arrays import Ints, Words
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, OCCUPIED_BITS, Grid, U, brick_of, place_of, x_in_block

ALL = ~U(0)


@nb.njit(cache=True, nogil=True)
def frontier_into(grid: Grid, corners: Ints, frontier: Words) -> int:
    """Set (B, 8) bits of the free voxels with an unknown one beside one of their faces; returns how many there are."""
    count = 0
    beside = np.empty(6, np.int64)
    for b in range(grid.words.shape[0]):
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
            if free == U(0) or (known == ALL and are_known_beside(grid, beside, b, w)):
                continue
            for n in range(64):
                if (free >> U(n)) & U(1) and has_unknown_beside(grid, beside, b, w, n):
                    frontier[b, w] |= U(1) << U(n)
                    count += 1
    return count


@nb.njit(nogil=True)
def are_known_beside(grid: Grid, beside: Ints, b: int, w: int) -> bool:
    """Whether all voxels of the six blocks beside a block of a brick are known."""
    for axis in range(3):
        other = w ^ (1 << axis)
        if grid.words[b, other, KNOWN_BITS] != ALL:
            return False
        brick = beside[2 * axis + ((w >> axis) & 1)]
        if brick < 0 or grid.words[brick, other, KNOWN_BITS] != ALL:
            return False
    return True


@nb.njit(nogil=True)
def has_unknown_beside(grid: Grid, beside: Ints, b: int, w: int, n: int) -> bool:
    """Whether one of the six voxels beside voxel n of a block of a brick is unknown."""
    x, y, z = 4 * (w & 1) + x_in_block(n), 2 * (w & 2) + x_in_block(n >> 1), (w & 4) + x_in_block(n >> 2)
    for side in range(6):
        step = 1 if side & 1 else -1
        vx = x + (step if side >> 1 == 0 else 0)
        vy = y + (step if side >> 1 == 1 else 0)
        vz = z + (step if side >> 1 == 2 else 0)
        brick = b if (vx | vy | vz) & -8 == 0 else beside[side]
        if brick < 0:
            return True
        place = place_of(vx, vy, vz, 7)
        if (grid.words[brick, place >> 6, KNOWN_BITS] >> U(place & 63)) & U(1) == U(0):
            return True
    return False


@nb.njit(cache=True, nogil=True)
def tops_into(grid: Grid, corners: Ints, low: Ints, high: Ints, tops: Ints) -> None:
    """Raise (H, W) numbers along z to those of the occupied voxels in a box, from `low` up to before `high`."""
    for b in range(grid.words.shape[0]):
        for w in range(8):
            occupied = grid.words[b, w, OCCUPIED_BITS]
            if occupied == U(0):
                continue
            for n in range(64):
                if (occupied >> U(n)) & U(1) == U(0):
                    continue
                x = corners[b, 0] + 4 * (w & 1) + x_in_block(n)
                y = corners[b, 1] + 2 * (w & 2) + x_in_block(n >> 1)
                z = corners[b, 2] + (w & 4) + x_in_block(n >> 2)
                if low[0] <= x < high[0] and low[1] <= y < high[1] and low[2] <= z < high[2]:
                    row, column = y - low[1], x - low[0]
                    tops[row, column] = max(tops[row, column], z)
