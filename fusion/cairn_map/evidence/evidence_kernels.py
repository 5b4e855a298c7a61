"""Bounds of packed evidence in one pass; numpy's reductions over short rows take thirty times as long.

spec   (channels, 2) planes of each channel, and how many of them are sums of squares (`channels.planes_and_squares`)
"""

import numba as nb
import numpy as np
import numpy.typing as npt


@nb.njit(cache=True, nogil=True)
def bounds_of_counts(counts: npt.NDArray[np.int32]) -> tuple[int, int, int, int]:
    """Least count, and greatest hits, misses and sum of both in one row; zeros without rows, and at least zeros."""
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
    """Whether a row has a sum in a channel of which it has no weight."""
    first = 0
    for c in range(spec.shape[0]):
        weight = first + spec[c, 0] - 1
        for n in range(samples.shape[0]):
            if samples[n, weight] == 0:
                for p in range(first, weight):
                    if samples[n, p] != 0:
                        return True
        first = weight + 1
    return False


@nb.njit(cache=True, nogil=True)
def channel_above(samples: npt.NDArray[np.int64], spec: npt.NDArray[np.int64], limit: int) -> int:
    """The first channel of which a row has a mean beyond the limit, or a mean square beyond its square; -1 if none has.

    The products with the weights are in range.
    """
    first = 0
    for c in range(spec.shape[0]):
        weight = first + spec[c, 0] - 1
        squares = weight - spec[c, 1]
        for n in range(samples.shape[0]):
            for p in range(first, weight):
                if samples[n, p] > samples[n, weight] * (limit * limit if p >= squares else limit):
                    return c
        first = weight + 1
    return -1
