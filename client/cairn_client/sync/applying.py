"""Frames onto a replica: SYNC.md rules 5 to 9, one function for each kind of frame. No I/O but the replica's own.

A frame that does not fit is dropped, never forced: the cell then has no cursor, and the next request asks for it
whole.
"""

import logging

import numpy as np

from cairn_client.replica.replica import UNPROVEN, Replica
from cairn_client.replica.replica_store import BaseCell
from cairn_client.sync.requests import Box
from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import without_blocks
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.grid import Cell, CellKey, cell_of_key
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import Done, MissingRequest, More, ReplyHeader

log = logging.getLogger(__name__)

MISFIT = "the frame does not lead to the server's fingerprint"


def is_within(key: CellKey, box: Box | None) -> bool:
    """Whether a cell lies in a box; None is everywhere."""
    return box is None or all(a <= b <= c for a, b, c in zip(box[0], cell_of_key(key), box[1], strict=True))


class Exchange:
    """One request for what is missing, and the frames of its answer."""

    def __init__(
        self,
        replica: Replica,
        *,
        compare: bool = False,
        box: Box | None = None,
        reply_bytes_max: int | None = None,
        near: Cell | None = None,
    ) -> None:
        """Ask for all cells, or for those in a box; at most so many bytes of cells, or as many as the server likes.

        The cells next to `near` come first.
        """
        self._replica = replica
        with replica.lock:
            self._author = replica.author
            self._default = replica.default_cursor
            self._asked = {key: cell.cursor for key, cell in replica.cells.items() if is_within(key, box)}
        self._compare = compare
        self._box = box
        self._reply_bytes_max = reply_bytes_max
        self._near = near
        self._header: ReplyHeader | None = None
        self._coverage = EMPTY
        self._framed: set[CellKey] = set()
        self._has_dropped = False
        self.damaged: list[CellKey] = []
        """Cells that came whole, but not sound: they are asked for again, and the others are not held up."""
        self.is_done = False
        self.has_more = False
        """The reply ended before its cells did: the next request asks for the rest."""
        self.must_compare = False

    def request(self) -> MissingRequest:
        """What this replica holds: the default cursor, and every cell that stands elsewhere."""
        groups: dict[str | None, list[CellKey]] = {}
        for key, cursor in sorted(self._asked.items()):
            if self._compare or cursor != self._default:
                groups.setdefault(str(cursor) if cursor else None, []).append(key)
        return MissingRequest(
            author=str(self._author),
            cursor=str(self._default) if self._default else None,
            groups=[(cursor, [cell_of_key(key) for key in keys]) for cursor, keys in groups.items()],
            compare=self._compare,
            kinds=["delta", "state", "full"],
            box=self._box,
            size_bytes_max=self._reply_bytes_max,
            near=self._near,
        )

    def take(self, frame: Frame) -> None:
        """Apply one frame of the answer.

        Raises:
            DamagedDataError: frames in an impossible order.
        """
        with self._replica.lock:
            if isinstance(frame, ReplyHeader):
                self._header = frame
                self._coverage = frame.coverage
                self._replica.take_header(frame, asked_by=self._author)
            elif self._header is None:
                raise DamagedDataError("bad_frame", "a reply must begin with its header")
            elif isinstance(frame, More):
                self.has_more = bool(self._framed)
            elif frame.to_cursor != self._header.to_cursor:
                raise DamagedDataError("bad_frame", "a frame leads to another state than its header")
            elif isinstance(frame, CellFrame):
                self._take_cell(frame)
            else:
                self._finish(frame)

    def _take_cell(self, frame: CellFrame) -> None:
        self._framed.add(frame.cell)
        held = self._replica.cells.get(frame.cell)
        stands_at = held.cursor if held else self._replica.default_cursor
        if frame.from_cursor != stands_at:  # rule 5: made for a state that this cell has left
            log.info("cell %s: frame for another cursor dropped", cell_of_key(frame.cell))
            self._has_dropped = True
            return
        apply = {
            FrameKind.FULL: self._apply_full,
            FrameKind.DELTA: self._apply_delta,
            FrameKind.STATE: self._apply_state,
            FrameKind.RESET: self._apply_reset,
        }[frame.kind]
        try:
            apply(frame)
        except DamagedDataError as exc:
            if frame.kind is FrameKind.FULL:
                self.damaged.append(frame.cell)
            if frame.kind is not FrameKind.FULL or held is None:
                self._ask_whole(frame.cell, exc.message)

    def _apply_full(self, frame: CellFrame) -> None:
        evidence = self._payload(frame)
        if fingerprint(evidence, frame.cell) != frame.fingerprint:
            raise DamagedDataError("fingerprint_mismatch", "it came whole, but not with its fingerprint")
        self._replica.hold(frame.cell, self._at_head(frame), evidence, body=frame.payload)

    def _apply_delta(self, frame: CellFrame) -> None:
        own: list[Evidence] | None = []
        if frame.own_excluded:
            held = self._replica.cells.get(frame.cell)
            news = self._coverage.minus(held.coverage) if held else self._coverage
            own = self._replica.outbox.own_evidence(frame.cell, news, self._author)
        if own is None:
            self._ask_whole(frame.cell, "own commits that a delta leaves out are not kept any more")
            return
        base = self._replica.base_evidence(frame.cell)
        self._hold_if_sound(frame, sum_evidence([base, *own, self._payload(frame)], self._replica.geometry))

    def _apply_state(self, frame: CellFrame) -> None:
        base = self._replica.base_evidence(frame.cell)
        blocks = frame.blocks if frame.blocks is not None else np.empty(0, np.uint32)
        kept = without_blocks(base, blocks)
        self._hold_if_sound(frame, sum_evidence([kept, self._payload(frame)], self._replica.geometry))

    def _apply_reset(self, frame: CellFrame) -> None:
        held = self._replica.cells.get(frame.cell)
        if frame.fingerprint != (held.fingerprint if held else ZERO):
            self._ask_whole(frame.cell, "the server has another state")
        elif held:
            self._replica.move([frame.cell], to=frame.to_cursor, coverage=self._coverage)
        else:  # an empty cell has a coverage all the same: what was taken out again must not be shown as new
            self._replica.hold_nothing(frame.cell, self._at_head(frame))

    def _finish(self, done: Done) -> None:
        """Rule 8: cells without a frame move to `to`, only if they are where they were and their sum agrees."""
        if self._has_dropped:
            return
        unframed = self._asked.keys() - self._framed
        rest = {key: cell for key in unframed if (cell := self._replica.cells.get(key)) is not None}
        total = sum((cell.fingerprint for cell in rest.values()), ZERO)
        stands = {key: cell.cursor for key, cell in rest.items()}
        if stands != {key: self._asked[key] for key in unframed} or total != done.rest_fingerprint:
            log.warning("cells without a frame do not add up to the server's; comparing all fingerprints")
            self.must_compare = True
            return
        self._replica.move(rest, to=done.to_cursor, coverage=self._coverage)
        if self._box is None:
            self._replica.set_default_cursor(done.to_cursor)
        self._replica.forget_stable_commits()
        self.is_done = True

    def _payload(self, frame: CellFrame) -> Evidence:
        if not frame.payload:
            return empty_evidence(self._replica.geometry)
        cell = decode_cell(frame.payload)
        if cell.key != frame.cell or cell.geometry != self._replica.geometry:
            raise DamagedDataError("bad_frame", f"the frame of cell {cell_of_key(frame.cell)} holds another cell")
        return cell.evidence

    def _at_head(self, frame: CellFrame) -> BaseCell:
        return BaseCell(frame.to_cursor, self._coverage, frame.fingerprint)

    def _hold_if_sound(self, frame: CellFrame, evidence: Evidence) -> None:
        if fingerprint(evidence, frame.cell) == frame.fingerprint:
            self._replica.hold(frame.cell, self._at_head(frame), evidence)
        else:
            self._ask_whole(frame.cell, MISFIT)

    def _ask_whole(self, key: CellKey, why: str) -> None:
        """The next request asks for the cell without a cursor; what is held of it is shown until then."""
        log.warning("cell %s: %s; asking for the whole cell", cell_of_key(key), why)
        if key in self._replica.cells:
            self._replica.move([key], to=None, coverage=None)
        else:
            self._replica.hold_nothing(key, UNPROVEN)
