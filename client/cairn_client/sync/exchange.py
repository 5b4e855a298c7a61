"""One exchange: a request for what is missing, and the frames of its answer applied to a replica (SYNC.md rules 5-9).

    header   the server's state that the answer leads to
    frame    one cell's news: full, delta, state or reset          -> `_apply_*`, one function for each kind
    more     the reply ended before its cells did
    done     the cells without a frame move along                  -> `_finish`

There is no I/O except the replica's own.

A frame that does not fit is dropped, never forced: the cell then has no cursor, and the next request asks for it
whole.
"""

import logging

import numpy as np

from cairn_client.replica.outbox import Addition
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import BaseCell
from cairn_client.replica.server_cells import UNPROVEN, ServerCells
from cairn_client.sync.requests import Box
from cairn_map.codec.layer_code import decode_layer_cell
from cairn_map.commits.version_vector import EMPTY
from cairn_map.epochs.cell_history import NOTHING, CellHistory, history_fingerprint, merged
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import Cell, CellKey, cell_of_key
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import Done, MissingRequest, More, ReplyHeader

log = logging.getLogger(__name__)

MISFIT = "the frame does not lead to the server's fingerprint"


def is_within(key: CellKey, box: Box | None) -> bool:
    """True if a cell lies in a box; None is everywhere."""
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
        """Begin an exchange from the replica's cursors as they are now.

        Args:
            replica: the robot's state.
            compare: True to ask for the fingerprint of every cell, and not for what changed since its cursor.
            box: cells to ask for; None: all.
            reply_bytes_max: bytes of cells after which the reply ends; None: as many as the server likes.
            near: cell whose neighbours come first.
        """
        # Where every cell stands as the request is made: rules 5 and 8 hold the answer against it.
        self._replica = replica
        with replica.changing() as base:  # author and cursors are of one instant
            self._author = replica.author
            self._held = replica.header
            self._default = base.default_cursor
            # Where all cells are asked for by the map's own cursor, only those that stand elsewhere are looked at.
            self._group = base.cells.group if box is None and not compare else None
            listed = base.cells if self._group is None else base.cells.apart
            self._asked = {key: cell.cursor for key, cell in listed.items() if is_within(key, box)}
        self._since = self._stated_since()
        # The request's bounds.
        self._compare = compare
        self._box = box
        self._reply_bytes_max = reply_bytes_max
        self._near = near
        # What was taken of the answer so far; the coverage is the header's, one for all frames (rule 3).
        self._header: ReplyHeader | None = None
        self._coverage = EMPTY
        self._framed: set[CellKey] = set()
        self._left_by_frames = 0
        self._has_dropped = False
        self.damaged: list[CellKey] = []
        """Cells that came whole, but not sound: they are requested again, and the others are not held up."""
        self.is_done = False
        """True once all cells of the request stand at the server's state."""
        self.has_more = False
        """True if the reply ended before its cells did: the next request asks for the rest."""
        self.must_compare = False
        """True if the next request is to compare the fingerprints of all cells."""

    def request(self) -> MissingRequest:
        """The request: the replica's default cursor, and the cursors of the cells that stand elsewhere."""
        # A cell at the default cursor is not listed: a round without news stays a few hundred bytes.
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
            since=self._since,
        )

    def _stated_since(self) -> str | None:
        """State of the header held, whose vector need not come again; shortly where all cells stand there."""
        if self._held is None:
            return None
        return "cursor" if self._default is not None and self._held.to == str(self._default) else self._held.to

    def take(self, frame: Frame) -> None:
        """Apply one frame of the answer.

        Raises:
            DamagedDataError: frames in an impossible order.
        """
        # One frame in one hold of the lock: other threads commit between two frames, never within one.
        with self._replica.changing() as base:
            if isinstance(frame, ReplyHeader):
                # Rule 6: coverage is of all ids, so what was held at `since` is part of it.
                self._header = frame.whole(self._held, since=self._since)
                self._coverage = self._header.coverage
                self._replica.take_header(self._header, asked_by=self._author)
            elif self._header is None:
                raise DamagedDataError("bad_frame", "a reply must begin with its header")
            elif isinstance(frame, More):
                # Without a frame it brought nothing: it then counts as a round, of which there are few (`ROUNDS_MAX`).
                self.has_more = bool(self._framed)
            elif frame.to_cursor != self._header.to_cursor:
                raise DamagedDataError("bad_frame", "a frame leads to another state than its header")
            elif isinstance(frame, CellFrame):
                self._take_cell(base, frame)
            else:
                self._finish(base, frame)

    def _take_cell(self, base: ServerCells, frame: CellFrame) -> None:
        self._framed.add(frame.cell)
        # Rule 5: only a frame that was made for the cursor at which the cell stands fits.
        stands_at = base.cursor(frame.cell)
        if frame.from_cursor != stands_at:
            log.info("cell %s: frame for another cursor dropped", cell_of_key(frame.cell))
            self._has_dropped = True
            return
        apply = {
            FrameKind.FULL: self._apply_full,
            FrameKind.DELTA: self._apply_delta,
            FrameKind.STATE: self._apply_state,
            FrameKind.RESET: self._apply_reset,
        }[frame.kind]
        stood_together = base.cells.is_together(frame.cell)
        # A frame that leads to no sound cell changes nothing, and the cell is asked for whole.
        try:
            apply(base, frame)
        except DamagedDataError as exc:
            if frame.kind is FrameKind.FULL:
                self.damaged.append(frame.cell)
            if frame.kind is not FrameKind.FULL or frame.cell not in base.cells:
                self._ask_whole(base, frame.cell, exc.message)
        self._left_by_frames += stood_together and not base.cells.is_together(frame.cell)

    def _apply_full(self, base: ServerCells, frame: CellFrame) -> None:
        history = self._payload(frame)
        if self._fingerprint(history, frame.cell) != frame.fingerprint:
            raise DamagedDataError("fingerprint_mismatch", "it came whole, but not with its fingerprint")
        base.hold(frame.cell, self._at_head(frame), history, body=frame.payload)

    def _apply_delta(self, base: ServerCells, frame: CellFrame) -> None:
        own: list[Addition] | None = []
        # Rule 6: own commits between the two vectors are left out of the sum, so they are added from here.
        if frame.own_excluded:
            news = self._coverage.minus(base.coverage(frame.cell))
            own = self._replica.outbox.own_evidence(frame.cell, news, self._author)
        if own is None:
            self._ask_whole(base, frame.cell, "own commits that a delta leaves out are not kept any more")
            return
        # Fingerprints add as evidence does: neither the sums nor the bytes of the whole cell are made.
        added = [*own, Addition(frame.payload, self._payload(frame))] if frame.payload else own
        held = base.cells.get(frame.cell)
        total = held.fingerprint if held else ZERO
        total = sum((self._fingerprint(each.history, frame.cell) for each in added), total)
        if total == frame.fingerprint:
            base.add(frame.cell, self._at_head(frame), added)
        else:
            self._ask_whole(base, frame.cell, MISFIT)

    def _apply_state(self, base: ServerCells, frame: CellFrame) -> None:
        before = base.history(frame.cell)
        blocks = frame.blocks if frame.blocks is not None else np.empty(0, np.uint32)
        # The blocks of the mask are replaced whole, in all rows (rule T3): where the payload has no voxel, there is
        # none any more (rule 4).
        kept = before.without_blocks(blocks)
        self._hold_if_sound(base, frame, merged([kept, self._payload(frame)], self._replica.geometry))

    def _apply_reset(self, base: ServerCells, frame: CellFrame) -> None:
        held = base.cells.get(frame.cell)
        if frame.fingerprint != (held.fingerprint if held else ZERO):
            self._ask_whole(base, frame.cell, "the server has another state")
        elif held:
            base.move([frame.cell], to=frame.to_cursor, coverage=self._coverage)
        else:  # an empty cell has a coverage all the same: what was taken out again must not be shown as new
            base.hold_nothing(frame.cell, self._at_head(frame))

    def _finish(self, base: ServerCells, done: Done) -> None:
        """Rule 8: cells without a frame move to `to`, only if they are where they were and their sum agrees."""
        # A cell moved under this exchange: it moves nothing more, and the next request begins from where all stand.
        if self._has_dropped:
            return
        # The cells without a frame, as they stand now, add up to the sum that the server states.
        unframed = self._asked.keys() - self._framed
        rest = {key: cell for key in unframed if (cell := base.cells.get(key)) is not None}
        total = sum((cell.fingerprint for cell in rest.values()), ZERO)
        stands = {key: cell.cursor for key, cell in rest.items()}
        # A frame that brought nothing sound leaves its cell where it was, with the others: it stays behind.
        staying = [key for key in self._framed if base.cells.is_together(key)]
        if self._group is not None:
            total += base.cells.sum_together - sum((base.cells[key].fingerprint for key in staying), ZERO)
        if (
            stands != {key: self._asked[key] for key in unframed}
            or not self._stands_as_asked(base)
            or total != done.rest_fingerprint
        ):
            log.warning("cells without a frame do not add up to the server's; comparing all fingerprints")
            self.must_compare = True
            return
        # All of them move at once; a cell that is not held moves with the default cursor, unless a box was asked for.
        if self._box is None:
            base.advance(done.to_cursor, self._coverage, joining=rest, staying=staying)
        else:
            base.move(rest, to=done.to_cursor, coverage=self._coverage)
        self._replica.forget_stable_commits()
        self.is_done = True

    def _stands_as_asked(self, base: ServerCells) -> bool:
        """True if no cell that stood with the others at the request left them, but for a frame of this answer."""
        if self._group is None:
            return True
        now = base.cells.group
        is_same = now.version == self._group.version or not self._group.count
        return is_same and self._group.count - now.count == self._left_by_frames

    def _payload(self, frame: CellFrame) -> CellHistory:
        # Nothing to add, or no block that still holds evidence.
        return decode_layer_cell(frame.payload, frame.cell, self._replica.layer).history if frame.payload else NOTHING

    def _fingerprint(self, history: CellHistory, key: CellKey) -> Fingerprint:
        return history_fingerprint(history, key, layer_word=self._replica.layer.word)

    def _at_head(self, frame: CellFrame) -> BaseCell:
        return BaseCell(frame.to_cursor, self._coverage, frame.fingerprint)

    def _hold_if_sound(self, base: ServerCells, frame: CellFrame, history: CellHistory) -> None:
        if self._fingerprint(history, frame.cell) == frame.fingerprint:
            base.hold(frame.cell, self._at_head(frame), history)
        else:
            self._ask_whole(base, frame.cell, MISFIT)

    def _ask_whole(self, base: ServerCells, key: CellKey, why: str) -> None:
        """Take a cell's cursor away, so that the next request asks for it whole; its evidence is shown until then."""
        log.warning("cell %s: %s; asking for the whole cell", cell_of_key(key), why)
        if key in base.cells:
            base.move([key], to=None, coverage=None)
        else:
            base.hold_nothing(key, UNPROVEN)
