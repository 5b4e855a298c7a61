"""Counts of labelled pixels by voxel and class, and the votes that they make.

    slots    hash of a voxel -> one more than its row, 0: free      open addressing, at most half full
    voxels   (R, 3) voxel of each row
    heads    (R,) one more than the newest pair of each row
    nexts    (M,) one more than the next pair of the same row, 0: the last one
    classes  (M,) class of each pair, and pixels (M,) how many showed it

A voxel has a pair for each class that some pixel showed, so the cost is that of the pixels, however long the list of
classes is. The order of pixels changes the order of rows and pairs alone, and no vote.
tests/cairn_fusion/mapping/test_class_votes.py has the slow twin.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Int32s, Ints
from cairn_map.kernels.integer_kernels import signed


@nb.njit(cache=True, nogil=True)
def count_pixels_into(
    voxels: Ints,
    shown: Ints,
    slots: Int32s,
    known: Int32s,
    heads: Int32s,
    nexts: Int32s,
    classes: Bytes,
    pixels: Ints,
    rows: int,
    pairs: int,
) -> tuple[int, int]:
    """Count (N,) pixels of the voxels (N, 3) and classes that they show; returns rows and pairs used.

    Args:
        voxels: voxel of each pixel.
        shown: its class; below 0 it says nothing.
        slots: a power of two of them, twice as many as rows can become at least.
        known: `voxels` of the table, (R, 3), with room for N more rows.
        heads: with room likewise.
        nexts: with room for N more pairs, as `classes` and `pixels`.
        classes: of the table.
        pixels: of the table.
        rows: rows used so far.
        pairs: pairs used so far.
    """
    mask = len(slots) - 1
    row = -1
    for n in range(len(voxels)):
        if shown[n] < 0:
            continue
        x, y, z = voxels[n, 0], voxels[n, 1], voxels[n, 2]
        # Neighbouring pixels often show the same voxel.
        if row < 0 or (known[row, 0] != x) | (known[row, 1] != y) | (known[row, 2] != z):
            # The voxel's row: probes go on from slot to slot until it, or a free one, is met.
            slot = hash_of(x, y, z) & mask
            while slots[slot] != 0:
                row = signed(slots[slot]) - 1
                if (known[row, 0] == x) & (known[row, 1] == y) & (known[row, 2] == z):
                    break
                slot = (slot + 1) & mask
            if slots[slot] == 0:
                known[rows, 0], known[rows, 1], known[rows, 2] = x, y, z
                heads[rows] = 0
                rows += 1
                slots[slot] = rows
                row = rows - 1
        # Its pair for the class.
        pair = signed(heads[row]) - 1
        while pair >= 0 and classes[pair] != shown[n]:
            pair = signed(nexts[pair]) - 1
        if pair < 0:
            pair = pairs
            nexts[pair], classes[pair], pixels[pair] = heads[row], shown[n], 0
            pairs += 1
            heads[row] = pairs
        pixels[pair] += 1
    return rows, pairs


@nb.njit(cache=True, nogil=True)
def place_rows_into(known: Int32s, slots: Int32s) -> None:
    """Enter (R, 3) different voxels into free slots, a power of two of them and more than R."""
    mask = len(slots) - 1
    for row in range(len(known)):
        slot = hash_of(known[row, 0], known[row, 1], known[row, 2]) & mask
        while slots[slot] != 0:
            slot = (slot + 1) & mask
        slots[slot] = row + 1


@nb.njit(cache=True, nogil=True)
def votes_into(
    heads: Int32s, nexts: Int32s, classes: Bytes, pixels: Ints, most: int, winners: Ints, weights: Ints
) -> None:
    """Write the vote of each row: the class with the most pixels, of equal ones the smaller, and its weight to `most`.

    The weight is the lead over the next class in pixels, at most its share of all pixels in parts of `most`, rounded
    up, and at least 1.
    """
    for row in range(len(heads)):
        total, first, second, winner = 0, 0, 0, 0
        pair = signed(heads[row]) - 1
        while pair >= 0:
            count = signed(pixels[pair])
            total += count
            if count > first or (count == first and classes[pair] < winner):
                second, first, winner = first, count, signed(classes[pair])
            elif count > second:
                second = count
            pair = signed(nexts[pair]) - 1
        lead = first - second
        share = (most * lead + total - 1) // total
        winners[row], weights[row] = winner, max(1, min(lead, share))


@nb.njit(cache=True, nogil=True)
def add_votes_into(sums: Ints, at: Ints, winners: Ints, weights: Ints) -> None:
    """Add (N,) votes to rows `at` of (S, P) sums: a plane for each class but the last, and the weight in the last."""
    last = sums.shape[1] - 1
    for n in range(len(at)):
        if winners[n] < last:
            sums[at[n], winners[n]] += weights[n]
        sums[at[n], last] += weights[n]


@nb.njit(nogil=True, forceinline=True)
def hash_of(x: np.integer, y: np.integer, z: np.integer) -> int:
    """A number from 0 of a voxel, whose lower bits differ for neighbours (Teschner et al. 2003, mixed once more)."""
    mixed = (signed(x) * 73856093) ^ (signed(y) * 19349663) ^ (signed(z) * 83492791)
    return (mixed ^ (mixed >> 15)) & 0x7FFFFFFFFFFFFFFF
