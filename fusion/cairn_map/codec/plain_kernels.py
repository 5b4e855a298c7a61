"""Kernels of plain cells: a whole unsigned cell from its raw streams, in two passes: sizes and checks, then numbers.

    data   all raw streams, one after the other       at, size   first byte of each, and its length
    spec   (channels, 3) planes of each channel, and how many are sums of squares (`channels.planes_and_squares`)

Streams are in the order of FORMAT.md section 6: child masks, leaf masks, hits, misses, and of each channel presence,
weight, values. One pass over all columns takes a fraction of a pass for each: most cells of a diff have some hundred
leaves.
"""

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Int32s, Ints, Words32
from cairn_map.codec.octree.octree_kernels import list_leaves_into, measure_masks, ones
from cairn_map.codec.octree.sum_kernels import square_guess, unzigzag

SOUND, BAD_MASKS, BAD_LEAVES, BAD_COLUMN, BAD_PRESENCE, BAD_NUMBER = range(6)
"""Results of the checks."""
COLUMNS_FROM = 2
"""Index of the first stream that is a column: hits."""
CHANNELS_FROM = 4
"""Index of the first stream of channels."""


@nb.njit(nogil=True)
def _column(data: Bytes, at: int, size: int, rows: int) -> tuple[bool, bool]:
    """Two answers: True if a column has the length of its planes; True if its largest number needs all of them."""
    # No more planes than needed: some number has its highest byte not 0.
    planes = np.int64(data[at]) if size > 0 else 9
    if planes > 8 or size != 1 + planes * rows:
        return False, False
    top = at + 1 + (planes - 1) * rows
    least = planes == 0
    for n in range(rows if planes > 0 else 0):
        if data[top + n] != 0:
            least = True
            break
    return True, least


@nb.njit(cache=True, nogil=True)
def measure_plain(data: Bytes, at: Ints, size: Ints, spec: Ints, leaves: int, firsts: Ints) -> tuple[int, int, bool]:
    """SOUND or the first fault; the number of leaves with samples; and True if every column has its fewest planes.

    `firsts` is filled as by `measure_masks`.
    """
    # Masks (section 4).
    child_masks, leaf_masks = data[at[0] : at[0] + size[0]], data[at[1] : at[1] + size[1]]
    masks, leaf_masks_read, found = measure_masks(child_masks, leaf_masks, firsts, firsts.shape[0] - 1)
    if masks < 0:
        return BAD_MASKS, 0, False
    if masks != size[0] or leaf_masks_read != size[1]:
        return BAD_MASKS, 0, False
    if found != leaves:
        return BAD_LEAVES, 0, False
    # Counts: columns of all leaves (section 5).
    fewest = True
    for s in range(COLUMNS_FROM, CHANNELS_FROM):
        fits, least = _column(data, at[s], size[s], leaves)
        if not fits:
            return BAD_COLUMN, 0, False
        fewest &= least
    # Channels: presence, one bit a leaf with spare bits 0; then columns of as many rows as bits are set.
    row_bytes = (leaves + 7) // 8
    s = CHANNELS_FROM
    for c in range(spec.shape[0]):
        if size[s] != row_bytes:
            return BAD_PRESENCE, 0, False
        if leaves & 7 and data[at[s] + row_bytes - 1] >> (leaves & 7) != 0:
            return BAD_PRESENCE, 0, False
        rows = 0
        for n in range(row_bytes):
            rows += ones(data[at[s] + n])
        for p in range(spec[c, 0]):
            fits, least = _column(data, at[s + 1 + p], size[s + 1 + p], rows)
            if not fits:
                return BAD_COLUMN, 0, False
            fewest &= least
        s += 1 + spec[c, 0]
    # Leaves with samples of any channel.
    sampled = 0
    for n in range(row_bytes):
        sampled += ones(_any_presence(data, at, spec, n))
    return SOUND, sampled, fewest


