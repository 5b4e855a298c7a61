"""Morton (Z-order) codes of voxels: the bits of x, y and z interleaved, so that the voxels of a node are one run.

    x = ..x1 x0    y = ..y1 y0    z = ..z1 z0      code = ..z1 y1 x1 z0 y0 x0

FORMAT.md section 2 is the norm of this order. A code without its lowest 3 n bits is that of the node of 2^n voxels
along an edge which holds the voxel.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

UInts = npt.NDArray[np.uint64]


@nb.njit(inline="always")
def spread(v: np.uint64) -> np.uint64:
    """The low 21 bits of v, with two zero bits between neighbours."""
    # Each step halves the runs of bits and moves the upper half up by twice its length: 21 = 16 + 5, then 8, 4, 2, 1.
    v = v & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@nb.njit(inline="always")
def squeeze(v: np.uint64) -> np.uint64:
    """Every third bit of v, from bit 0 on, side by side; the mirror of `spread`."""
    # The steps of `spread`, backwards.
    v = v & np.uint64(0x1249249249249249)
    v = (v | (v >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    v = (v | (v >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v >> np.uint64(8))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v >> np.uint64(16))) & np.uint64(0x1F00000000FFFF)
    return (v | (v >> np.uint64(32))) & np.uint64(0x1FFFFF)


@nb.njit(cache=True, nogil=True)
def interleave(xyz: npt.NDArray[np.int64]) -> UInts:
    """(N,) Morton codes of (N, 3) integers in [0, 2^21)."""
    out = np.empty(xyz.shape[0], np.uint64)
    for n in range(xyz.shape[0]):
        x, y, z = np.uint64(xyz[n, 0]), np.uint64(xyz[n, 1]), np.uint64(xyz[n, 2])
        out[n] = spread(x) | (spread(y) << np.uint64(1)) | (spread(z) << np.uint64(2))
    return out


@nb.njit(cache=True, nogil=True)
def deinterleave(codes: UInts) -> npt.NDArray[np.int64]:
    """(N, 3) integers of (N,) Morton codes; the mirror of `interleave`."""
    # y and z are shifted to where x is.
    out = np.empty((codes.shape[0], 3), np.int64)
    for n in range(codes.shape[0]):
        out[n, 0] = np.int64(squeeze(codes[n]))
        out[n, 1] = np.int64(squeeze(codes[n] >> np.uint64(1)))
        out[n, 2] = np.int64(squeeze(codes[n] >> np.uint64(2)))
    return out
