"""Prediction of columns of sums: each row is guessed from the row before, and the residual is stored.

FORMAT.md section 5 is the norm; votes for classes, without a guess, are those of section 6. All arithmetic is on
words mod 2^64, so that every number has a residual.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints, Words

Planes = npt.NDArray[np.uint8]


@nb.njit(cache=True, nogil=True)
def predict_sums(values: Ints, weights: Ints) -> Words:
    """Residuals of a sum plane: value minus (previous value * weight // previous weight), in words mod 2^64.

    Encoder's half; nothing is predicted for the first row or where the previous weight is 0.
    """
    out = np.empty(values.shape[0], np.uint64)
    for n in range(values.shape[0]):
        # guess = (value before * weight) div weight before: neighbours have like means.
        guess = np.uint64(0)
        if n > 0 and weights[n - 1] != 0:
            guess = np.uint64(values[n - 1]) * np.uint64(weights[n]) // np.uint64(weights[n - 1])
        out[n] = zigzag(np.uint64(values[n]) - guess)
    return out


@nb.njit(cache=True, nogil=True)
def restore_sums_into(sums: Ints, p: int, planes: Planes) -> None:
    """Write column p of (N, P) sums, whose last holds the weights, from (k, N) planes; the mirror of `predict_sums`."""
    # The row before is kept in two words, `value` and `weight`.
    last = sums.shape[1] - 1
    value, weight = np.uint64(0), np.uint64(0)
    for n in range(sums.shape[0]):
        guess, own = np.uint64(0), np.uint64(sums[n, last])
        if weight != 0:
            guess = value * own // weight
        value, weight = guess + unzigzag(_word(planes, n)), own
        sums[n, p] = np.int64(value)


@nb.njit(cache=True, nogil=True)
def restore_squares_into(sums: Ints, planes: Planes) -> None:
    """Write column 1 of (N, 3) sums, whose other columns are complete, from the (k, N) planes of its residuals."""
    for n in range(sums.shape[0]):
        guess, weight = np.uint64(0), np.uint64(sums[n, 2])
        if weight != 0:
            guess = square_guess(np.uint64(sums[n, 0]), weight)
        sums[n, 1] = np.int64(guess + unzigzag(_word(planes, n)))


@nb.njit(cache=True, nogil=True)
def place_sums_into(leaves: Ints, sums: Ints, sampled: Ints, samples: Ints, low: int, high: int) -> bool:
    """Write the (N, P) sums of leaves, which rise, into (S, P) samples, at their places among the leaves `sampled`.

    Returns False if a row is all zeros, or a sum not in [low, high]; `sampled` rises and holds all the leaves.
    """
    row = np.uint64(0)
    sound = True
    for n in range(np.uint64(leaves.shape[0])):
        while sampled[row] != leaves[n]:
            row += np.uint64(1)
        # `said`: all bits of the row.
        said = np.int64(0)
        for p in range(np.uint64(sums.shape[1])):
            value = sums[n, p]
            sound &= low <= value <= high
            said |= value
            samples[row, p] = value
        sound &= said != 0
    return sound


@nb.njit(forceinline=True)
def _word(planes: Planes, n: int) -> np.uint64:
    """Number of row n in the planes of `streams.column_planes`: byte p is in plane p."""
    word = np.uint64(0)
    for p in range(planes.shape[0]):
        word |= np.uint64(planes[p, n]) << np.uint64(8 * p)
    return word


@nb.njit(cache=True, nogil=True)
def square_guesses(sums: Ints, weights: Ints) -> Words:
    """Sums of squares of equal samples: q^2 w + 2 q (s - q w), q = s // w, in words mod 2^64."""
    out = np.zeros(sums.shape[0], np.uint64)
    for n in range(sums.shape[0]):
        # Without weight there are no samples: the residual is the number itself.
        if weights[n] != 0:
            out[n] = square_guess(np.uint64(sums[n]), np.uint64(weights[n]))
    return out


@nb.njit(nogil=True)
def square_guess(s: np.uint64, w: np.uint64) -> np.uint64:
    """Sum of squares of w equal samples of sum s; w is not 0."""
    # Nearly equal integers, r = s - q w of them q + 1 and the others q, have this sum of squares plus r.
    q = s // w
    return q * q * w + np.uint64(2) * q * (s - q * w)


@nb.njit(inline="always")
def zigzag(word: np.uint64) -> np.uint64:
    """Word that is small for small magnitudes, of a two's complement word: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return (word << np.uint64(1)) ^ (np.uint64(0) - (word >> np.uint64(63)))


@nb.njit(inline="always")
def unzigzag(word: np.uint64) -> np.uint64:
    """Two's complement word of a zigzag word; the mirror of `zigzag`."""
    return (word >> np.uint64(1)) ^ (np.uint64(0) - (word & np.uint64(1)))


@nb.njit(cache=True, nogil=True)
def place_votes_into(
    sums: npt.NDArray[np.int64], pairs: Planes, classes: Planes, votes: Planes, signed: bool, limit: int
) -> bool:
    """Write votes where they belong; False if a class is not there, or does not rise in its row, or a number is wrong.

    Args:
        sums: (first rows, named classes) zeros, changed.
        pairs: (rows,) classes with votes; together they are M.
        classes: (M,) their numbers.
        votes: (k, M) planes of bytes of their votes, the lowest first.
        signed: True if votes are zigzag numbers.
        limit: largest magnitude.
    """
    at = 0
    for row in range(len(pairs)):
        last = -1
        for _ in range(pairs[row]):
            # The word of the votes, then its number.
            word = np.uint64(0)
            for p in range(votes.shape[0]):
                word |= np.uint64(votes[p, at]) << np.uint64(8 * p)
            is_negative = signed and (word & np.uint64(1)) != 0
            magnitude = word >> np.uint64(1) if signed else word
            if is_negative:
                magnitude += np.uint64(1)
            if magnitude == 0 or magnitude > np.uint64(limit):
                return False
            number = classes[at]
            if number <= last or number >= sums.shape[1]:
                return False
            if row < len(sums):
                sums[row, number] = -np.int64(magnitude) if is_negative else np.int64(magnitude)
            last = number
            at += 1
    return True
