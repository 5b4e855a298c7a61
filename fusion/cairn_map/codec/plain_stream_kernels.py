"""Kernels that write plain cells: from packed evidence to raw streams in two passes; the mirror of `plain_kernels`.

    first pass    presence bits and words of all channels, and how many bytes each column needs
    second pass   all streams, each at its place in the canonical bytes

    spec   (channels, 3) planes of each channel, how many are sums of squares, 1 if they are votes for classes
           (`channels.planes_and_squares`)

Streams are in the order of FORMAT.md section 6. The words of a channel stand in the order of its streams: weight first.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes, Int32s, Ints, Words, Words32
from cairn_map.codec.octree.sum_kernels import square_guess, zigzag
from cairn_map.codec.plain_kernels import CHANNELS_FROM, COLUMNS_FROM

Presence = npt.NDArray[np.uint8]
"""(channels, (N + 7) / 8) one bit per leaf, lowest bit first."""


@nb.njit(cache=True, nogil=True)
def bits_of_counts(counts: Int32s) -> tuple[int, int]:
    """All bits of the hits, and of the misses; negative if one of them is."""
    hits, misses = np.int32(0), np.int32(0)
    for n in range(counts.shape[0]):
        hits |= counts[n, 0]
        misses |= counts[n, 1]
    return int(hits), int(misses)


@nb.njit(cache=True, nogil=True)
def sample_words_into(
    leaf_rows: Ints,
    sampled: Words32,
    samples: Ints,
    spec: Ints,
    presence: Presence,
    words: npt.NDArray[np.uint64],
    rows: Ints,
    bits: Words,
) -> bool:
    """Write presence and words of all channels of S sampled rows; False, and stop, at a negative number.

    `leaf_rows` (N,) is the row at which each leaf begins. `presence` is zeros, `words` (P, S) takes the columns of each
    channel, weight first. `rows` (channels,), zeros, takes their lengths; `bits` (P,), zeros, all bits of each.
    """
    channels = spec.shape[0]
    # Row of `samples` that was the last one of each channel.
    before = np.zeros(channels, np.int64)
    leaf = 0
    for n in range(sampled.shape[0]):
        while leaf_rows[leaf] < sampled[n]:
            leaf += 1
        first = 0
        for c in range(channels):
            weight_at = first + spec[c, 0] - 1
            said = np.int64(0)
            for p in range(first, weight_at + 1):
                said |= samples[n, p]
            if said < 0:  # the highest bit of one of them
                return False
            if said != 0:
                presence[c, leaf >> 3] |= np.uint8(1 << (leaf & 7))
                _row_into(samples, n, before[c], first, weight_at, spec[c, 1], words, rows[c], bits)
                rows[c] += 1
                before[c] = n
            first = weight_at + 1
    return True


@nb.njit(nogil=True, forceinline=True)
def _row_into(
    samples: Ints,
    n: int,
    before: np.int64,
    first: int,
    weight_at: int,
    squares: np.int64,
    words: npt.NDArray[np.uint64],
    row: np.int64,
    bits: Words,
) -> None:
    """Write the words of one channel's sums of row n, after the channel's row `before`, as its column entry `row`."""
    weight = np.uint64(samples[n, weight_at])
    words[first, row] = weight
    bits[first] |= weight
    # Values, as residuals against the mean of the row before times this weight.
    weight_before = np.uint64(samples[before, weight_at]) if row > 0 else np.uint64(0)
    for p in range(first, weight_at - squares):
        guess = np.uint64(0)
        if weight_before != 0:
            guess = np.uint64(samples[before, p]) * weight
            if weight_before != 1:
                guess //= weight_before
        word = zigzag(np.uint64(samples[n, p]) - guess)
        words[p + 1, row] = word
        bits[p + 1] |= word
    # The sum of squares, as a residual against that of equal samples.
    if squares:
        guess = square_guess(np.uint64(samples[n, first]), weight) if weight != 0 else np.uint64(0)
        word = zigzag(np.uint64(samples[n, weight_at - 1]) - guess)
        words[weight_at, row] = word
        bits[weight_at] |= word


@nb.njit(cache=True, nogil=True)
def write_plain_into(
    data: Bytes,
    at: Ints,
    planes: Ints,
    leaf_rows: Ints,
    counts: Int32s,
    spec: Ints,
    presence: Presence,
    words: npt.NDArray[np.uint64],
    rows: Ints,
) -> None:
    """Write all streams but the masks, each from its place `at` on; `planes` is the number of planes of each column."""
    leaves = leaf_rows.shape[0]
    for column in range(2):
        s = COLUMNS_FROM + column
        _counts_into(data[at[s] :], planes[s], leaf_rows, counts, column)
    s = CHANNELS_FROM
    first = 0
    for c in range(spec.shape[0]):
        for n in range((leaves + 7) // 8):
            data[at[s] + n] = presence[c, n]
        for p in range(spec[c, 0]):
            _column_into(data[at[s + 1 + p] :], planes[s + 1 + p], words[first + p, : rows[c]])
        s += 1 + spec[c, 0]
        first += spec[c, 0]


@nb.njit(nogil=True)
def _counts_into(data: Bytes, planes: int | np.int64, leaf_rows: Ints, counts: Int32s, column: int) -> None:
    """Write a column of counts, one of each leaf."""
    leaves = leaf_rows.shape[0]
    data[0] = planes
    for p in range(planes):
        out = data[1 + p * leaves : 1 + (p + 1) * leaves]
        for n in range(leaves):
            out[n] = np.uint8((counts[leaf_rows[n], column] >> (8 * p)) & 255)


@nb.njit(nogil=True)
def _column_into(data: Bytes, planes: int | np.int64, words: Words) -> None:
    """Write a column of words: the number of its planes, then the planes, lowest bytes first."""
    rows = words.shape[0]
    data[0] = planes
    for p in range(planes):
        out = data[1 + p * rows : 1 + (p + 1) * rows]
        for n in range(rows):
            out[n] = np.uint8((words[n] >> np.uint64(8 * p)) & np.uint64(255))
