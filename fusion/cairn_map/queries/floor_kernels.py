"""Columns of a map, looked at from the top of a height band down to the ground, sixteen at a time.

A word of 64 bits holds the 4^3 voxels of a block; each of its four horizontal layers is moved to the same 16 bits,
one a column. So a column costs a few instructions a layer. These kernels check nothing.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints
from cairn_map.kernels.integer_kernels import U
from cairn_map.queries.occupancy_kernels import KNOWN_BITS, OCCUPIED_BITS, Grid, brick_of, x_in_block

LAYER = U(0x0F0F0F0F)
"""Bits of a block's lowest layer; those of the second are higher by 4, of the third by 32, of the fourth by 36."""
ONE, NO_COLUMN = U(1), U(0)
OCCUPIED, FREE = np.int8(100), np.int8(0)


@nb.njit(inline="always")
def shift_of(z: int) -> np.uint64:
    """Bits by which the layer that holds height z lies above the lowest layer of its block."""
    return U(4 * (z & 1) + 16 * (z & 2))


@nb.njit(nogil=True)
def look_down(
    grid: Grid, corner_x: int, corner_y: int, w: int, zone_low: int, band_low: int, band_high: int
) -> tuple[np.uint64, np.uint64]:
    """Occupied columns and free columns of the 16 in block column w (0 to 3) of the brick column at a corner."""
    occupied, clear, ground = NO_COLUMN, LAYER, NO_COLUMN
    for k in range((band_high - 1) >> 3, (zone_low >> 3) - 1, -1):
        brick = brick_of(grid, corner_x, corner_y, 8 * k)
        # All unknown: nothing below can be free any more, but obstacles of the band may still come.
        if brick < 0:
            clear = NO_COLUMN
            continue
        for z in range(min(8 * k + 7, band_high - 1), max(8 * k, zone_low) - 1, -1):
            block = U(w | (z & 4))
            hit = (grid.words[U(brick), block, OCCUPIED_BITS] >> shift_of(z)) & LAYER
            known = (grid.words[U(brick), block, KNOWN_BITS] >> shift_of(z)) & LAYER
            # In the band a hit is an obstacle; below it, under nothing but free voxels, the ground.
            if z >= band_low:
                occupied |= hit
            else:
                ground |= clear & hit
            # Invariant: clear holds the columns of which all from the band's top down to z is known free.
            clear &= known & ~hit
    return occupied, ground


@nb.njit(cache=True, nogil=True)
def columns_into(
    grid: Grid, low: Ints, high: Ints, zone_low: int, band_low: int, band_high: int, columns: npt.NDArray[np.int8]
) -> None:
    """Write OCCUPIED and FREE into (H, W) columns, of voxels from `low` up to, but without, `high`; others are kept."""
    # Brick column by brick column, and in it by its four block columns.
    for corner_y in range(low[1] & -8, high[1], 8):
        for corner_x in range(low[0] & -8, high[0], 8):
            for w in range(4):
                occupied, free = look_down(grid, corner_x, corner_y, w, zone_low, band_low, band_high)
                if occupied | free == NO_COLUMN:
                    continue
                # Most block columns of a map's box are unknown; of the others each column is written by itself.
                for n in range(28):
                    bit = ONE << U(n)
                    if (occupied | free) & bit == NO_COLUMN:
                        continue
                    # Place in the brick column: of the block, and in it.
                    x = corner_x + 4 * (w & 1) + x_in_block(n)
                    y = corner_y + 2 * (w & 2) + x_in_block(n >> 1)
                    if low[0] <= x < high[0] and low[1] <= y < high[1]:
                        columns[y - low[1], x - low[0]] = OCCUPIED if occupied & bit else FREE


@nb.njit(nogil=True)
def columns_in(bits: np.uint64) -> int:
    """Number of the columns of a layer that are set."""
    count = 0
    while bits != NO_COLUMN:
        bits &= bits - ONE  # the lowest bit is gone
        count += 1
    return count


@nb.njit(cache=True, nogil=True)
def surfaces_into(grid: Grid, corners: Ints, counts: Ints) -> None:
    """Add to (Z,) counts, by height above the lowest voxel: occupied voxels with a known free one on them."""
    # Layer by layer of each brick, sixteen columns at a time.
    for b in range(grid.words.shape[0]):
        above = brick_of(grid, corners[b, 0], corners[b, 1], corners[b, 2] + 8)
        for w in range(4):
            for z in range(8):
                hit = (grid.words[b, w | (z & 4), OCCUPIED_BITS] >> shift_of(z)) & LAYER
                if hit == NO_COLUMN:
                    continue
                # The layer on it: of this brick, or the lowest of the brick above.
                over = b if z < 7 else above
                if over < 0:
                    continue
                block, shift = w | ((z + 1) & 4), shift_of((z + 1) & 7)
                known = (grid.words[over, block, KNOWN_BITS] >> shift) & LAYER
                free = known & ~((grid.words[over, block, OCCUPIED_BITS] >> shift) & LAYER)
                counts[corners[b, 2] + z - grid.low[2]] += columns_in(hit & free)
