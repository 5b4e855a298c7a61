"""Replies that resume where a cut link ended: no byte of a cell is sent twice.

    reply, cut:    ... | head of cell A, the first 80 kB of its payload |
    request:       begun = (A, 80 kB, their SHA-256)
    next reply:    header | ... | head of cell A, "continues", what comes after these 80 kB | ...

The server keeps nothing: it compares the digest with the beginning of the payload that it would send now. A reply
without cells, which reports again and again that nothing changed, is resumed as a whole: the asker names the last one
by its digest.
"""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import replace

from cairn_map.codec.cell_reading import CELL_BYTES_MAX
from cairn_map.errors import DamagedDataError, UnreachableError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.empty_cell_frames import EmptyCellFrames
from cairn_map.wire.frames import CellFrame, Frame, FrameReader
from cairn_map.wire.messages import MissingRequest

Begun = tuple[tuple[int, int, int], int, str]
"""Cell, bytes of its frame's payload that are held, SHA-256 of them."""

BEGUN_BYTES_MIN = 512
"""Bytes of a payload that are worth naming in a request: fewer cost more than they save."""
KNOWN_BYTES_MAX = 1 << 20
"""Bytes of a reply that is kept to compare the next one with, at most."""
KNOWN_DIGITS = 16
"""Hex digits of the SHA-256 that name a reply."""


def reply_digest(reply: bytes) -> str:
    """Digest by which a request names the last reply."""
    return hashlib.sha256(reply).hexdigest()[:KNOWN_DIGITS]


def without_begun(frames: Iterable[Frame | EmptyCellFrames], begun: Begun | None) -> Iterator[Frame | EmptyCellFrames]:
    """Frames of a reply, without the beginning of a payload that the asker holds; empty cells come whole."""
    cell, size, sha = begun or (None, 0, "")
    for frame in frames:
        if not isinstance(frame, CellFrame) or len(frame.payload) < size or cell_of_key(frame.cell) != cell:
            yield frame
        elif hashlib.sha256(frame.payload[:size]).hexdigest() == sha:
            yield replace(frame, continues=True, payload=frame.payload[size:])
        else:
            yield frame


class Replies:
    """Memory of one asker's replies: the unfinished payload, and the last reply without cells."""

    def __init__(self) -> None:
        self.begun: tuple[CellKey, bytes] | None = None
        """Cell of the frame that was cut, and the beginning of its payload."""
        self.known: bytes | None = None
        """The last reply, if it had no cells; else None."""

    def keep_begun(self, begun: tuple[CellKey, bytes] | None) -> None:
        """Remember the beginning of a cell's payload; None: there is none."""
        self.begun = begun

    def keep_known(self, reply: bytes | None) -> None:
        """Remember a reply without cells; None: the last one had some, or was cut."""
        self.known = reply

    def reply_to(self, request: MissingRequest) -> "Reply":
        """Reader of the reply to a request."""
        return Reply(self, request)


class Reply:
    """Reader of one reply; it completes the frame that the reply before left unfinished."""

    def __init__(self, memory: Replies, request: MissingRequest) -> None:
        self._memory = memory
        self._begun = memory.begun
        self._known = memory.known
        self.request = request
        """The request, which names the bytes and the reply that are held already."""
        if self._begun is not None:
            key, payload = self._begun
            sha = hashlib.sha256(payload).hexdigest()
            begun = (cell_of_key(key), len(payload), sha)
            self.request = self.request.model_copy(update={"begun": begun})
        if self._known is not None:
            self.request = self.request.model_copy(update={"known": reply_digest(self._known)})

    def again(self) -> Iterator[Frame]:
        """Frames of the last reply; for a 204, which means that this one is the same."""
        return FrameReader().feed(self._known or b"")

    def frames(self, parts: Iterable[bytes]) -> Iterator[Frame]:
        """Whole frames of the reply's bytes.

        Raises:
            DamagedDataError: the bytes are not frames.
            UnreachableError: kind `cut_off`: they end too early.
        """
        reader = FrameReader()
        self._memory.keep_known(None)
        # `short`: the bytes so far, while they hold no cell and are few enough to be kept.
        short: bytearray | None = bytearray()
        try:
            for part in parts:
                if short is not None:
                    short += part
                for frame in reader.feed(part):
                    if isinstance(frame, CellFrame):
                        short = None
                    yield self._whole(frame) if isinstance(frame, CellFrame) else frame
                if short is not None and len(short) > KNOWN_BYTES_MAX:
                    short = None
        finally:
            self._note(reader)
        if not reader.is_empty:
            raise UnreachableError("cut_off", "the reply was cut off")
        self._memory.keep_known(bytes(short) if short is not None else None)

    def _whole(self, frame: CellFrame) -> CellFrame:
        """A frame, joined with the beginning of its payload from an earlier reply."""
        if self._memory.begun is not None and self._memory.begun[0] == frame.cell:
            self._memory.keep_begun(None)
        if not frame.continues:
            return frame
        name = cell_of_key(frame.cell)
        if self._begun is None or self._begun[0] != frame.cell:
            raise DamagedDataError("bad_frame", f"the frame of cell {name} goes on from what is not here")
        size_bytes = len(self._begun[1]) + len(frame.payload)
        if size_bytes > CELL_BYTES_MAX:
            raise DamagedDataError("bad_frame", f"cell {name} has at most {CELL_BYTES_MAX} bytes, got {size_bytes}")
        return replace(frame, continues=False, payload=self._begun[1] + frame.payload)

    def _note(self, reader: FrameReader) -> None:
        """Keep the beginning of the frame at which the reply was cut."""
        if reader.begun is None:
            return
        key, continues, payload = reader.begun
        if continues:
            if self._begun is None or self._begun[0] != key:
                return
            # No cell is as large: a server that always continues must not fill the memory.
            if len(self._begun[1]) + len(payload) > CELL_BYTES_MAX:
                self._memory.keep_begun(None)
                return
            payload = self._begun[1] + payload
        if len(payload) >= BEGUN_BYTES_MIN:
            self._memory.keep_begun((key, payload))
