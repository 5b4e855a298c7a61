"""The simplest thing that can follow a map: plain dictionaries, SYNC.md rules 5 to 9, nothing durable."""

from collections.abc import Iterable

from tests import naive
from tests.cairn_map.made import as_dict
from tests.cairn_server.sync.pushes import Cells

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key
from cairn_map.wire.frames import CellFrame, Frame, FrameKind
from cairn_map.wire.messages import CellCursor, Done, MissingRequest, More, ReplyHeader


class NaiveAsker:
    """Base, cursor and coverage of each cell, and the asker's own commits."""

    def __init__(self, author: Author | None, *, asks_for: tuple[str, ...] = ("delta", "full")) -> None:
        self.author = author
        self.asks_for = asks_for
        self.own: dict[int, Commit] = {}
        self.base: Cells = {}
        self.cursor: str | None = None
        self.cursors: dict[CellKey, str | None] = {}
        self.coverage: dict[CellKey, VersionVector] = {}
        self.kinds: list[FrameKind] = []

    def request(self, **fields: object) -> MissingRequest:
        """What it holds."""
        cells = [CellCursor(cell=cell_of_key(key), cursor=cursor) for key, cursor in self.cursors.items()]
        author = str(self.author) if self.author else None
        return MissingRequest.model_validate(
            {"author": author, "cursor": self.cursor, "cells": cells, "kinds": list(self.asks_for)} | fields
        )

    def take(self, frames: Iterable[Frame]) -> bool:
        """Apply a reply; whether it was whole."""
        header, *rest = frames
        assert isinstance(header, ReplyHeader)
        framed: dict[CellKey, Fingerprint] = {}
        for frame in rest:
            if isinstance(frame, CellFrame):
                self._take(frame, header)
                framed[frame.cell] = frame.fingerprint
            elif isinstance(frame, Done):
                assert frame.to == header.to
                self.cursor = header.to
                self.cursors = dict.fromkeys(self.cursors, header.to)
                self.coverage = dict.fromkeys(self.coverage, header.coverage)
                return True
            else:
                assert isinstance(frame, More)
        return False

    def _take(self, frame: CellFrame, header: ReplyHeader) -> None:
        key = frame.cell
        self.kinds.append(frame.kind)
        assert str(frame.to_cursor) == header.to
        held = self.cursors.get(key, self.cursor)
        assert (str(frame.from_cursor) if frame.from_cursor else None) == held
        payload = as_dict(decode_cell(frame.payload).evidence) if frame.payload else {}
        if frame.kind is FrameKind.FULL:
            self.base[key] = payload
        elif frame.kind is FrameKind.DELTA:
            news = header.coverage.minus(self.coverage.get(key, EMPTY))
            total = self.base.get(key, {})
            for commit in self.own.values() if frame.own_excluded else ():
                if commit.id in news and key in commit.cells:
                    total = naive.merged(total, as_dict(decode_cell(commit.cells[key]).evidence))
            self.base[key] = naive.merged(total, payload)
        elif frame.kind is FrameKind.STATE:
            assert frame.blocks is not None
            changed = set(frame.blocks.tolist())
            assert {voxel // 64 for voxel in payload} <= changed
            kept = {voxel: sums for voxel, sums in self.base[key].items() if voxel // 64 not in changed}
            self.base[key] = kept | payload
        else:
            raise AssertionError("this asker does not know such frames")
        assert naive.fingerprint(self.base[key], key) == (frame.fingerprint.first, frame.fingerprint.second)
        self.cursors[key], self.coverage[key] = header.to, header.coverage

    def map(self) -> Cells:
        """What it holds, cells without evidence left out."""
        return {key: evidence for key, evidence in self.base.items() if evidence}


def fingerprint_sum(frames: Iterable[Frame]) -> Fingerprint:
    """Of all cell frames."""
    total = ZERO
    for frame in frames:
        if isinstance(frame, CellFrame):
            total += frame.fingerprint
    return total


def cell_frames(frames: Iterable[Frame]) -> dict[CellKey, CellFrame]:
    """The cell frames, by cell."""
    return {frame.cell: frame for frame in frames if isinstance(frame, CellFrame)}


KEY_FAR = cell_key((500, -500, 3))
