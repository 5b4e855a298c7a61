"""The simplest thing that can follow a map with epochs: as `asker`, with rows by epoch in each cell."""

from tests.fixtures.map.histories import LAYER
from tests.fixtures.server.epoch_pushes import Histories, read_rows, rows_of
from tests.naive import history as naive_history
from tests.naive.asker import NaiveAsker
from tests.naive.history import History

from cairn_map.commits.version_vector import EMPTY
from cairn_map.wire.frames import CellFrame, FrameKind
from cairn_map.wire.messages import ReplyHeader


class NaiveEpochAsker(NaiveAsker):
    """Rows, cursor and coverage of each cell, and the asker's own commits."""

    base: Histories  # type: ignore[assignment]

    def _take(self, frame: CellFrame, header: ReplyHeader) -> None:
        key = frame.cell
        self.kinds.append(frame.kind)
        held = self.cursors.get(key, self.cursor)
        assert (str(frame.from_cursor) if frame.from_cursor else None) == held
        payload = read_rows({key: frame.payload})[key] if frame.payload else {}
        if frame.kind is FrameKind.FULL:
            self.base[key] = payload
        elif frame.kind is FrameKind.DELTA:
            news = header.coverage.minus(self.coverage.get(key, EMPTY))
            own = [commit for commit in self.own.values() if frame.own_excluded and commit.id in news]
            mine = [rows_of([commit]).get(key, {}) for commit in own]
            self.base[key] = _sum([self.base.get(key, {}), payload, *mine])
        elif frame.kind is FrameKind.STATE:
            assert frame.blocks is not None
            changed = set(frame.blocks.tolist())
            assert {voxel // 64 for row in payload.values() for voxel in row} <= changed
            before = self.base[key].items()
            kept = {epoch: {at: sums for at, sums in row.items() if at // 64 not in changed} for epoch, row in before}
            self.base[key] = _sum([kept, payload])
        else:
            raise AssertionError("this asker does not know such frames")
        found = naive_history.fingerprint(self.base[key], key, LAYER.word)
        assert found == (frame.fingerprint.first, frame.fingerprint.second)
        self.cursors[key], self.coverage[key] = header.to, header.coverage

    def rows(self) -> Histories:
        """What it holds, cells without evidence left out."""
        return {key: history for key, history in self.base.items() if history}


def _sum(histories: list[History]) -> History:
    return naive_history.history_of((epoch, row, 1) for history in histories for epoch, row in history.items())
