"""Bounds of packed evidence in one pass; numpy's reductions over short rows take thirty times as long."""

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
def sums_without_weight(samples: npt.NDArray[np.int64], first: int, weight: int) -> bool:
    """Whether a row has a sum in columns `first` to before `weight`, and 0 in column `weight`."""
    for n in range(len(samples)):
        if samples[n, weight] == 0:
            for p in range(first, weight):
                if samples[n, p] != 0:
                    return True
    return False
