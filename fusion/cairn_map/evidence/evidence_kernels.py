"""Bounds, checks and fingerprint of packed evidence, in one pass each: NumPy takes thirty times as long on short rows.

    spec   (channels, 3) planes of each channel, how many of them are sums of squares, and whether they are votes
           for classes (`planes_and_squares`)

The planes of a channel are its sums, its sums of squares, and its weight, in this order.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

GAMMA = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
"""Constants of SplitMix64: 2^64 over the golden ratio, and two multipliers."""


@nb.njit(cache=True, nogil=True)
def bounds_of_counts(counts: npt.NDArray[np.int32]) -> tuple[int, int, int, int]:
    """Least count, and greatest hits, misses and sum of both in one row; the first at most 0, the others at least 0."""
    # int64: the sum of two counts may need 33 bits.
    low, hits, misses, total = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for n in range(len(counts)):
        hit, miss = np.int64(counts[n, 0]), np.int64(counts[n, 1])
        low = min(low, hit, miss)
        hits = max(hits, hit)
        misses = max(misses, miss)
        total = max(total, hit + miss)
    return int(low), int(hits), int(misses), int(total)


@nb.njit(cache=True, nogil=True)
def largest_into(samples: npt.NDArray[np.int64], tops: npt.NDArray[np.int64]) -> None:
    """Raise (P,) `tops` to the largest number of each plane of (S, P) samples."""
    for n in range(samples.shape[0]):
        for p in range(samples.shape[1]):
            tops[p] = max(tops[p], samples[n, p])


@nb.njit(cache=True, nogil=True)
def sums_without_weight(samples: npt.NDArray[np.int64], spec: npt.NDArray[np.int64]) -> bool:
    """True if a row has a sum in a channel of which it has no weight, or more votes for named classes than votes."""
    # Columns of channel c: [first, weight) are its sums, `weight` is its weight.
    first = 0
    for c in range(spec.shape[0]):
        weight = first + spec[c, 0] - 1
        for n in range(samples.shape[0]):
            if samples[n, weight] == 0:
                for p in range(first, weight):
                    if samples[n, p] != 0:
                        return True
            elif spec[c, 2] != 0:
                # Class by class, so that no sum can wrap around.
                left = samples[n, weight]
                for p in range(first, weight):
                    left -= samples[n, p]
                    if left < 0:
                        return True
        first = weight + 1
    return False


@nb.njit(cache=True, nogil=True)
def channel_above(samples: npt.NDArray[np.int64], spec: npt.NDArray[np.int64], limit: int) -> int:
    """First channel of which a row has a mean beyond the limit, or a mean square beyond its square; -1 if none has.

    The products with the weights are in range.
    """
    # Columns of channel c: sums from `first`, sums of squares from `squares`, then the weight.
    first = 0
    for c in range(spec.shape[0]):
        weight = first + spec[c, 0] - 1
        squares = weight - spec[c, 1]
        for n in range(samples.shape[0]):
            for p in range(first, weight):
                # sum / weight > limit, without a division.
                if samples[n, p] > samples[n, weight] * (limit * limit if p >= squares else limit):
                    return c
        first = weight + 1
    return -1


@nb.njit(inline="always")
def mix(x: np.uint64) -> np.uint64:
    """One step of SplitMix64 (Steele, Lea, Flood 2014): a bijection of 64-bit words that scatters well."""
    x = x + GAMMA
    x = (x ^ (x >> np.uint64(30))) * MIX_1
    x = (x ^ (x >> np.uint64(27))) * MIX_2
    return x ^ (x >> np.uint64(31))


@nb.njit(cache=True, nogil=True)
def cell_seeds(cell: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Seeds of the two sums of a cell's fingerprint."""
    return mix(cell), mix(~cell)


@nb.njit(cache=True, nogil=True)
def epoch_seeds(cell: np.uint64, epoch: np.int64) -> tuple[np.uint64, np.uint64]:
    """The same for the row of an epoch: evidence that moves to another epoch has another fingerprint."""
    step = np.uint64(epoch) + np.uint64(1)
    return mix(mix(cell) + step), mix(mix(~cell) + step)


@nb.njit(cache=True, nogil=True)
def weighted_sums(
    first_seed: np.uint64,
    second_seed: np.uint64,
    voxels: npt.NDArray[np.uint32],
    counts: npt.NDArray[np.int32],
    sampled: npt.NDArray[np.uint32],
    samples: npt.NDArray[np.int64],
) -> tuple[np.uint64, np.uint64]:
    """Two sums, mod 2^64, of value times the odd pseudo-random weight of (seed, voxel, plane).

    Planes 0 and 1 are hits and misses, those of samples follow. Sums mod 2^64 add as evidence adds; two of them with
    independent weights, because one of 64 bits would collide too often.
    """
    # The weight is odd, so that it has an inverse mod 2^64: no single change of a value is lost.
    first = np.uint64(0)
    second = np.uint64(0)
    one = np.uint64(1)
    # Counts; zeros add nothing.
    for n in range(voxels.shape[0]):
        place = np.uint64(voxels[n]) << np.uint64(8)
        for c in range(2):
            if counts[n, c] != 0:
                value = np.uint64(np.int64(counts[n, c]))
                first += value * (mix(first_seed ^ (place | np.uint64(c))) | one)
                second += value * (mix(second_seed ^ (place | np.uint64(c))) | one)
    # Samples.
    for n in range(sampled.shape[0]):
        place = np.uint64(voxels[sampled[n]]) << np.uint64(8)
        for p in range(samples.shape[1]):
            if samples[n, p] != 0:
                value = np.uint64(samples[n, p])
                first += value * (mix(first_seed ^ (place | np.uint64(p + 2))) | one)
                second += value * (mix(second_seed ^ (place | np.uint64(p + 2))) | one)
    return first, second
