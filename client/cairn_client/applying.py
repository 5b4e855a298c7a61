"""Frames onto a replica: SYNC.md rules 5 to 9, one function for each kind of frame. No I/O but the replica's own.

A frame that does not fit is dropped, never forced: the cell then has no cursor, and the next request asks for it
whole.
"""

import logging

import numpy as np
import numpy.typing as npt

from cairn_client.replica import Replica, base_cell
from cairn_client.replica_store import BaseCell
from cairn_map.brick_cell import sum_evidence
from cairn_map.cell_code import decode_cell
from cairn_map.cursor import Cursor
from cairn_map.errors import DamagedDataError
from cairn_map.evidence import Evidence, empty_evidence
from cairn_map.fingerprint import ZERO, Fingerprint, fingerprint
from cairn_map.frames import CellFrame, Frame, FrameKind
from cairn_map.grid import CellKey, cell_of_key
from cairn_map.messages import CellCursor, Done, MissingRequest, More, ReplyHeader
from cairn_map.version_vector import EMPTY

log = logging.getLogger(__name__)

BLOCK_BITS = 6
"""A 4^3 block is a voxel's Morton code without its six lowest bits."""


class Exchange:
    """One request for what is missing, and the frames of its answer."""

    def __init__(self, replica: Replica, *, compare: bool = False) -> None:
        self._replica = replica
        with replica.lock:
            self._default = replica.default_cursor
            self._asked = {key: cell.cursor for key, cell in replica.cells.items()}
        self._compare = compare
        self._header: ReplyHeader | None = None
        self._framed: set[CellKey] = set()
        self.is_done = False
        self.must_compare = False

    def request(self) -> MissingRequest:
        """What this replica holds: the default cursor, and every cell that stands elsewhere."""
        listed = [(key, cursor) for key, cursor in self._asked.items() if self._compare or cursor != self._default]
        return MissingRequest(
            author=str(self._replica.author),
            cursor=str(self._default) if self._default else None,
            cells=[CellCursor(cell=cell_of_key(k), cursor=str(c) if c else None) for k, c in sorted(listed)],
            compare=self._compare,
        )

    def take(self, frame: Frame) -> None:
        """Apply one frame of the answer.

        Raises:
            DamagedDataError: frames in an impossible order, or a whole cell whose fingerprint does not fit it.
        """
        with self._replica.lock:
            if isinstance(frame, ReplyHeader):
                self._header = frame
                self._replica.take_header(frame)
                return
            if self._header is None:
                raise DamagedDataError("bad_frame", "a reply must begin with its header")
            if isinstance(frame, CellFrame):
                self._take_cell(frame, self._header)
            elif isinstance(frame, Done):
                self._finish(frame, self._header)
            elif isinstance(frame, More):
                self.is_done = False

    def _take_cell(self, frame: CellFrame, header: ReplyHeader) -> None:
        if frame.to_cursor != header.to_cursor:
            raise DamagedDataError("bad_frame", "a cell frame leads to another state than its header")
        self._framed.add(frame.cell)
        held = self._replica.cells.get(frame.cell)
        stands_at = held.cursor if held else self._replica.default_cursor
        if frame.from_cursor != stands_at:  # rule 5: made for a state that this cell has left
            log.info("cell %s: frame for another cursor dropped", cell_of_key(frame.cell))
            return
        apply = {
            FrameKind.FULL: self._apply_full,
            FrameKind.DELTA: self._apply_delta,
            FrameKind.STATE: self._apply_state,
            FrameKind.RESET: self._apply_reset,
        }[frame.kind]
        apply(frame, header)

    def _apply_full(self, frame: CellFrame, header: ReplyHeader) -> None:
        evidence = self._payload(frame)
        if fingerprint(evidence, frame.cell) != frame.fingerprint:
            raise DamagedDataError(
                "fingerprint_mismatch",
                f"cell {cell_of_key(frame.cell)} came whole, but not with its fingerprint; the server may be damaged",
            )
        self._hold(frame, header, evidence)

    def _apply_delta(self, frame: CellFrame, header: ReplyHeader) -> None:
        own: list[Evidence] | None = []
        if frame.own_excluded:
            held = self._replica.cells.get(frame.cell)
            news = header.coverage.minus(held.coverage) if held else header.coverage
            author = self._replica.author
            mine = [commit for commit in self._replica.commits if commit.author == author and commit in news]
            own = self._replica.own_evidence(frame.cell, mine)
        if own is None:
            self._ask_whole(frame.cell, "own commits that a delta leaves out are not kept any more")
            return
        base = self._replica.base_evidence(frame.cell)
        evidence = sum_evidence([base, *own, self._payload(frame)], self._replica.geometry)
        self._hold_if_sound(frame, header, evidence)

    def _apply_state(self, frame: CellFrame, header: ReplyHeader) -> None:
        base = self._replica.base_evidence(frame.cell)
        blocks = frame.blocks if frame.blocks is not None else np.empty(0, np.uint32)
        kept = without_blocks(base, blocks)
        self._hold_if_sound(frame, header, sum_evidence([kept, self._payload(frame)], self._replica.geometry))

    def _apply_reset(self, frame: CellFrame, header: ReplyHeader) -> None:
        held = self._replica.cells.get(frame.cell)
        if held is None:
            if frame.fingerprint != ZERO:
                empty = empty_evidence(self._replica.geometry)
                unproven = BaseCell(None, EMPTY, ZERO)
                self._replica.hold(frame.cell, unproven, empty)
            return
        if held.fingerprint == frame.fingerprint:
            self._replica.move([frame.cell], to=frame.to_cursor, coverage=header.coverage)
            self._replica.refresh_view(frame.cell)
        else:
            self._ask_whole(frame.cell, "the server went back to an older state")

    def _finish(self, done: Done, header: ReplyHeader) -> None:
        """Rule 8: cells without a frame move to `to`, only if they are where they were and their sum agrees."""
        rest = {key for key in self._asked if key not in self._framed}
        if self._header is None or done.to_cursor != header.to_cursor:
            raise DamagedDataError("bad_frame", "the reply ends at another state than its header")
        moved = [key for key in rest if self._replica.cells[key].cursor == self._asked[key]]
        total = Fingerprint()
        for key in rest:
            total += self._replica.cells[key].fingerprint
        if len(moved) < len(rest) or total != done.rest_fingerprint:
            log.warning("cells without a frame do not add up to the server's; comparing all fingerprints")
            self.must_compare = True
            return
        self._replica.move(moved, to=done.to_cursor, coverage=header.coverage)
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

    def _hold(self, frame: CellFrame, header: ReplyHeader, evidence: Evidence) -> None:
        self._replica.hold(frame.cell, _based(frame.cell, evidence, frame.to_cursor, header), evidence)

    def _hold_if_sound(self, frame: CellFrame, header: ReplyHeader, evidence: Evidence) -> None:
        if fingerprint(evidence, frame.cell) == frame.fingerprint:
            self._hold(frame, header, evidence)
        else:
            self._ask_whole(frame.cell, "the frame does not lead to the server's fingerprint")

    def _ask_whole(self, key: CellKey, why: str) -> None:
        log.warning("cell %s: %s; asking for the whole cell", cell_of_key(key), why)
        if key in self._replica.cells:
            self._replica.move([key], to=None, coverage=None)
        else:
            empty = empty_evidence(self._replica.geometry)
            self._replica.hold(key, BaseCell(None, EMPTY, ZERO), empty)


def without_blocks(evidence: Evidence, blocks: npt.NDArray[np.uint32]) -> Evidence:
    """Packed evidence without the voxels of the given 4^3 blocks."""
    keep = ~np.isin(evidence.voxels >> np.uint32(BLOCK_BITS), blocks)
    kept_rows = keep[evidence.sampled]
    new_row = np.cumsum(keep) - 1
    return Evidence(
        evidence.voxels[keep],
        evidence.counts[keep],
        new_row[evidence.sampled[kept_rows]].astype(np.uint32),
        evidence.samples[kept_rows],
    )


def _based(key: CellKey, evidence: Evidence, cursor: Cursor, header: ReplyHeader) -> BaseCell:
    return base_cell(key, evidence, cursor=cursor, coverage=header.coverage)
