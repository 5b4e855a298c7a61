"""Stamps of a cell: the log entry that last changed each of its 4^3 blocks (SYNC.md rule 2).

They say which blocks a branch of any age misses. They are stored next to the cell, dense over its blocks in Morton
order, and are no part of its canonical bytes. A block whose voxels are all gone again keeps its stamp, so that a robot
that still has them is sent the empty block (rule 10).
"""

import struct

import numpy as np
import numpy.typing as npt
import zstandard

from cairn_map.codec.octree.streams import bounded_zstd, column_planes, words_of_planes
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import Blocks

Stamps = npt.NDArray[np.int64]
"""(8^(depth - 2),) the log entry that last changed each block; 0 for never."""
HEAD = struct.Struct("<QI")
PAGE_BLOCKS = 8**3


def no_stamps(depth: int) -> Stamps:
    """Stamps of a cell that was never seen."""
    return np.zeros(8 ** (depth - 2), np.int64)


def blocks_after(stamps: Stamps, seq: int) -> Blocks:
    """Numbers (B,), rising, of the blocks that an entry after `seq` changed."""
    return np.flatnonzero(stamps > seq).astype(np.uint32)


class CellStamps:
    """Stamps of a cell under change, in pages of 8^3 blocks: a cell of few blocks takes little memory and time."""

    __slots__ = ("_count", "_page_of", "_pages")

    def __init__(self, depth: int) -> None:
        self._count = 8 ** (depth - 2)
        self._page_of = np.full(-(-self._count // PAGE_BLOCKS), -1, np.int32)
        """Row of `_pages` by the number of a page, -1 where no block has a stamp."""
        self._pages = np.zeros((0, PAGE_BLOCKS), np.int64)

    def put(self, blocks: npt.NDArray[np.integer], seqs: int | Stamps) -> None:
        """Stamp some blocks, with one entry of the log or with one for each."""
        pages, places = np.divmod(blocks.astype(np.int64), PAGE_BLOCKS)
        new = np.unique(pages[self._page_of[pages] < 0])
        if len(new):
            used = len(self._pages)
            self._page_of[new] = np.arange(used, used + len(new))
            self._pages = np.concatenate([self._pages, np.zeros((len(new), PAGE_BLOCKS), np.int64)])
        self._pages[self._page_of[pages], places] = seqs

    def raise_after(self, seq: int, by: int) -> None:
        """Raise the stamps of the entries after `seq`."""
        self._pages[self._pages > seq] += by

    def newest(self) -> int:
        """The newest stamp; 0 without any."""
        return int(self._pages.max(initial=0))

    def encoded(self) -> bytes:
        """Bytes of the stamps, which `decode_stamps` reads."""
        numbers = np.flatnonzero(self._page_of >= 0)
        seqs = self._pages[self._page_of[numbers]].ravel()
        known = np.flatnonzero(seqs)
        pages, places = np.divmod(known, PAGE_BLOCKS)
        return _encoded(numbers[pages] * PAGE_BLOCKS + places, seqs[known], self._count)

    @property
    def nbytes(self) -> int:
        """Memory held by the arrays."""
        return self._page_of.nbytes + self._pages.nbytes


def raised_stamps(data: bytes, after: int, by: int, *, depth: int, lm: int) -> bytes:
    """Encoded stamps in which those of the entries after `after` are raised.

    Raises:
        DamagedDataError: as `decode_stamps`.
    """
    # If all are, it is their common base: thousands of new cells are moved in milliseconds.
    if len(data) >= HEAD.size and HEAD.unpack_from(data)[0] >= after:
        before, size_bytes = HEAD.unpack_from(data)
        return HEAD.pack(before + by, size_bytes) + data[HEAD.size :]
    stamps = decode_cell_stamps(data, depth=depth, lm=lm)
    stamps.raise_after(after, by)
    return stamps.encoded()


def encode_stamps(stamps: Stamps) -> bytes:
    """Encode stamps: 0 or the distance from the oldest stamp, in byte planes under zstd; 1 to 4 % of a cell's size."""
    known = np.flatnonzero(stamps)
    return _encoded(known, stamps[known], len(stamps))


def decode_stamps(data: bytes, *, depth: int, lm: int) -> Stamps:
    """Decode what `encode_stamps` made.

    Empty data, as in stores of version 1, is every block at `lm`: more than changed, which only costs bytes.

    Raises:
        DamagedDataError: kind `damaged_store`: not the stamps of a cell of this depth.
    """
    stamps = no_stamps(depth)
    blocks, seqs = _decoded(data, len(stamps), lm)
    stamps[blocks] = seqs
    return stamps


def decode_cell_stamps(data: bytes, *, depth: int, lm: int) -> CellStamps:
    """Decode what `encode_stamps` made, to be changed.

    Raises:
        DamagedDataError: as `decode_stamps`.
    """
    stamps = CellStamps(depth)
    stamps.put(*_decoded(data, 8 ** (depth - 2), lm))
    return stamps


def _encoded(blocks: npt.NDArray[np.int64], seqs: Stamps, count: int) -> bytes:
    """Bytes of the stamps of some blocks out of `count`, a column of distances as in a cell."""
    before = int(seqs.min()) - 1 if len(seqs) else 0
    distances = (seqs - before).astype(np.uint64)
    planes = (int(distances.max(initial=0)).bit_length() + 7) // 8
    raw = np.zeros(1 + planes * count, np.uint8)
    raw[0] = planes
    for p in range(planes):
        raw[1 + p * count + blocks] = (distances >> np.uint64(8 * p)).astype(np.uint8)
    return HEAD.pack(before, len(raw)) + zstandard.compress(raw.tobytes(), 3)


def _decoded(data: bytes, count: int, lm: int) -> tuple[npt.NDArray[np.int64], Stamps]:
    """Blocks (B,) with a stamp, rising, and their stamps."""
    if not data:
        return np.arange(count), np.full(count, lm, np.int64)
    try:
        before, size_bytes = HEAD.unpack_from(data)
        if size_bytes > 1 + 8 * count:
            raise DamagedDataError("damaged_store", "more stamps than blocks")
        planes = column_planes(bounded_zstd(data[HEAD.size :], size_bytes=size_bytes), rows=count)
    except (struct.error, DamagedDataError) as exc:
        raise DamagedDataError("damaged_store", f"a cell's stamps are not sound: {exc}") from exc
    # Of the many blocks without a stamp, only the bytes are looked at.
    blocks = np.flatnonzero(planes[0] if len(planes) == 1 else planes.any(axis=0))
    distances = words_of_planes(planes[:, blocks])
    if len(blocks) and (before > lm or int(distances.max()) > lm - before):
        raise DamagedDataError("damaged_store", "a cell's stamps are newer than the cell")
    return blocks, distances.view(np.int64) + before
