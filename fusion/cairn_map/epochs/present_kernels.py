"""Kernels that read the rows of a cell: log-odds clamped from epoch to epoch, and the samples that are shown.

`number_words_into` makes log-odds small: a cell has few different ones, because they come from few small counts.

Rows and readings are lists of voxels, both rising, so each kernel walks them together once.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

ALONE_MIN = 3
"""Samples from which on the newest row is read alone."""
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio."""
AGREE_SIGMA = 3.0
"""Standard errors within which two means agree."""


@nb.njit(cache=True, nogil=True)
def add_counts_into(
    voxels: npt.NDArray[np.uint32],
    row_voxels: npt.NDArray[np.uint32],
    row_counts: npt.NDArray[np.int32],
    row: int,
    model: tuple[float, float, float, float, float],
    odds: npt.NDArray[np.float64],
    counts: npt.NDArray[np.int64],
    newest: npt.NDArray[np.int32],
    free_after: npt.NDArray[np.int32],
) -> None:
    """Add one row's counts to a reading, and clamp: rule R1.

    Args:
        voxels: (V,) those of the reading, among them all of the row.
        row_voxels: (R,) the row's.
        row_counts: (R, 2) hits and misses.
        row: number of the row.
        model: log-odds of a hit, of a miss, of the lower and the upper bound, and above which a voxel is occupied.
        odds: (V,) log-odds, changed.
        counts: (V, 2) sums, changed.
        newest: (V,) number of the newest row with counts, changed.
        free_after: (V,) number of the newest row after which the voxel read free, changed.
    """
    hit, miss, low, high, occupied = model
    at = 0
    for n in range(len(row_voxels)):
        # Both lists rise, and the reading has every voxel of the row.
        while voxels[at] != row_voxels[n]:
            at += 1
        hits, misses = row_counts[n, 0], row_counts[n, 1]
        if hits == 0 and misses == 0:
            continue
        # R1: Eq. 2 for the row's sums, Eq. 4 after each row.
        odds[at] = min(max(odds[at] + (hits * hit + misses * miss), low), high)
        counts[at, 0] += hits
        counts[at, 1] += misses
        # The age of the voxel, and the last time that it was seen through.
        newest[at] = row
        if odds[at] <= occupied:
            free_after[at] = row


@nb.njit(cache=True, nogil=True)
def join_samples_into(
    voxels: npt.NDArray[np.uint32],
    row_voxels: npt.NDArray[np.uint32],
    row_samples: npt.NDArray[np.int64],
    row: int,
    spec: npt.NDArray[np.int64],
    sigma: npt.NDArray[np.float64],
    joined: npt.NDArray[np.int64],
    free_after: npt.NDArray[np.int32],
    samples: npt.NDArray[np.int64],
    newest: npt.NDArray[np.int32],
    done: npt.NDArray[np.bool_],
) -> None:
    """Join one row's samples to those of newer rows, where rule R4 lets them be joined; rows come newest first.

    Args:
        voxels: (V,) those of the reading.
        row_voxels: (S,) voxels of the row that have samples.
        row_samples: (S, P) their sums.
        row: number of the row.
        spec: (C, 3) planes of each channel, how many of them are squares, and whether they are votes.
        sigma: (C,) standard deviation of one sample, in steps of the channel.
        joined: (C,) samples up to which older rows are joined.
        free_after: (V,) number of the newest row after which the voxel read free; older samples are not shown.
        samples: (V, P) sums shown, changed.
        newest: (V, C) number of the newest row with samples; -1: none; changed.
        done: (V, C) True where no older row is joined any more, changed.
    """
    at = 0
    for n in range(len(row_voxels)):
        while voxels[at] != row_voxels[n]:
            at += 1
        # Samples of what was taken away since are of nothing that is there.
        if row < free_after[at]:
            continue
        # Columns of channel c: [first, weight) are its sums, the last of them perhaps of squares.
        first = 0
        for c in range(spec.shape[0]):
            weight = first + spec[c, 0] - 1
            w, held = row_samples[n, weight], samples[at, weight]
            if w != 0 and not done[at, c]:
                # R4: the newest row is shown in any case, an older one if all means agree within the error of both.
                # Votes are joined up to as many, whether they agree or not: they are counts, not means.
                agrees = True
                if held != 0 and spec[c, 2] == 0:
                    bound = AGREE_SIGMA * sigma[c] * np.sqrt(1.0 / w + 1.0 / held)
                    for p in range(first, weight - spec[c, 1]):
                        agrees &= abs(row_samples[n, p] / w - samples[at, p] / held) <= bound
                if held == 0:
                    newest[at, c] = row
                # Enough is enough: older samples can only be of another state.
                if agrees:
                    for p in range(first, weight + 1):
                        samples[at, p] += row_samples[n, p]
                enough = joined[c] if held != 0 or spec[c, 2] != 0 else ALONE_MIN
                done[at, c] = not agrees or samples[at, weight] >= enough
            first = weight + 1


@nb.njit(cache=True, nogil=True)
def number_words_into(
    words: npt.NDArray[np.uint64],
    table: npt.NDArray[np.int32],
    hash_shift: int,
    palette: npt.NDArray[np.uint64],
    codes: npt.NDArray[np.uint16],
) -> int:
    """Number equal words alike, in order of appearance from 1 on; 0 stays free.

    Args:
        words: (N,) any.
        table: (H,) a hash table of numbers, zeros, a power of two and longer than the palette.
        hash_shift: 64 less the bits of H.
        palette: (K,) word of each number, changed.
        codes: (N,) the numbers, changed.

    Returns:
        One beyond the last number; -1 if there are more words than the palette takes.
    """
    count = 1
    for n in range(len(words)):
        # Linear probing from the hash on (Fibonacci hashing), to the word or to a free place.
        at = (words[n] * GOLDEN) >> np.uint64(hash_shift)
        while table[at] != 0 and palette[table[at]] != words[n]:
            at = (at + np.uint64(1)) & np.uint64(len(table) - 1)
        if table[at] == 0:
            if count == len(palette):
                return -1
            table[at] = count
            palette[count] = words[n]
            count += 1
        codes[n] = table[at]
    return count
