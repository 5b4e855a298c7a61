"""Cells that stand together: equal to a dictionary of all cells, and a round without news writes no row of a cell."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from tests.fixtures.client.made import (
    A,
    B,
    added,
    cell_frame,
    committed,
    covering,
    cursor,
    done,
    exchanged,
    foreign,
    header,
    opened,
    seen,
)

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import BaseCell, StoredBases
from cairn_client.replica.standing_cells import StandingCells
from cairn_client.sync.exchange import Exchange
from cairn_map.commits.version_vector import VersionVector
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.wire.frames import FrameKind

C1, C2, C3 = cursor(1), cursor(2), cursor(3)
X, Y = seen(1, 2, kelvin_steps=7), seen(2, 100)
STATES = [(cursor(n), covering(foreign(n))) for n in range(4)]
KEYS = [CellKey(n) for n in range(9)]


@pytest.fixture
def mole(tmp_path: Path) -> Iterator[Replica]:
    replica = opened(tmp_path / "mole")
    yield replica
    replica.close()


class NaiveCells:
    """The same as one dictionary, in which every cell moves by itself."""

    def __init__(self) -> None:
        self.cells: dict[CellKey, BaseCell] = {}
        self.together: set[CellKey] = set()
        self.state = STATES[0]

    def put(self, key: CellKey, cell: BaseCell) -> None:
        self.cells[key] = cell
        self.together.discard(key)

    def advance(self, state: tuple[object, VersionVector], joining: set[CellKey], staying: set[CellKey]) -> None:
        self.state = state  # type: ignore[assignment]
        self.together = (self.together - staying) | joining
        for key in self.together:
            self.cells[key] = replace(self.cells[key], cursor=self.state[0], coverage=self.state[1])


@pytest.mark.parametrize("seed", range(20))
def test_cells_are_those_of_one_dictionary_whatever_moves(seed: int) -> None:
    chance, naive = Random(seed), NaiveCells()
    cells = StandingCells(StoredBases({}, {}), *STATES[0])
    for _ in range(60):
        key, (place, coverage) = chance.choice(KEYS), chance.choice(STATES)
        match chance.choice(["put", "place", "advance"]):
            case "put":
                cell = BaseCell(place, coverage, Fingerprint(chance.getrandbits(64), chance.getrandbits(64)), f"{key}")
                cells.put(key, cell)
                naive.put(key, cell)
            case "place" if key in naive.cells:
                told = chance.choice([coverage, None])
                cells.place(key, cursor=place, coverage=told)
                known = naive.cells[key]
                naive.put(key, replace(known, cursor=place, coverage=known.coverage if told is None else told))
            case "advance":
                joining = set(cells.standing_at(place, coverage))
                staying = {each for each in naive.together if chance.random() < 0.2}
                cells.advance(place, coverage, joining=joining, staying=staying)
                naive.advance((place, coverage), joining, staying)
        assert dict(cells) == naive.cells
        assert len(cells) == len(naive.cells)
        assert {each for each in KEYS if cells.is_together(each)} == naive.together == set(cells) - set(cells.apart)
        assert cells.sum_together == sum((naive.cells[each].fingerprint for each in naive.together), ZERO)


def joined(replica: Replica, keys: list[CellKey]) -> list[tuple[CellKey, Evidence]]:
    """Bring cells to C1, where they stand together; their evidence."""
    frames = [cell_frame(FrameKind.FULL, C1, X, key=key) for key in keys]
    assert exchanged(replica, header(C1), *frames, done(C1)).is_done
    return [(key, X) for key in keys]


@pytest.mark.parametrize("count", [1, 40])
def test_a_round_without_news_writes_no_row_of_a_cell(mole: Replica, count: int) -> None:
    held = joined(mole, [cell_key((n, 0, 0)) for n in range(count)])
    database = mole.store._connection
    before = database.total_changes()
    assert exchanged(mole, header(C1), done(C1, *held)).is_done
    assert database.total_changes() - before == 1  # the store's age, and nothing of the state, which is the same
    before = database.total_changes()
    assert exchanged(mole, header(C2, covering(foreign(1))), done(C2, *held)).is_done
    assert database.total_changes() - before == 4  # header, age, cursor and coverage of the map
    assert {cell.cursor for cell in mole.cells.values()} == {C2}
    assert all(foreign(1) in cell.coverage for cell in mole.cells.values())


def test_cells_stand_together_again_when_the_folder_is_opened(mole: Replica, tmp_path: Path) -> None:
    held = joined(mole, [A, B])
    exchanged(mole, header(C2, covering(foreign(1))), done(C2, *held))
    mole.close()
    again = opened(tmp_path / "mole")
    try:
        assert again.cells == mole.cells
        assert Exchange(again).request().groups == []
        assert exchanged(again, header(C3), done(C3, *held)).is_done
    finally:
        again.close()


def test_a_reply_that_is_cut_leaves_the_others_together_where_they_were(mole: Replica, tmp_path: Path) -> None:
    joined(mole, [A, B])
    exchanged(mole, header(C2), cell_frame(FrameKind.FULL, C2, Y, key=B, start=C1))
    mole.close()
    again = opened(tmp_path / "mole")
    try:
        assert (again.cells[A].cursor, again.cells[B].cursor, again.default_cursor) == (C1, C2, C1)
    finally:
        again.close()


def test_a_cell_whose_whole_frame_is_damaged_stays_behind_the_others(mole: Replica, tmp_path: Path) -> None:
    joined(mole, [A, B])
    frame = cell_frame(FrameKind.FULL, C2, Y, key=A, start=C1, payload=X)
    exchange = exchanged(mole, header(C2, covering(foreign(1))), frame, done(C2, (B, X)))
    assert (exchange.is_done, exchange.damaged) == (True, [A])
    for replica in (mole, reopened(mole, tmp_path / "mole")):
        assert (replica.cells[A].cursor, replica.cells[B].cursor, replica.default_cursor) == (C1, C2, C2)
        assert (foreign(1) in replica.cells[A].coverage, foreign(1) in replica.cells[B].coverage) == (False, True)
    replica.close()


def reopened(replica: Replica, folder: Path) -> Replica:
    """The same folder, opened again."""
    replica.close()
    return opened(folder)


def test_a_cell_that_is_asked_for_whole_keeps_the_coverage_that_it_had_with_the_others(
    mole: Replica, tmp_path: Path
) -> None:
    joined(mole, [A, B])
    commit = committed(mole, Y, A)
    mole.acknowledge(commit.id)
    whole = added(X, Y)
    frame = cell_frame(FrameKind.FULL, C2, whole, key=A, start=C1)
    assert exchanged(mole, header(C2, covering(commit.id)), frame, done(C2, (B, X))).is_done
    other = cell_frame(FrameKind.RESET, C3, Y, key=A, start=C2)
    exchanged(mole, header(C3, covering(commit.id)), other, done(C3, (B, X)))
    for replica in (mole, reopened(mole, tmp_path / "mole")):
        assert (replica.cells[A].cursor, commit.id in replica.cells[A].coverage) == (None, True)
        assert replica.view.evidence(A) == whole
    replica.close()


def test_own_commits_leave_the_view_of_cells_together_once_they_are_covered(mole: Replica) -> None:
    held = joined(mole, [A, B])
    commit = committed(mole, Y, A)
    mole.acknowledge(commit.id)
    assert mole.view.evidence(A) != X
    assert exchanged(mole, header(C2, covering(commit.id)), done(C2, *held)).is_done
    assert (mole.view.evidence(A), mole.view.evidence(B)) == (X, X)


def test_a_cell_that_was_dropped_since_the_request_keeps_the_others_where_they_are(mole: Replica) -> None:
    held = joined(mole, [A, B])
    exchange = Exchange(mole)
    mole.drop_cells([B])
    exchange.take(header(C2))
    exchange.take(done(C2, *held[:1]))
    assert (exchange.is_done, exchange.must_compare) == (False, True)
    assert (mole.cells[A].cursor, mole.cells[B].cursor) == (C1, None)


def test_changes_of_cells_are_reported_once_each(mole: Replica) -> None:
    assert mole.take_changes() == []
    joined(mole, [A, B])
    assert mole.take_changes() == sorted([A, B])
    exchanged(mole, header(C2), cell_frame(FrameKind.FULL, C2, X, key=A, start=C1), done(C2, (B, X)))
    assert mole.take_changes() == []  # a frame, and the same evidence
    mole.forget_server()
    assert mole.take_changes() == sorted([A, B])