@nb.njit(cache=True, nogil=True)
def read_plain_into(
    data: Bytes,
    at: Ints,
    size: Ints,
    spec: Ints,
    firsts: Ints,
    limits: tuple[int, int],
    starts: Words32,
    sizes: Ints,
    counts: Int32s,
    sampled: Ints,
    samples: Ints,
) -> int:
    """Write leaves, counts and samples of streams that `measure_plain` found sound; returns SOUND or a fault.

    `limits` are those of a count and of a sum; `starts` and `sizes` have room for one more; `samples` (S, P) is zeros.
    """
    # Leaves and their counts.
    child_masks, leaf_masks = data[at[0] : at[0] + size[0]], data[at[1] : at[1] + size[1]]
    list_leaves_into(child_masks, leaf_masks, firsts, firsts.shape[0] - 1, starts, sizes)
    leaves = counts.shape[0]
    for column in range(2):
        s = COLUMNS_FROM + column
        if not _numbers_into(data, at[s], size[s], limits[0], counts, column):
            return BAD_NUMBER
    # Leaves with samples of any channel, then the samples channel by channel.
    S = 0
    for n in range((leaves + 7) // 8):
        bits = _any_presence(data, at, spec, n)
        for bit in range(8 if bits else 0):
            if (bits >> bit) & 1:
                sampled[S] = 8 * n + bit
                S += 1
    s = CHANNELS_FROM
    first = 0
    for c in range(spec.shape[0]):
        wrong = _channel_into(data, at[s:], size[s:], spec[c, 0], spec[c, 1] != 0, limits[1], first, sampled, samples)
        if wrong != SOUND:
            return wrong
        s += 1 + spec[c, 0]
        first += spec[c, 0]
    return SOUND


@nb.njit(nogil=True)
def _numbers_into(data: Bytes, at: int, size: int, limit: int, out: Int32s, column: int) -> bool:
    """Write a column of numbers; False if one is beyond the limit."""
    rows = out.shape[0]
    planes = np.int64(data[at])
    # Nearly all counts are below 256.
    if planes == 1:
        for n in range(np.uint64(rows)):
            out[n, column] = data[np.uint64(at + 1) + n]
        return True
    for n in range(rows):
        word = _word(data, at, n, rows)
        if word > np.uint64(limit):
            return False
        out[n, column] = np.int32(word)
    return True


@nb.njit(nogil=True)
def _channel_into(
    data: Bytes,
    at: Ints,
    size: Ints,
    planes: int,
    squares: bool,
    limit: int,
    first: int,
    sampled: Ints,
    samples: Ints,
) -> int:
    """Write one channel's sums, in columns from `first` on; `at` and `size` begin with its own streams."""
    values = planes - 1 - squares
    rows = 0
    for n in range(size[0]):
        rows += ones(data[at[0] + n])  # pyright: ignore[reportArgumentType]
    # Invariant: `row` rows of the channel are read; the last is sample `before` and has weight `weight_before`.
    row, before, weight_before = 0, 0, np.uint64(0)
    for s in range(sampled.shape[0]):
        leaf = sampled[s]
        if (data[at[0] + (leaf >> 3)] >> (leaf & 7)) & 1 == 0:
            continue
        weight = _word(data, at[1], row, rows)
        says, beyond = weight, weight > np.uint64(limit)
        # Values, as residuals against the mean of the row before times this weight.
        for p in range(values):
            guess = np.uint64(0)
            if weight_before != 0:
                guess = np.uint64(samples[before, first + p]) * weight
                if weight_before != 1:
                    guess //= weight_before
            word = guess + unzigzag(_word(data, at[2 + p], row, rows))
            says, beyond = says | word, beyond | (word > np.uint64(limit))
            samples[s, first + p] = np.int64(word)
        # The sum of squares, as a residual against that of equal samples.
        if squares:
            guess = square_guess(np.uint64(samples[s, first]), weight) if weight != 0 else np.uint64(0)
            word = guess + unzigzag(_word(data, at[2 + values], row, rows))
            says, beyond = says | word, beyond | (word > np.uint64(limit))
            samples[s, first + values] = np.int64(word)
        if beyond or says == 0:
            return BAD_NUMBER
        samples[s, first + planes - 1] = np.int64(weight)
        row, before, weight_before = row + 1, s, weight
    return SOUND


@nb.njit(nogil=True, forceinline=True)
def _word(data: Bytes, at: int, row: int, rows: int) -> np.uint64:
    """Number of a row in the column at `at`: a byte for the number of planes, then the planes."""
    word = np.uint64(0)
    for p in range(np.int64(data[at])):
        word |= np.uint64(data[at + 1 + p * rows + row]) << np.uint64(8 * p)
    return word


@nb.njit(nogil=True, forceinline=True)
def _any_presence(data: Bytes, at: Ints, spec: Ints, n: int) -> np.uint8:
    """Bits of those of eight leaves that have samples of any channel."""
    bits = np.uint8(0)
    s = CHANNELS_FROM
    for c in range(spec.shape[0]):
        bits |= data[at[s] + n]
        s += 1 + spec[c, 0]
    return bits  # pyright: ignore[reportReturnType]
