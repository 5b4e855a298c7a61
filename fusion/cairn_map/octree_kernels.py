"""Packed rows to octree and back: child masks, leaf masks, and which row each leaf stands for.

A node's eight children with equal counts and no samples collapse into one leaf, as far up as they can, but never
the root. So the tree is a function of the evidence alone.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Words = npt.NDArray[np.uint32]
Counts = npt.NDArray[np.int32]
Ints = npt.NDArray[np.int64]

INNER = -1
FIXED = -2


@nb.njit(cache=True, nogil=True)
def collapse_into(
    keys: Words,
    states: Ints,
    counts: Counts,
    leaf_starts: npt.NDArray[np.bool_],
    child_masks: Bytes,
    leaf_masks: Bytes,
    is_root: bool,
) -> tuple[int, int]:
    """One depth up, in place: nodes (keys, states) become their parents; returns (parents, masks written).

    A state is INNER, FIXED (a voxel with samples) or the row whose counts the leaf holds. Masks are written for
    parents that stay inner; rows that a collapse makes superfluous lose their `leaf_starts`.
    """
    parents = 0
    masks = 0
    n = 0
    while n < keys.shape[0]:
        parent = keys[n] >> np.uint32(3)
        child_mask = np.uint8(0)
        leaf_mask = np.uint8(0)
        first = n
        equal = True
        while n < keys.shape[0] and keys[n] >> np.uint32(3) == parent:
            bit = np.uint8(1) << np.uint8(keys[n] & np.uint32(7))
            child_mask |= bit
            if states[n] != INNER:
                leaf_mask |= bit
            alike = states[n] >= 0 and states[first] >= 0
            if alike:
                for c in range(2):
                    alike = alike and counts[states[n], c] == counts[states[first], c]
            equal = equal and alike
            n += 1
        if equal and child_mask == 255 and not is_root:
            for m in range(first + 1, n):
                leaf_starts[states[m]] = False
            state = states[first]
        else:
            child_masks[masks] = child_mask
            leaf_masks[masks] = leaf_mask
            masks += 1
            state = INNER
        keys[parents] = parent
        states[parents] = state
        parents += 1
    return parents, masks


@nb.njit(cache=True, nogil=True)
def expand_into(starts: Words, sizes: Ints, leaf_counts: Counts, voxels: Words, counts: Counts) -> None:
    """Write one row per voxel of every leaf; the outputs have room for the sum of the sizes."""
    V = 0
    for n in range(starts.shape[0]):
        for step in range(sizes[n]):
            voxels[V] = starts[n] + np.uint32(step)
            counts[V, 0] = leaf_counts[n, 0]
            counts[V, 1] = leaf_counts[n, 1]
            V += 1


@nb.njit(cache=True, nogil=True)
def predict_sums(values: Ints, weights: Ints) -> npt.NDArray[np.uint64]:
    """Residuals of a sum plane: value minus (previous value * weight // previous weight), in words mod 2^64.

    Encoder's half; nothing is predicted for the first row or where the previous weight is 0.
    """
    out = np.empty(values.shape[0], np.uint64)
    for n in range(values.shape[0]):
        guess = np.uint64(0)
        if n > 0 and weights[n - 1] != 0:
            guess = np.uint64(values[n - 1]) * np.uint64(weights[n]) // np.uint64(weights[n - 1])
        out[n] = zigzag(np.uint64(values[n]) - guess)
    return out


@nb.njit(cache=True, nogil=True)
def restore_sums(residuals: npt.NDArray[np.uint64], weights: Ints) -> Ints:
    """Decoder's half of `predict_sums`."""
    out = np.empty(residuals.shape[0], np.int64)
    for n in range(residuals.shape[0]):
        guess = np.uint64(0)
        if n > 0 and weights[n - 1] != 0:
            guess = np.uint64(out[n - 1]) * np.uint64(weights[n]) // np.uint64(weights[n - 1])
        out[n] = np.int64(guess + unzigzag(residuals[n]))
    return out


@nb.njit(cache=True, nogil=True)
def square_guesses(sums: Ints, weights: Ints) -> npt.NDArray[np.uint64]:
    """What a sum of squares is if all samples were alike: q^2 w + 2 q (s - q w), q = s // w, in words mod 2^64."""
    out = np.zeros(sums.shape[0], np.uint64)
    for n in range(sums.shape[0]):
        if weights[n] != 0:
            s, w = np.uint64(sums[n]), np.uint64(weights[n])
            q = s // w
            out[n] = q * q * w + np.uint64(2) * q * (s - q * w)
    return out


@nb.njit(inline="always")
def zigzag(word: np.uint64) -> np.uint64:
    """Two's complement word to a word that is small for small magnitudes: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return (word << np.uint64(1)) ^ (np.uint64(0) - (word >> np.uint64(63)))


@nb.njit(inline="always")
def unzigzag(word: np.uint64) -> np.uint64:
    """The mirror of `zigzag`."""
    return (word >> np.uint64(1)) ^ (np.uint64(0) - (word & np.uint64(1)))
