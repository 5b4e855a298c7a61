"""Streams of a cell's votes for classes: of each voxel the named classes that have some, and how many.

    pairs    classes with votes, for each row      classes  their numbers, rising in a row      votes  of each

They stand where other channels have their value planes (FORMAT.md section 6): of up to 63 planes a voxel has one or two
that are not zero. The class `other` has none: its votes are the weight less those of the others.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Ints
from cairn_map.codec.octree.streams import column_planes, encode_column, required
from cairn_map.codec.octree.sum_kernels import place_votes_into
from cairn_map.codec.octree.word_columns import words
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import SUM_MAX

STREAMS = 3


def encode_votes(number: int, sums: Ints, *, signed: bool) -> dict[int, bytes]:
    """Raw streams of (S, named classes) votes; the first has this number."""
    there = sums != 0
    rows, classes = np.nonzero(there)
    return {
        number: encode_column(there.sum(axis=1).astype(np.uint64)),
        number + 1: encode_column(classes.astype(np.uint64)),
        number + 2: encode_column(words(sums[rows, classes], signed)),
    }


def decode_votes_into(sums: Ints, number: int, streams: dict[int, bytes], *, rows: int, signed: bool) -> None:
    """Write the votes of the first rows of the streams, all zero before; the mirror of `encode_votes`.

    Args:
        sums: (first rows, named classes), changed.
        number: of the first stream.
        streams: raw streams by number.
        rows: of the whole channel.
        signed: True for a difference.

    Raises:
        DamagedDataError: a stream is missing or of the wrong length; a class that is not there, twice in a row or out
            of order; no votes.
    """
    # Lengths first; the kernel allocates nothing, whatever the streams claim.
    pairs = _small_column(required(streams, number), rows)
    count = int(pairs.sum(dtype=np.int64))
    classes = _small_column(required(streams, number + 1), count)
    votes = column_planes(required(streams, number + 2), rows=count)
    if not place_votes_into(sums, pairs, classes, votes, signed, SUM_MAX):
        raise DamagedDataError("bad_stream", "classes of a row must be there, and rise, and have votes in range")


def _small_column(raw: bytes, rows: int) -> npt.NDArray[np.uint8]:
    """(rows,) numbers of a column of at most one byte each."""
    planes = column_planes(raw, rows=rows)
    if len(planes) > 1:
        raise DamagedDataError("bad_stream", "a number of classes takes one byte at most")
    return planes[0] if len(planes) else np.zeros(rows, np.uint8)
