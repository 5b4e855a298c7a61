"""Frames of a reply to `missing`: a header, one frame per cell, each readable alone, and an end.

    "CRNS" | version u8 | frame, frame, ...          frame = length u32 | type u8 | body | crc32 u32

    header    to, version vector at `to`, stable, sha of the asker's tip         JSON
    delta     cell | from | to | fingerprint | own-excluded flag | signed evidence to add
    state     cell | from | to | fingerprint | blocks | present sums of all voxels in these 4^3 blocks
    full      cell | from | to | fingerprint | the whole cell
    reset     cell | from | to | fingerprint                                     the cursor cannot be proven
    done      to, fingerprint sum of the cells without a frame                   JSON
    more      to                                                                 JSON; ask again for the rest

Rules 3 to 5 and 8 to 9 of SYNC.md are about them; PROTOCOL.md is the norm.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from cairn_map.codec.cell_reading import CELL_BYTES_MAX
from cairn_map.commits.cursor import CHAIN_BYTES, Cursor
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.evidence.fingerprint import Fingerprint, fingerprint_from_bytes
from cairn_map.evidence.grid import DEPTH_MAX, CellKey
from cairn_map.wire.messages import Done, More, ReplyHeader, message_from_json

MAGIC = b"CRNS"
VERSION = 1
PREFIX = struct.Struct("<IB")
CELL_HEAD = struct.Struct(f"<QB16sq{CHAIN_BYTES}s16sq{CHAIN_BYTES}s16s")
"""Cell, flags, `from` (log, seq, chain), `to` (log, seq, chain), fingerprint."""
FRAME_BYTES_MAX = CELL_BYTES_MAX + (1 << 20)
JSON_BYTES_MAX = 1 << 22
"""Bytes of a frame in JSON, whose objects need a hundred times as many: version vectors of some 60 000 robots."""
BLOCK_LIMIT = 8 ** (DEPTH_MAX - 2)
"""Number of blocks in the deepest cell: block numbers are below it."""
FLAG_OWN_EXCLUDED = 1
FLAG_CONTINUES = 2
NO_CURSOR = -1


class FrameKind(IntEnum):
    """Type byte of a frame."""

    HEADER = 1
    DELTA = 2
    STATE = 3
    FULL = 4
    RESET = 5
    DONE = 6
    MORE = 7


CELL_KINDS = (FrameKind.DELTA, FrameKind.STATE, FrameKind.FULL, FrameKind.RESET)


@dataclass(frozen=True, slots=True, kw_only=True)
class CellFrame:
    """Change of one cell from its state at `from_cursor` (None: empty) to that at `to_cursor`."""

    kind: FrameKind
    cell: CellKey
    from_cursor: Cursor | None
    to_cursor: Cursor
    fingerprint: Fingerprint
    """Fingerprint of the server's cell at `to_cursor`."""
    own_excluded: bool = False
    """True if a delta leaves out the asker's own commits."""
    blocks: npt.NDArray[np.uint32] | None = None
    """(B,) rising Morton numbers of the 4^3 blocks that a `state` frame replaces; None in others."""
    continues: bool = False
    """True if the payload is only the rest of it: the asker has named the beginning as held."""
    payload: bytes = b""
    """A cell's bytes; empty for `reset`."""
    count: ClassVar[int] = 1

    @property
    def size_bytes(self) -> int:
        """Bytes of head and payload."""
        return CELL_HEAD.size + len(self.payload)


Frame = ReplyHeader | CellFrame | Done | More


def start_of_reply() -> bytes:
    """The bytes before the first frame."""
    return MAGIC + bytes([VERSION])


def encode_frame(frame: Frame) -> bytes:
    """One frame with its length and checksum."""
    if isinstance(frame, CellFrame):
        return _wrapped(frame.kind, _cell_body(frame))
    kind = {ReplyHeader: FrameKind.HEADER, Done: FrameKind.DONE, More: FrameKind.MORE}[type(frame)]
    return _wrapped(kind, frame.model_dump_json().encode())


