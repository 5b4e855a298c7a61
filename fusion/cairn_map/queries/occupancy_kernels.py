"""Occupancy states of a map's voxels, two bits each, found by the voxel's number: the grid that queries read.

    cell (i, j, k)  --hash-->  slot  --bricks[slot, Morton number of a brick]-->  b or -1
    words [b, 8, 2]            64 bits for each 4^3 block of a brick: which voxels are occupied, which are known

Voxels are in Morton order. All that lies in no brick, or in no cell, is unknown. These kernels check nothing.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Int32s, Ints, Words
from cairn_map.evidence.grid import CELL_LIMIT, NANOMETRES
from cairn_map.kernels.integer_kernels import U, signed
from cairn_map.kernels.morton_kernels import squeeze

Pool = npt.NDArray[np.int16] | npt.NDArray[np.int32]

UNKNOWN, FREE, OCCUPIED = np.uint8(0), np.uint8(1), np.uint8(2)
OCCUPIED_BITS, KNOWN_BITS = U(0), U(1)
NONE = -1
SPREAD = np.array([sum(((v >> b) & 1) << (3 * b) for b in range(8)) for v in range(256)], np.uint32)
"""By the eight bits of a voxel's place along one axis: the same bits with two zero bits between neighbours."""
HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio (Fibonacci hashing): numbers that differ little are spread far."""


class Grid(NamedTuple):
    """Occupancy states of a map as arrays."""

    edge_nm: int
    """Edge of a voxel, nanometres."""
    depth: int
    """Octree depth of a cell: it has 2^depth voxels along an edge."""
    numbers: Ints
    """(H,) numbers of cells in a hash table with linear probing, a power of two long and never full; -1 is free."""
    slots: Int32s
    """(H,) slots, which are rows of `bricks`, of the cells in `numbers`."""
    hash_shift: int
    """64 less the bits of H: the highest bits of a hash are its place."""
    cells: Ints
    """(C, 3) numbers of the cells by slot, rising in Morton order."""
    low: Ints
    """(3,) first voxel of the box of all cells."""
    high: Ints
    """(3,) one beyond its last voxel."""
    bricks: Int32s
    """(C, 8^(depth - 3)) rows of the words below, or -1."""
    words: Words
    """(B, 8, 2): OCCUPIED_BITS and KNOWN_BITS next to each other, because who reads one reads the other."""


@nb.njit(inline="always")
def _number_of(i: int, j: int, k: int) -> int:
    """Key in the hash table of a cell inside the numbered space: 21 bits for each axis."""
    return ((i + CELL_LIMIT) << 42) | ((j + CELL_LIMIT) << 21) | (k + CELL_LIMIT)


@nb.njit(cache=True, nogil=True)
def fill_table_into(cells: Ints, numbers: Ints, slots: Int32s, hash_shift: int) -> None:
    """Enter (C, 3) cells into an empty hash table."""
    for c in range(cells.shape[0]):
        # The first free place from the hash on.
        number = _number_of(cells[c, 0], cells[c, 1], cells[c, 2])
        at = (U(number) * HASH) >> U(hash_shift)
        while numbers[at] >= 0:
            at = (at + U(1)) & U(numbers.shape[0] - 1)
        numbers[at] = number
        slots[at] = c


@nb.njit(nogil=True)
def slot_of(grid: Grid, i: int, j: int, k: int) -> int:
    """The slot of a cell, or NONE; i, j and k are any integers."""
    # Outside of the numbered space: some number needs more than 21 bits, or is negative.
    if ((i + CELL_LIMIT) | (j + CELL_LIMIT) | (k + CELL_LIMIT)) >> 21 != 0:
        return NONE
    number = _number_of(i, j, k)
    at = (U(number) * HASH) >> U(grid.hash_shift)
    # Linear probing; the table is never full, so a free place ends the search.
    while True:
        found = grid.numbers[at]
        if found == number:
            return signed(grid.slots[at])
        if found < 0:
            return NONE
        at = (at + U(1)) & U(grid.numbers.shape[0] - 1)


@nb.njit(inline="always")
def place_of(x: int, y: int, z: int, mask: int) -> int:
    """Morton code of a voxel inside its cell; `mask` is the cell's side less one."""
    low = SPREAD[U(x & mask)] | (SPREAD[U(y & mask)] << np.uint32(1)) | (SPREAD[U(z & mask)] << np.uint32(2))
    return signed(low)


@nb.njit(nogil=True)
def brick_of(grid: Grid, x: int, y: int, z: int) -> int:
    """The brick that holds a voxel, or NONE if it is in no brick or no cell."""
    slot = slot_of(grid, x >> grid.depth, y >> grid.depth, z >> grid.depth)
    if slot < 0:
        return NONE
    # The place in the cell, without the 9 bits of a voxel in its brick.
    place = place_of(x, y, z, (1 << grid.depth) - 1)
    return signed(grid.bricks[U(slot), U(place >> 9)])


