"""A map of which bytes are in an object store, which is away at times: what needs them waits, all else goes on."""

import hashlib
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.commit_contract import folded_map
from tests.fixtures.server.evidence_contract import SOON
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.settled_store import ColdStore, SwitchedBucket, drain
from tests.fixtures.server.store_contract import new_of
from tests.naive.asker import NaiveAsker, cell_frames

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.evidence.grid import Cell, CellKey, cell_key, cell_of_key
from cairn_map.wire.frames import FrameKind, frames_of
from cairn_map.wire.messages import ReplyHeader
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.group_folding import AWAY_MAX_S, AWAY_S, LocalFolding, Waiting, fold_around
from cairn_server.folding.store_check import check_map
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store_rows import MapRow, StoredCommit
from cairn_server.views.cell_views import first_depth, view_name
from cairn_server.views.view_prefetch import ViewPrefetch

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


def test_a_hot_cell_of_cold_evidence_comes_whole(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    asker = NaiveAsker(MOLE)
    fetch(live, row, asker)
    more = [evidence_in(KEYS[0], n=n) for n in (1, 2)]
    for commit in more:
        live.push(row, commit)
        until(lambda commit=commit: not is_waiting(live, row, commit), "it is folded")
    drain(cold.store.settler.settle_evidence(row, before_s=SOON, age_s=0.0))
    bucket.is_away = True
    fetch(live, row, asker)
    assert asker.map() == sum_of([cold.first, *more])


def test_a_delta_of_which_the_segment_is_lost_is_sent_as_the_whole_cell(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    asker = NaiveAsker(MOLE)
    fetch(live, row, asker)
    more = evidence_in(KEYS[0], n=1)
    live.push(row, more)
    until(lambda: not is_waiting(live, row, more), "it is folded")
    drain(cold.store.settler.settle_evidence(row, before_s=SOON, age_s=0.0))
    for name in bucket.objects():
        if name.startswith("segments/"):
            bucket.delete(name)
    fetch(live, row, asker)
    assert asker.map() == sum_of([cold.first, more])


def test_a_reply_of_cells_that_are_away_is_one_line_in_the_log(
    cold: Cold, bucket: SwitchedBucket, caplog: pytest.LogCaptureFixture
) -> None:
    live, row = cold.live, cold.row
    more = evidence_in(*KEYS, n=1)
    live.push(row, more)
    until(lambda: not is_waiting(live, row, more), "it is folded")
    cold.store.settle(row)
    bucket.is_away = True
    frames = frames_of(ask_missing(live, row, NaiveAsker(MOLE).request()).content)
    assert len(cell_frames(frames)) == len(KEYS)
    assert caplog.text.count("is sent without its bytes") == 1


def test_a_check_of_a_store_that_is_away_is_no_finding(newest_postgres: PostgresServer, bucket: SwitchedBucket) -> None:
    with closing(ColdStore(new_database(newest_postgres).url, bucket)) as store:
        row = folded_map(store, evidence_in(FAR, n=0))
        drain(store.settler.settle_cells(row, to_seq=9, age_s=0.0))
        bucket.is_away = True
        with pytest.raises(AwayError):
            check_map(store, row, lambda done, total: None)


def test_the_state_of_an_upload_is_known_without_its_evidence(cold: Cold, bucket: SwitchedBucket) -> None:
    bucket.is_away = True
    path = f"/maps/{cold.row.name}/commits/{cold.first.id}/upload"
    answer = cold.live.http.get(path, params={"digest": hashlib.sha256(cold.first.data).hexdigest()})
    assert (answer.status_code, answer.json()["sha"]) == (200, cold.first.sha.hex())


def test_views_of_hot_cells_are_made_ahead_while_others_are_away(cold: Cold, bucket: SwitchedBucket) -> None:
    live, row = cold.live, cold.row
    hot = evidence_in(FAR, n=1)
    live.push(row, hot)
    until(lambda: not is_waiting(live, row, hot), "it is folded")
    bucket.is_away = True
    depth, views = first_depth(row.geometry.depth), live.service.views.cells.cache
    with live.service.store.snapshot(row) as snapshot:
        (cell,) = snapshot.cells_of([FAR])
    with closing(ViewPrefetch(live.service.store, views, live.service.fold_news, look_every_s=0.01)):
        until(lambda: views.has(view_name(row, cell, depth)), "the view is made")


def test_a_retract_under_way_is_pending_without_its_own_cold_evidence(
    cold: Cold, bucket: SwitchedBucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.folding.commit_work.PART_NAMES_MAX", 1)
    live, row = cold.live, cold.row
    targets = [evidence_in(FAR, n=1), evidence_in(KEYS[0], n=2)]
    for commit in targets:
        live.push(row, commit)
    until(lambda: not is_waiting(live, row, *targets), "they are folded")
    cold.store.settle(row)
    bucket.is_away = True
    cells = {cell_key(Cell(80, 0, 0)): random_evidence(3, SMALL, voxels=6)}
    retract = pushed(3, 3, WREN, retracts=reversed(targets), cells=cells)
    live.push(row, retract)
    until(lambda: not is_waiting(live, row, retract), "its own evidence is folded")
    bucket.is_away = False
    drain(cold.store.settler.settle_evidence(row, before_s=SOON, age_s=0.0))
    bucket.is_away = True
    (pending,) = cold.store.pending(row, limit=9, size_bytes_max=1 << 20)
    assert (pending.id, pending.diff) == (retract.id, {})


class CountingStore(ColdStore):
    """A store that counts the commits that are read to be folded."""

    count = 0

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """As a store does."""
        found = super().pending(row, limit=limit, size_bytes_max=size_bytes_max, skip=skip)
        self.count += len(found)
        return found


def test_of_all_commits_that_wait_one_is_read_again_until_the_store_is_back(
    newest_postgres: PostgresServer, bucket: SwitchedBucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.folding.group_folding.AWAY_S", 1e-9)
    with closing(CountingStore(new_database(newest_postgres).url, bucket)) as store:
        row = folded_map(store, evidence_in(KEYS[0], n=0))
        store.settle(row)
        bucket.is_away = True
        waits = [evidence_in(KEYS[0], n=n) for n in range(1, 9)]
        for commit in waits:
            store.append(row, new_of(commit))
        folding, store.count = LocalFolding(store, DamagedCells()), 0
        assert folding.fold(row).commits == 0
        assert store.count == len(waits)
        for turn in range(1, 5):
            assert isinstance(folding.fold(row).waits_for, AwayError)
            assert store.count == len(waits) + turn
        bucket.is_away = False
        assert folding.fold(row).commits == 1
        again = folding.fold(row)
        assert (again.commits, again.waits_for) == (len(waits) - 1, None)
        folding.close()


def test_the_time_until_the_next_attempt_doubles_up_to_a_bound(
    newest_postgres: PostgresServer, bucket: SwitchedBucket
) -> None:
    with closing(ColdStore(new_database(newest_postgres).url, bucket)) as store:
        row = folded_map(store, evidence_in(KEYS[0], n=0))
        store.settle(row)
        bucket.is_away = True
        store.append(row, new_of(evidence_in(KEYS[0], n=1)))
        waiting, cache, damaged, waits_s = Waiting(), CellCache(row.geometry), DamagedCells(), []
        for _ in range(6):
            assert fold_around(store, row, cache, waiting, damaged, limit=9) == 0
            assert waiting.away_s is not None
            waits_s.append(waiting.away_wait_s)
            waiting.away_s -= AWAY_MAX_S + 1
    assert waits_s == [0.0, 2 * AWAY_S, 4 * AWAY_S, 8 * AWAY_S, AWAY_MAX_S, AWAY_MAX_S]


def test_a_plan_whose_bytes_are_away_waits_and_is_planned_again(
    newest_postgres: PostgresServer, bucket: SwitchedBucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_server.folding.group_folding.AWAY_S", 1e-9)
    monkeypatch.setattr("cairn_server.folding.fold_lanes.slice_s", lambda size_bytes: -1.0)
    with closing(ColdStore(new_database(newest_postgres).url, bucket)) as store:
        row = folded_map(store, pushed(0, 0), pushed(0, 0, WREN))
        drain(store.settler.settle_evidence(row, before_s=SOON, age_s=0.0))
        bucket.is_away = True
        retract = pushed(1, 1, WREN, retracts=[pushed(0, 0)])
        store.append(row, new_of(retract))
        folding = LocalFolding(store, DamagedCells())
        until(lambda: isinstance(folding.fold(row).waits_for, AwayError), "the plan waits")
        bucket.is_away = False
        until(lambda: folding.fold(row).commits > 0, "it is folded")
        assert folding._lanes._unplanned == set()
        folding.close()


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