class FrameReader:
    """Incremental parser of a reply: bytes in pieces in, frames out; it keeps at most one unfinished frame."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._started = False

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Frames that are complete with these bytes.

        Raises:
            DamagedDataError: the checksum differs, or a body contradicts itself.
            BadInputError: an unknown version, or a frame that is too large.
        """
        self._buffer += data
        if not self._started:
            if len(self._buffer) < 5:
                return
            if self._buffer[:4] != MAGIC:
                raise DamagedDataError("bad_frame", "the reply does not begin with CRNS")
            if self._buffer[4] != VERSION:
                raise BadInputError("unknown_version", f"this reader knows replies of version 1, got {self._buffer[4]}")
            del self._buffer[:5]
            self._started = True
        while (frame := self._next()) is not None:
            yield frame

    @property
    def is_empty(self) -> bool:
        """True if a reply began and no bytes are left over; False at the end means that the reply was cut."""
        return self._started and not self._buffer

    @property
    def begun(self) -> tuple[CellKey, bool, bytes] | None:
        """Unfinished cell frame: its cell, its `continues` and the beginning of its payload, unchecked; or None."""
        if not self._started or len(self._buffer) <= PREFIX.size + CELL_HEAD.size + 4:
            return None
        size, kind = PREFIX.unpack_from(self._buffer)
        key, flags = struct.unpack_from("<QB", self._buffer, PREFIX.size)
        at = PREFIX.size + CELL_HEAD.size
        if kind == FrameKind.STATE:
            at += 4 + 4 * int.from_bytes(self._buffer[at : at + 4], "little")
        payload = bytes(self._buffer[at : PREFIX.size + size])
        is_cell = kind in CELL_KINDS and key < 1 << 63
        return (CellKey(key), bool(flags & FLAG_CONTINUES), payload) if is_cell and payload else None

    def _next(self) -> Frame | None:
        if len(self._buffer) < PREFIX.size:
            return None
        # The size is checked before the frame is waited for: a buffer never grows beyond it.
        size, kind = PREFIX.unpack_from(self._buffer)
        limit = FRAME_BYTES_MAX if kind in CELL_KINDS else JSON_BYTES_MAX
        if size > limit:
            raise BadInputError(
                "too_large", f"a frame of type {kind} has at most {limit} bytes, this one claims {size}"
            )
        end = PREFIX.size + size
        if len(self._buffer) < end + 4:
            return None
        # The checksum is over length, type and body.
        body = bytes(self._buffer[PREFIX.size : end])
        (checksum,) = struct.unpack_from("<I", self._buffer, end)
        if zlib.crc32(self._buffer[:end]) != checksum:
            raise DamagedDataError("bad_frame", "a frame's checksum does not fit its bytes")
        del self._buffer[: end + 4]
        return _parsed(kind, body)


def frames_of(data: bytes) -> list[Frame]:
    """Frames of a whole reply.

    Raises:
        DamagedDataError: cut off or damaged.
        BadInputError: an unknown version, or too large.
    """
    reader = FrameReader()
    frames = list(reader.feed(data))
    if not reader.is_empty:
        raise DamagedDataError("bad_frame", "the reply is cut off")
    return frames


def _wrapped(kind: FrameKind, body: bytes) -> bytes:
    framed = PREFIX.pack(len(body), kind) + body
    return framed + struct.pack("<I", zlib.crc32(framed))


def _cell_body(frame: CellFrame) -> bytes:
    start = frame.from_cursor
    to = frame.to_cursor
    head = CELL_HEAD.pack(
        frame.cell,
        FLAG_OWN_EXCLUDED * frame.own_excluded | FLAG_CONTINUES * frame.continues,
        start.log_id if start else bytes(16),
        start.seq if start else NO_CURSOR,
        start.chain if start else bytes(CHAIN_BYTES),
        to.log_id,
        to.seq,
        to.chain,
        frame.fingerprint.to_bytes(),
    )
    if frame.blocks is not None:
        head += struct.pack("<I", len(frame.blocks)) + frame.blocks.astype("<u4").tobytes()
    return head + frame.payload


def _parsed(kind: int, body: bytes) -> Frame:
    if kind in CELL_KINDS:
        return _parsed_cell(FrameKind(kind), body)
    if kind == FrameKind.HEADER:
        return message_from_json(ReplyHeader, body)
    if kind == FrameKind.DONE:
        return message_from_json(Done, body)
    if kind == FrameKind.MORE:
        return message_from_json(More, body)
    raise BadInputError("unknown_version", f"unknown frame type {kind}; a newer client may know it")


def _parsed_cell(kind: FrameKind, body: bytes) -> CellFrame:
    if len(body) < CELL_HEAD.size:
        raise DamagedDataError("bad_frame", "a cell frame is cut off")
    # The fixed head.
    key, flags, from_log, from_seq, from_chain, to_log, to_seq, to_chain, sums = CELL_HEAD.unpack_from(body)
    at = CELL_HEAD.size
    blocks: npt.NDArray[np.uint32] | None = None
    # The blocks of a state frame: count u32, then as many u32. A count that is cut off counts as too large.
    if kind is FrameKind.STATE:
        (count,) = struct.unpack_from("<I", body, at) if at + 4 <= len(body) else (len(body),)
        at += 4
        if at + 4 * count > len(body):
            raise DamagedDataError("bad_frame", "a state frame's blocks are cut off")
        blocks = np.frombuffer(body, "<u4", count, at).astype(np.uint32)
        if (blocks[1:] <= blocks[:-1]).any() or (blocks >= BLOCK_LIMIT).any():
            raise DamagedDataError("bad_frame", "a state frame's blocks must rise and lie in the cell")
        at += 4 * count
    # Impossible values; all that is left is the payload.
    if key >= 1 << 63 or flags & ~(FLAG_OWN_EXCLUDED | FLAG_CONTINUES) or (kind is FrameKind.RESET and at != len(body)):
        raise DamagedDataError("bad_frame", "a cell frame has an impossible cell number, flag or payload")
    try:
        start = None if from_seq == NO_CURSOR else Cursor(from_log, from_seq, from_chain)
        to = Cursor(to_log, to_seq, to_chain)
    except CairnError as exc:
        raise DamagedDataError("bad_frame", exc.message) from exc
    return CellFrame(
        kind=kind,
        cell=CellKey(key),
        from_cursor=start,
        to_cursor=to,
        fingerprint=fingerprint_from_bytes(sums),
        own_excluded=bool(flags & FLAG_OWN_EXCLUDED),
        continues=bool(flags & FLAG_CONTINUES),
        blocks=blocks,
        payload=body[at:],
    )
