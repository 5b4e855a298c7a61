"""Columns of counts and weights: numbers as words, and the planes of bytes that are read back (FORMAT.md section 5)."""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints, Words
from cairn_map.codec.octree.streams import words_of_planes
from cairn_map.errors import DamagedDataError

Planes = npt.NDArray[np.uint8]

SMALL_PLANES = 3
"""Bytes of a number that is certainly in range."""


def words(values: Ints, signed: bool) -> Words:
    """Counts and weights as words: unchanged, or zigzag where differences may be negative."""
    raw = values.astype(np.uint64)
    return zigzag(raw) if signed else raw


def numbers_into(out: npt.NDArray[np.signedinteger], planes: Planes, *, signed: bool, limit: int) -> None:
    """Write (N,) numbers of the (k, N) planes of `column_planes`; the mirror of `words`.

    Raises:
        DamagedDataError: a magnitude above `limit`, which is no less than three bytes hold.
    """
    if not signed and len(planes) <= SMALL_PLANES:
        out[:] = planes[0] if len(planes) else 0
        for p, plane in enumerate(planes[1:], 1):
            out |= plane.astype(out.dtype) << out.dtype.type(8 * p)
        return
    raw = words_of_planes(planes)
    # As int64 a word of 2^63 and more is negative: out of range, too.
    values = (_unzigzag(raw) if signed else raw).view(np.int64)
    if len(values) and (values.max() > limit or values.min() < (-limit if signed else 0)):
        raise DamagedDataError("bad_stream", f"a count or weight is beyond {limit}")
    out[:] = values


def zigzag(raw: Words) -> Words:
    """Words of small magnitude made small."""
    return (raw << np.uint64(1)) ^ (np.uint64(0) - (raw >> np.uint64(63)))


def _unzigzag(raw: Words) -> Words:
    return (raw >> np.uint64(1)) ^ (np.uint64(0) - (raw & np.uint64(1)))
