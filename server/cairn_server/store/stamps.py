"""Stamps of a cell: the log entry that last changed each of its 4^3 blocks (SYNC.md rule 2).

They say which blocks a branch of any age misses. They are stored next to the cell, dense over its blocks in Morton
order, and are no part of its canonical bytes. A block whose voxels are all gone again keeps its stamp, so that a robot
that still has them is sent the empty block (rule 10).
"""

import struct

import numpy as np
import numpy.typing as npt
import zstandard

from cairn_map.codec.octree.streams import bounded_zstd, column_planes, encode_column, words_of_planes
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import Blocks

Stamps = npt.NDArray[np.int64]
"""(8^(depth - 2),) the log entry that last changed each block; 0 for never."""
HEAD = struct.Struct("<QI")


def no_stamps(depth: int) -> Stamps:
    """Stamps of a cell that was never seen."""
    return np.zeros(8 ** (depth - 2), np.int64)


def blocks_after(stamps: Stamps, seq: int) -> Blocks:
    """Numbers (B,), rising, of the blocks that an entry after `seq` changed."""
    return np.flatnonzero(stamps > seq).astype(np.uint32)


def encode_stamps(stamps: Stamps) -> bytes:
    """Encode stamps: 0 or the distance from the oldest stamp, in byte planes under zstd; 1 to 4 % of a cell's size."""
    known = stamps > 0
    before = int(stamps[known].min()) - 1 if known.any() else 0
    raw = encode_column(np.where(known, stamps - before, 0).astype(np.uint64))
    return HEAD.pack(before, len(raw)) + zstandard.compress(raw, 3)


def decode_stamps(data: bytes, *, depth: int, lm: int) -> Stamps:
    """Decode what `encode_stamps` made.

    Empty data, as in stores of version 1, is every block at `lm`: more than changed, which only costs bytes.

    Raises:
        DamagedDataError: kind `damaged_store`: not the stamps of a cell of this depth.
    """
    count = 8 ** (depth - 2)
    if not data:
        return np.full(count, lm, np.int64)
    try:
        before, size_bytes = HEAD.unpack_from(data)
        if size_bytes > 1 + 8 * count:
            raise DamagedDataError("damaged_store", "more stamps than blocks")
        words = words_of_planes(column_planes(bounded_zstd(data[HEAD.size :], size_bytes=size_bytes), rows=count))
    except (struct.error, DamagedDataError) as exc:
        raise DamagedDataError("damaged_store", f"a cell's stamps are not sound: {exc}") from exc
    distances = words.view(np.int64)
    stamps = np.where(distances != 0, distances + before, 0)
    if len(stamps) and (distances.min() < 0 or stamps.max() > lm):
        raise DamagedDataError("damaged_store", "a cell's stamps are newer than the cell")
    return stamps
