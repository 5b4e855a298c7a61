"""Morton (Z-order) codes: x in bit 0, y in bit 1, z in bit 2 of each triple, so siblings are neighbours."""

import numba as nb
import numpy as np
import numpy.typing as npt

UInts = npt.NDArray[np.uint64]


@nb.njit(inline="always")
def spread(v: np.uint64) -> np.uint64:
    """The low 21 bits of v, two zero bits between neighbours."""
    v = v & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@nb.njit(inline="always")
def squeeze(v: np.uint64) -> np.uint64:
    """The mirror of `spread`."""
    v = v & np.uint64(0x1249249249249249)
    v = (v | (v >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    v = (v | (v >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v >> np.uint64(8))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v >> np.uint64(16))) & np.uint64(0x1F00000000FFFF)
    return (v | (v >> np.uint64(32))) & np.uint64(0x1FFFFF)


@nb.njit(cache=True, nogil=True)
def interleave(xyz: npt.NDArray[np.int64]) -> UInts:
    """(N,) codes of (N, 3) integers in [0, 2^21)."""
    out = np.empty(xyz.shape[0], np.uint64)
    for n in range(xyz.shape[0]):
        x, y, z = np.uint64(xyz[n, 0]), np.uint64(xyz[n, 1]), np.uint64(xyz[n, 2])
        out[n] = spread(x) | (spread(y) << np.uint64(1)) | (spread(z) << np.uint64(2))
    return out


@nb.njit(cache=True, nogil=True)
def deinterleave(codes: UInts) -> npt.NDArray[np.int64]:
    """(N, 3) integers of (N,) codes; the mirror of `interleave`."""
    out = np.empty((codes.shape[0], 3), np.int64)
    for n in range(codes.shape[0]):
        out[n, 0] = np.int64(squeeze(codes[n]))
        out[n, 1] = np.int64(squeeze(codes[n] >> np.uint64(1)))
        out[n, 2] = np.int64(squeeze(codes[n] >> np.uint64(2)))
    return out
