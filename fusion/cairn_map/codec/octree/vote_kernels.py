"""Kernel that reads the votes for classes of a cell: pairs of a class and its votes, row by row."""

import numba as nb
import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]


@nb.njit(cache=True, nogil=True)
def place_votes_into(
    sums: npt.NDArray[np.int64], pairs: Bytes, classes: Bytes, votes: npt.NDArray[np.uint8], signed: bool, limit: int
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