@nb.njit(inline="always")
def state_in(words: Words, brick: int, place: int) -> np.uint8:
    """State of the voxel at a place of a brick; bits of the place above the lowest nine are ignored."""
    b, w, bit = U(brick), U((place >> 6) & 7), U(place & 63)
    occupied, known = words[b, w, OCCUPIED_BITS] >> bit, words[b, w, KNOWN_BITS] >> bit
    return np.uint8(occupied & U(1)) + np.uint8(known & U(1))  # UNKNOWN 0, FREE 1, OCCUPIED 2


@nb.njit(nogil=True)
def state_of(grid: Grid, x: int, y: int, z: int) -> np.uint8:
    """State of a voxel, by its number."""
    brick = brick_of(grid, x, y, z)
    if brick < 0:
        return UNKNOWN
    return state_in(grid.words, brick, place_of(x, y, z, 7))


@nb.njit(nogil=True)
def voxel_of(position_m: float, edge_nm: int) -> int:
    """Number, along one axis, of the voxel that holds a position.

    The position is rounded to whole nanometres, half to even; then the floor is exact, in integers.
    """
    nanometres = int(np.rint(position_m * NANOMETRES))
    # Off by one at most, which the rest corrects; an integer division takes longer.
    voxel = int(np.floor(nanometres * (1.0 / edge_nm)))
    rest = nanometres - voxel * edge_nm
    return voxel + int(rest >= edge_nm) - int(rest < 0)


@nb.njit(cache=True, nogil=True)
def states_of_counts_into(pool: Pool, of_hits: Floats, of_misses: Floats, least: float, words: Words) -> None:
    """Write the (B, 8, 2) words of a pool (B, 512, 2) of hits and misses, 16 bits each.

    `of_hits` and `of_misses` are the log-odds of as many, (65536,) by the count's bits, so that the sum is the very
    one of `SensorModel`: a product made here could round otherwise, and a tie would fall to the other side. A voxel is
    occupied if its log-odds are above `least`.
    """
    for b in range(U(pool.shape[0])):
        for w in range(U(8)):
            occupied, known = U(0), U(0)
            # One bit of each word a voxel; log-odds by OctoMap's Eq. 2, not clamped: the threshold lies between the
            # clamps.
            for n in range(U(64)):
                hits, misses = pool[b, w * U(64) + n, 0], pool[b, w * U(64) + n, 1]
                seen = (hits | misses) != 0
                odds = of_hits[np.uint16(hits)] + of_misses[np.uint16(misses)]
                known |= U(seen) << n
                occupied |= U(seen and odds > least) << n
            words[b, w, OCCUPIED_BITS] = occupied
            words[b, w, KNOWN_BITS] = known


@nb.njit(cache=True, nogil=True)
def states_of_odds_into(pool: Pool, steps: npt.NDArray[np.int16], words: Words) -> None:
    """Write the (B, 8, 2) words of a reading: (B, 512, 2) hits and misses, and (B, 512) steps above the threshold."""
    for b in range(U(pool.shape[0])):
        for w in range(U(8)):
            occupied, known = U(0), U(0)
            # One bit of each word a voxel. Only counts make it known; its log-odds are above the threshold if and only
            # if its steps are above 0.
            for n in range(U(64)):
                seen = (pool[b, w * U(64) + n, 0] | pool[b, w * U(64) + n, 1]) != 0
                known |= U(seen) << n
                occupied |= U(seen and steps[b, w * U(64) + n] > 0) << n
            words[b, w, OCCUPIED_BITS] = occupied
            words[b, w, KNOWN_BITS] = known


@nb.njit(inline="always")
def x_in_block(n: int) -> int:
    """Place along x of voxel n of a 4^3 block; along y and z pass n >> 1 and n >> 2."""
    return (n & 1) | ((n >> 2) & 2)


@nb.njit(cache=True, nogil=True)
def brick_corners_into(grid: Grid, corners: Ints) -> None:
    """Write (B, 3) first voxels of all bricks."""
    for slot in range(grid.bricks.shape[0]):
        for b in range(grid.bricks.shape[1]):
            brick = grid.bricks[slot, b]
            if brick >= 0:
                # b is the brick's Morton code in the cell; a brick has 8 voxels along an edge.
                for axis in range(3):
                    corners[brick, axis] = (grid.cells[slot, axis] << grid.depth) + 8 * signed(squeeze(U(b >> axis)))


@nb.njit(cache=True, nogil=True)
def list_bits_into(words: Words, corners: Ints, out: Ints) -> None:
    """Write (M, 3) numbers of the M voxels of a set (B, 8), brick by brick in Morton order."""
    m = 0
    for b in range(words.shape[0]):
        for w in range(8):
            bits = words[b, w]
            if bits == 0:
                continue
            for n in range(64):
                if (bits >> U(n)) & U(1):
                    # Brick, block in the brick, place in the block.
                    out[m, 0] = corners[b, 0] + 4 * (w & 1) + x_in_block(n)
                    out[m, 1] = corners[b, 1] + 2 * (w & 2) + x_in_block(n >> 1)
                    out[m, 2] = corners[b, 2] + (w & 4) + x_in_block(n >> 2)
                    m += 1
