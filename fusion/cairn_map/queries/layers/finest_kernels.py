"""Voxels of a coarser layer that give way to a finer one: cleared in the words of its grid, and none is listed.

Edges are (3,) integers, micrometres along each axis, so that no centre of a finer voxel lies in two coarser ones. These
kernels check nothing.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Ints, Words
from cairn_map.kernels.integer_kernels import U
from cairn_map.queries.occupancy_kernels import (
    KNOWN_BITS,
    NONE,
    OCCUPIED_BITS,
    UNKNOWN,
    Grid,
    brick_of,
    place_of,
    state_in,
    x_in_block,
)

Number = tuple[int, int, int]


@nb.njit(cache=True, nogil=True)
def clear_met_into(
    words: Words, grid: Grid, edges_um: Ints, fine: Grid, fine_edges_um: Ints, corners: Ints, bricks: Ints
) -> None:
    """Make occupied voxels unknown in which lies the centre of an occupied voxel of a finer layer.

    Args:
        words: (B, 8, 2) of the coarser layer, changed in place.
        grid: of the coarser layer, whose bricks these words are.
        edges_um: of the coarser layer's voxels.
        fine: grid of the finer layer.
        fine_edges_um: of the finer layer's voxels.
        corners: (F, 3) first voxels of the finer layer's bricks.
        bricks: (M,) those of them that are looked at.
    """
    for m in range(bricks.shape[0]):
        b = bricks[m]
        for w in range(8):
            bits = fine.words[b, w, OCCUPIED_BITS]
            # Most blocks have no occupied voxel.
            if bits == U(0):
                continue
            for n in range(64):
                if not (bits >> U(n)) & U(1):
                    continue
                # The coarser voxel K that holds the centre of k: K E <= (k + 1/2) e < (K + 1) E.
                x, y, z = voxel_at(corners, b, w, n)
                x = ((2 * x + 1) * fine_edges_um[0]) // (2 * edges_um[0])
                y = ((2 * y + 1) * fine_edges_um[1]) // (2 * edges_um[1])
                z = ((2 * z + 1) * fine_edges_um[2]) // (2 * edges_um[2])
                # It gives way if it is occupied, too; a free one does so only if the finer layer knows all of it.
                brick = brick_of(grid, x, y, z)
                if brick != NONE:
                    place = place_of(x, y, z, 7)
                    is_occupied = (words[brick, place >> 6, OCCUPIED_BITS] >> U(place & 63)) & U(1)
                    clear_into(words, brick, place >> 6, is_occupied << U(place & 63))


@nb.njit(cache=True, nogil=True)
def clear_whole_into(
    words: Words, corners: Ints, bricks: Ints, edges_um: Ints, fine: Grid, fine_edges_um: Ints
) -> None:
    """Make voxels unknown of which a finer layer knows every voxel.

    Of a coarser voxel's finer ones all but the last that is looked at are known: so there are no more looks than known
    voxels in both layers.

    Args:
        words: (B, 8, 2) of the coarser layer, changed in place.
        corners: (B, 3) first voxels of its bricks.
        bricks: (M,) those of them that are looked at.
        edges_um: of the coarser layer's voxels.
        fine: grid of the finer layer.
        fine_edges_um: of the finer layer's voxels.
    """
    for m in range(bricks.shape[0]):
        b = bricks[m]
        for w in range(8):
            known = words[b, w, KNOWN_BITS]
            if known == U(0):
                continue
            # Voxel by voxel, those of one block as one word.
            gone = U(0)
            for n in range(64):
                if (known >> U(n)) & U(1):
                    x, y, z = voxel_at(corners, b, w, n)
                    # Finer voxels of which the centres lie in this one.
                    first = first_from(x, y, z, edges_um, fine_edges_um)
                    end = first_from(x + 1, y + 1, z + 1, edges_um, fine_edges_um)
                    gone |= U(is_known_whole(fine, first, end)) << U(n)
            clear_into(words, b, w, gone)


@nb.njit(nogil=True)
def is_known_whole(fine: Grid, first: Number, end: Number) -> bool:
    """True if there are voxels from `first` up to `end`, and all are known."""
    if first[0] >= end[0] or first[1] >= end[1] or first[2] >= end[2]:
        return False
    # Along x first, which changes the brick every eighth time at most; the first unknown voxel ends it.
    brick = NONE
    for z in range(first[2], end[2]):
        for y in range(first[1], end[1]):
            for x in range(first[0], end[0]):
                # A brick is found by its cell's number, which takes longer than all the rest.
                if x == first[0] or x & 7 == 0:
                    brick = brick_of(fine, x, y, z)
                if brick == NONE or state_in(fine.words, brick, place_of(x, y, z, 7)) == UNKNOWN:
                    return False
    return True


@nb.njit(inline="always")
def first_from(x: int, y: int, z: int, edges_um: Ints, fine_edges_um: Ints) -> Number:
    """First finer voxel, along each axis, whose centre is not below a coarser voxel's lower faces."""
    # k >= K E / e - 1/2, rounded up in integers.
    return (
        -((fine_edges_um[0] - 2 * x * edges_um[0]) // (2 * fine_edges_um[0])),
        -((fine_edges_um[1] - 2 * y * edges_um[1]) // (2 * fine_edges_um[1])),
        -((fine_edges_um[2] - 2 * z * edges_um[2]) // (2 * fine_edges_um[2])),
    )


@nb.njit(inline="always")
def voxel_at(corners: Ints, b: int, w: int, n: int) -> Number:
    """Number of voxel n of block w of a brick."""
    return (
        corners[b, 0] + 4 * (w & 1) + x_in_block(n),
        corners[b, 1] + 2 * (w & 2) + x_in_block(n >> 1),
        corners[b, 2] + (w & 4) + x_in_block(n >> 2),
    )


@nb.njit(inline="always")
def clear_into(words: Words, b: int, w: int, bits: np.uint64) -> None:
    """Make voxels of a block unknown."""
    words[b, w, OCCUPIED_BITS] &= ~bits
    words[b, w, KNOWN_BITS] &= ~bits
