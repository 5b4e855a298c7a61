"""Frames of many cells without evidence, made at once: a request may list 100 000 cells that no map ever had.

    bytes of one frame     length | type | cell | ... the same in all ... | crc32
    in a full frame        ... and the three indices of the cell, in the head of its payload

As objects, one after the other, they take 5 us each, in which no other thread of the server runs. Here they are rows of
an array. A CRC is linear over exclusive or: that of a row is that of the first one, changed by a number from a table
for each byte in which the two differ.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.codec.cell_code import encode_empty_cell
from cairn_map.codec.layer_code import encode_layer_cell
from cairn_map.codec.octree.cell_head import INDICES_AT
from cairn_map.commits.cursor import Cursor
from cairn_map.epochs.cell_history import NOTHING
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CELL_LIMIT, CellKey
from cairn_map.kernels.morton_kernels import UInts, deinterleave
from cairn_map.wire.frames import CELL_HEAD, PREFIX, CellFrame, FrameKind, encode_frame

CRC_BYTES = 4
ROWS_MIN = 256
"""Frames below which single ones are faster: the tables take a millisecond."""
ROWS_MAX = 1 << 14
"""Frames made in one go: 2.4 MB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EmptyCellFrames:
    """Frames of one kind, `full` or `reset`, that bring cells from one state to that of a cell without evidence."""

    kind: FrameKind
    cells: UInts
    """(N,) numbers of the cells."""
    from_cursor: Cursor | None
    to_cursor: Cursor
    layer: MapLayer

    @property
    def count(self) -> int:
        """Count of the frames."""
        return len(self.cells)

    @property
    def size_bytes(self) -> int:
        """Bytes of all their heads and payloads."""
        payload = len(self._payload(CellKey(0))) if self.kind is FrameKind.FULL else 0
        return self.count * (CELL_HEAD.size + payload)

    def encoded(self) -> Iterator[bytes]:
        """Bytes of the frames, as `encode_frame` gives those of each, some thousand at a time."""
        for start in range(0, self.count, ROWS_MAX):
            yield self._rows(self.cells[start : start + ROWS_MAX]).tobytes()

    def _rows(self, cells: UInts) -> npt.NDArray[np.uint8]:
        if len(cells) < ROWS_MIN:
            each = [encode_frame(self._frame(CellKey(cell))) for cell in cells.tolist()]
            return np.frombuffer(b"".join(each), np.uint8).reshape(len(cells), -1)
        first = np.frombuffer(encode_frame(self._frame(CellKey(int(cells[0])))), np.uint8)
        rows = np.repeat(first[None], len(cells), axis=0)
        # The cell's number, and in a payload its indices.
        varied = {PREFIX.size: _bytes_of(cells.astype("<u8"))}
        if self.kind is FrameKind.FULL:
            indices = (deinterleave(cells) - CELL_LIMIT).astype("<i4")
            varied[PREFIX.size + CELL_HEAD.size + INDICES_AT] = _bytes_of(indices)
        crc = np.full(len(cells), int.from_bytes(first[-CRC_BYTES:].tobytes(), "little"), np.uint32)
        for at, columns in varied.items():
            for column in range(columns.shape[1]):
                crc ^= _crc_changes(first, at + column)[columns[:, column]]
            rows[:, at : at + columns.shape[1]] = columns
        rows[:, -CRC_BYTES:] = _bytes_of(crc.astype("<u4"))
        return rows

    def _frame(self, cell: CellKey) -> CellFrame:
        return CellFrame(
            kind=self.kind,
            cell=cell,
            from_cursor=self.from_cursor,
            to_cursor=self.to_cursor,
            fingerprint=ZERO,
            payload=self._payload(cell) if self.kind is FrameKind.FULL else b"",
        )

    def _payload(self, cell: CellKey) -> bytes:
        if self.layer.has_epochs:
            return encode_layer_cell(cell, NOTHING, self.layer).data
        return encode_empty_cell(cell, self.layer.geometry)


def _bytes_of(numbers: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
    """(N, B) the bytes of N rows of numbers."""
    return np.ascontiguousarray(numbers).view(np.uint8).reshape(len(numbers), -1)


def _crc_changes(frame: npt.NDArray[np.uint8], at: int) -> npt.NDArray[np.uint32]:
    """(256,) changes of a frame's checksum, as an exclusive or, by the value that its byte at `at` takes."""
    body = bytearray(frame[:-CRC_BYTES].tobytes())
    before = zlib.crc32(body)
    changes = np.empty(256, np.uint32)
    for value in range(256):
        body[at] = value
        changes[value] = zlib.crc32(body) ^ before
    return changes
