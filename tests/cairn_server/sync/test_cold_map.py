"""A map of which bytes are in an object store, which is away at times: what needs them waits, all else goes on."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket
from tests.naive.asker import NaiveAsker, cell_frames

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.evidence.grid import Cell, CellKey, cell_key, cell_of_key
from cairn_map.wire.frames import FrameKind, frames_of
from cairn_map.wire.messages import ReplyHeader
from cairn_server.store.store_rows import MapRow

pytestmark = [pytest.mark.processes, pytest.mark.slow]

FAR = cell_key(Cell(40, 40, 0))
ROBIN = Author(RobotName("robin"), Incarnation("00000000000000bb"))


@pytest.fixture
def bucket() -> SwitchedBucket:
    """The object store."""
    return SwitchedBucket()


@dataclass
class Cold:
    """A server on a database with a map of one commit, of which nothing is in the database."""

    live: Live
    store: ColdStore
    row: MapRow
    first: Commit


@pytest.fixture
def cold(
    bucket: SwitchedBucket, newest_postgres: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Cold]:
    """A server that was started on a cold map, and tries again at once."""
    monkeypatch.setattr("cairn_server.folding.group_folding.AWAY_S", 0.2)
    with closing(ColdStore(new_database(newest_postgres).url, bucket)) as store:
        first = evidence_in(KEYS[0], n=0)
        row = folded_map(store, first)
        store.settle(row)
        with Live(tmp_path, store=store) as live:
            yield Cold(live, store, row, first)


def non_empty(live: Live, row: MapRow) -> dict[int, bytes]:
    """Cells that can be read while the object store is away."""
    with live.service.store.snapshot(row) as snapshot:
        found = [snapshot.cell(key) for key in (FAR,)]
    return {cell.key: cell.body for cell in found if cell and cell.voxels}


def is_waiting(live: Live, row: MapRow, *commits: Commit) -> bool:
    """True if one of these commits is not folded."""
    with live.service.store.snapshot(row) as snapshot:
        return not all(each.is_folded for each in snapshot.named([commit.id for commit in commits]))


def evidence_in(*keys: CellKey, n: int) -> Commit:
    """A commit in these cells."""
    return pushed(n, n, WREN, cells={key: random_evidence(n, SMALL, voxels=6, air=1) for key in keys})


def test_commits_in_hot_cells_are_folded_and_those_in_cold_ones_wait(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    bucket.is_away = True
    there, waits, more = evidence_in(FAR, n=1), evidence_in(KEYS[0], FAR, n=2), evidence_in(FAR, n=3)
    for commit in (there, waits, more):
        assert live.push(row, commit).status_code == 201
    until(lambda: not is_waiting(live, row, there, more), "what is here is folded")
    assert is_waiting(live, row, waits)
    assert live.http.get("/readyz").status_code == 200
    bucket.is_away = False
    until(lambda: not is_waiting(live, row, waits), "all is folded")
    assert read(live.cells(row)) == sum_of([cold.first, there, waits, more])


def test_a_retract_of_cold_evidence_waits_and_nothing_else_does(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    bucket.is_away = True
    assert live.retract(row, cold.first).is_success
    more = evidence_in(FAR, n=1)
    live.push(row, more)
    until(lambda: not is_waiting(live, row, more), "what is here is folded")
    bucket.is_away = False
    until(lambda: read(live.cells(row)) == sum_of([more]), "the retract took effect")


def test_a_retract_goes_on_where_the_object_store_went_away(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    hot = evidence_in(FAR, n=1)
    live.push(row, hot)
    until(lambda: not is_waiting(live, row, hot), "it is folded")
    bucket.is_away = True
    assert live.retract(row, hot, cold.first).is_success
    until(lambda: FAR not in read(non_empty(live, row)), "the first commit is taken out")
    bucket.is_away = False
    until(lambda: read(live.cells(row)) == {}, "the second one is, too")


def test_a_cell_that_is_away_is_503_and_all_others_come(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    hot = evidence_in(FAR, n=1)
    live.push(row, hot)
    until(lambda: not is_waiting(live, row, hot), "it is folded")
    bucket.is_away = True
    i, j, k = cell_of_key(KEYS[0])
    answer = live.http.get(f"/maps/{row.name}/main/cells/{i},{j},{k}")
    assert (answer.status_code, kind_of(answer)) == (503, "objects_away")
    assert answer.headers["Retry-After"] == "5"
    i, j, k = cell_of_key(FAR)
    assert live.http.get(f"/maps/{row.name}/main/cells/{i},{j},{k}").status_code == 200


def test_an_asker_gets_the_other_cells_and_this_one_later(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    hot = evidence_in(FAR, n=1)
    live.push(row, hot)
    until(lambda: not is_waiting(live, row, hot), "it is folded")
    bucket.is_away = True
    frames = frames_of(ask_missing(live, row, NaiveAsker(MOLE).request()).content)
    by_cell = cell_frames(frames)
    assert by_cell[FAR].payload
    assert (by_cell[KEYS[0]].kind, by_cell[KEYS[0]].payload) == (FrameKind.FULL, b"")
    (header,) = [frame for frame in frames if isinstance(frame, ReplyHeader)]
    assert not header.damaged
    bucket.is_away = False
    asker = NaiveAsker(MOLE)
    fetch(live, row, asker)
    assert asker.map() == sum_of([cold.first, hot])


def test_robots_that_come_now_and_then_end_with_the_map_though_all_of_it_is_cold(cold: Cold) -> None:
    live, row = cold.live, cold.live.new_map()
    there: list[Commit] = []
    askers = [NaiveAsker(MOLE), NaiveAsker(WREN), NaiveAsker(None)]
    for n in range(6):
        there.append(pushed(n, n, ROBIN))
        live.push(row, there[-1])
        if n % 2:
            live.retract(row, there[-2])
        until(lambda: not is_waiting(live, row, there[-1]), "it is folded")
        cold.store.settle(row)
        fetch(live, row, askers[n % 3])
    expected = sum_of([commit for n, commit in enumerate(there) if n % 2])
    until(lambda: read(live.cells(row)) == expected, "the retracts took effect")
    for asker in askers:
        fetch(live, row, asker)
        assert asker.map() == expected
