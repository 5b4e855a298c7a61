"""Columns of sums: what a row's neighbour lets one guess, and what remains to be said (FORMAT.md section 5)."""

import numba as nb
import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]


@nb.njit(cache=True, nogil=True)
def predict_sums(values: Ints, weights: Ints) -> Words:
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
def restore_sums(residuals: Words, weights: Ints) -> Ints:
    """Decoder's half of `predict_sums`."""
    out = np.empty(residuals.shape[0], np.int64)
    for n in range(residuals.shape[0]):
        guess = np.uint64(0)
        if n > 0 and weights[n - 1] != 0:
            guess = np.uint64(out[n - 1]) * np.uint64(weights[n]) // np.uint64(weights[n - 1])
        out[n] = np.int64(guess + unzigzag(residuals[n]))
    return out


@nb.njit(cache=True, nogil=True)
def square_guesses(sums: Ints, weights: Ints) -> Words:
    """What a sum of squares is if all samples were alike: q^2 w + 2 q (s - q w), q = s // w, in words mod 2^64."""
    out = np.zeros(sums.shape[0], np.uint64)
    for n in range(sums.shape[0]):
        if weights[n] != 0:
            out[n] = square_guess(np.uint64(sums[n]), np.uint64(weights[n]))
    return out


@nb.njit(nogil=True)
def square_guess(s: np.uint64, w: np.uint64) -> np.uint64:
    """One of `square_guesses`; w is not 0."""
    q = s // w
    return q * q * w + np.uint64(2) * q * (s - q * w)


@nb.njit(inline="always")
def zigzag(word: np.uint64) -> np.uint64:
    """Two's complement word to a word that is small for small magnitudes: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return (word << np.uint64(1)) ^ (np.uint64(0) - (word >> np.uint64(63)))


@nb.njit(inline="always")
def unzigzag(word: np.uint64) -> np.uint64:
    """The mirror of `zigzag`."""
    return (word >> np.uint64(1)) ^ (np.uint64(0) - (word & np.uint64(1)))
