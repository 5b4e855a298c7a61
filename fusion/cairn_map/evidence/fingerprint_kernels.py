"""The weighted sums behind `fingerprint.py`; FORMAT.md section "Fingerprint" is the norm."""

import numba as nb
import numpy as np
import numpy.typing as npt

GAMMA = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)


@nb.njit(inline="always")
def mix(x: np.uint64) -> np.uint64:
    """One step of SplitMix64 (Steele, Lea, Flood 2014): a bijection of 64-bit words that scatters well."""
    x = x + GAMMA
    x = (x ^ (x >> np.uint64(30))) * MIX_1
    x = (x ^ (x >> np.uint64(27))) * MIX_2
    return x ^ (x >> np.uint64(31))


@nb.njit(cache=True, nogil=True)
def weighted_sums(
    cell: np.uint64,
    voxels: npt.NDArray[np.uint32],
    counts: npt.NDArray[np.int32],
    sampled: npt.NDArray[np.uint32],
    samples: npt.NDArray[np.int64],
) -> tuple[np.uint64, np.uint64]:
    """Two sums, mod 2^64, of value times the odd pseudo-random weight of (cell, voxel, plane)."""
    first_cell = mix(cell)
    second_cell = mix(~cell)
    first = np.uint64(0)
    second = np.uint64(0)
    one = np.uint64(1)
    for n in range(voxels.shape[0]):
        place = np.uint64(voxels[n]) << np.uint64(8)
        for c in range(2):
            if counts[n, c] != 0:
                value = np.uint64(np.int64(counts[n, c]))
                first += value * (mix(first_cell ^ (place | np.uint64(c))) | one)
                second += value * (mix(second_cell ^ (place | np.uint64(c))) | one)
    for n in range(sampled.shape[0]):
        place = np.uint64(voxels[sampled[n]]) << np.uint64(8)
        for p in range(samples.shape[1]):
            if samples[n, p] != 0:
                value = np.uint64(samples[n, p])
                first += value * (mix(first_cell ^ (place | np.uint64(p + 2))) | one)
                second += value * (mix(second_cell ^ (place | np.uint64(p + 2))) | one)
    return first, second
