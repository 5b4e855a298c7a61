"""Integer casts inside kernels, where Numba's rules of mixed arithmetic differ from what a reader expects."""

import numba as nb
import numpy as np

U = np.uint64
"""Type of the index in hot loops: a signed one is tested for being negative, which takes up to twice the time."""


@nb.njit(nogil=True, forceinline=True)
def signed(number: np.integer) -> int:
    """Any integer as int64: Numba makes the sum of an unsigned and a signed integer a float."""
    return np.int64(number)  # type: ignore[return-value]
