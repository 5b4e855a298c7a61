"""Replies to fetch-missing that leave the server while they are made, part by part.

    first part    the header and 1 MiB of cells           read now; a short reply is whole with it
    later parts   2, 4, 8, 8, ... MiB                     each is read when the link has taken the one before

No snapshot is open while bytes are on their way: a slow link would hold up the emptying of the store's log. Each part
is read from a snapshot of its own, of the very state of the first (SYNC.md rule 3). Where the map has moved on, or
cannot be read any more, the reply ends with `more`, and the asker comes back for the rest.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass

from cairn_map.errors import CairnError
from cairn_map.wire.empty_cell_frames import EmptyCellFrames
from cairn_map.wire.frames import CellFrame, Frame, FrameKind, encode_frame, start_of_reply
from cairn_map.wire.messages import More
from cairn_server.folding.cells import CellFaults
from cairn_server.store.store import Snapshot
from cairn_server.sync.missing import CellFrames
from cairn_server.sync.slices import Slices

log = logging.getLogger(__name__)

FIRST_PART_BYTES, PART_BYTES_MAX = 1 << 20, 1 << 23
"""Bytes after which the first part, and any part, ends with its frame."""

Reading = Callable[[], AbstractContextManager[tuple[Snapshot, CellFaults]]]
"""Opens a snapshot of the map, and a collector of the damaged cells met in it."""


@dataclass(frozen=True, slots=True)
class MissingReply:
    """Reply to one request."""

    first: bytes
    """The first part; empty if the asker knows this very reply."""
    rest: Iterator[bytes] | None
    """The parts after it, made one by one; None: there are none."""

    def parts(self) -> Iterator[bytes]:
        """All parts."""
        yield self.first
        if self.rest is not None:
            yield from self.rest


class ReplyParts:
    """Parts of one reply, as its frames are made."""

    def __init__(self, cells: CellFrames, frames: Iterator[Frame | EmptyCellFrames], slices: Slices) -> None:
        """Args: cells: of the frames; each part reads them from another snapshot of the same state."""
        self._cells = cells
        self._encoded = _encoded(frames)
        self._slices = slices
        self._part_bytes = FIRST_PART_BYTES
        self.is_whole = False
        """True once the last frame was read."""

    def read(self) -> bytes:
        """Next part; called in a turn of the slices, while the snapshot of the cells is open."""
        part, may_end = bytearray(), False
        for data, has_payload in self._slices.of(self._encoded):
            part += data
            may_end = may_end or has_payload
            # A reply without cells stays in one part: the asker may know it as a whole. So does one of fingerprints
            # alone, which the asker takes as the answer to all that it listed.
            if may_end and len(part) >= self._part_bytes:
                self._part_bytes = min(2 * self._part_bytes, PART_BYTES_MAX)
                return bytes(part)
        self.is_whole = True
        return bytes(part)

    def others(self, reading: Reading) -> Iterator[bytes]:
        """The parts after the first."""
        head = self._cells.snapshot.head
        while not self.is_whole:
            # A link that took the part before may have taken minutes for it.
            try:
                with self._slices.turn(), reading() as (snapshot, faults):
                    if snapshot.head != head:
                        break
                    self._cells.read_from(snapshot, faults)
                    part = self.read()
            except CairnError as exc:
                log.info("a reply ends early: %s: %s", exc.kind, exc.message)
                break
            yield part
        else:
            return
        yield encode_frame(More(to=str(head)))


def _encoded(frames: Iterator[Frame | EmptyCellFrames]) -> Iterator[tuple[bytes, bool]]:
    """Bytes of a reply, and whether they bring a cell's evidence."""
    yield start_of_reply(), False
    for frame in frames:
        if isinstance(frame, EmptyCellFrames):
            yield from ((data, frame.kind is not FrameKind.RESET) for data in frame.encoded())
        else:
            yield encode_frame(frame), isinstance(frame, CellFrame) and frame.kind is not FrameKind.RESET
