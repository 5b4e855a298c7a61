"""Folding within a bound of memory, and around what is damaged at rest."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import apsw
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import NAMES, new_of

from cairn_map.commits.commit import Commit
from cairn_map.evidence.grid import cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding import fold_thread, group_folding
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.folding import fold_pending
from cairn_server.store.history import head_of
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store_rows import MapRow


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SqliteStore]:
    made = SqliteStore(tmp_path_factory.mktemp("folding"))
    yield made
    made.close()


def new_map(store: SqliteStore, *commits: Commit) -> MapRow:
    row, _ = store.create_map(next(NAMES), SMALL, SensorModel())
    for commit in commits:
        store.append(row, new_of(commit))
    return row


def cells(store: SqliteStore, row: MapRow) -> dict[int, bytes]:
    with store.snapshot(row) as snapshot:
        found = [snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels]
    return {cell.key: cell.body for cell in found if cell}


def damage(store: SqliteStore, change: str, *values: Any) -> None:
    """Change the file behind the store's back."""

    def job(connection: apsw.Connection) -> None:
        connection.execute(change, values)
        assert connection.changes()

    store._writer.run(job)


ONE_CELL_BYTES = 130_000
ONE_DIFF = "commit_number = (SELECT number FROM commits WHERE map = ? AND robot = ? AND n = ?)"


def damage_diff(store: SqliteStore, row: MapRow, commit: Commit) -> None:
    """Put one of the commit's cells where another was: sound bytes, but not those that were pushed."""
    body = next(iter(pushed(9, 5).cells.values()))
    target = (row.number, commit.id.author.robot, commit.id.n)
    damage(store, f"UPDATE diff SET body = ? WHERE {ONE_DIFF} AND cell = ?", body, *target, max(commit.cells))


@settings(max_examples=10)
@given(
    st.lists(st.integers(0, 20), min_size=1, max_size=8),
    st.integers(1, 4),
    st.sampled_from([0, 150_000, 1 << 30]),
    st.sampled_from([0, 4000, 1 << 30]),
)
def test_grouping_and_memory_make_no_difference(
    store: SqliteStore, seeds: list[int], group: int, limit_bytes: int, spool_bytes: int
) -> None:
    commits = [pushed(n, seed) for n, seed in enumerate(seeds)]
    row, other = new_map(store, *commits), new_map(store, *reversed(commits))
    cache = CellCache(SMALL, FoldMemory(limit_bytes, spool_bytes=spool_bytes))
    while fold_pending(store, row, cache, limit=group):
        assert cache.size_bytes <= max(limit_bytes, ONE_CELL_BYTES)
    fold_pending(store, other, CellCache(SMALL), limit=64)
    assert cells(store, row) == cells(store, other)
    assert read(cells(store, row)) == sum_of(commits)


def test_a_cache_that_is_older_than_the_map_is_not_used(store: SqliteStore) -> None:
    row = new_map(store, pushed(0, 1))
    mine, other = CellCache(SMALL), CellCache(SMALL)
    fold_pending(store, row, mine, limit=9)
    store.append(row, new_of(pushed(1, 1)))
    fold_pending(store, row, other, limit=9)
    store.append(row, new_of(pushed(2, 1)))
    fold_pending(store, row, mine, limit=9)
    assert read(cells(store, row)) == sum_of([pushed(n, 1) for n in range(3)])


@pytest.mark.parametrize("how", ["other bytes", "torn", "gone"])
def test_a_damaged_commit_is_set_aside_and_repaired_by_pushing_it_again(store: SqliteStore, how: str) -> None:
    bad, good = pushed(0, 1), pushed(0, 1, WREN)
    row = new_map(store, bad, good)
    if how == "other bytes":
        damage_diff(store, row, bad)
    else:
        body = b"torn" if how == "torn" else None
        damage(store, f"UPDATE diff SET body = ? WHERE {ONE_DIFF}", body, row.number, "mole", 0)
    cache = CellCache(SMALL)
    assert fold_pending(store, row, cache, limit=9) == 2
    assert fold_pending(store, row, cache, limit=9) == 0
    assert read(cells(store, row)) == sum_of([good])
    with store.snapshot(row) as snapshot:
        assert bad.id not in snapshot.pending()
        assert bad.id not in head_of(snapshot).vector
    assert store.append(row, new_of(bad))
    assert fold_pending(store, row, cache, limit=9) == 1
    assert read(cells(store, row)) == sum_of([bad, good])
    assert not store.append(row, new_of(bad))


def test_a_retract_of_a_damaged_commit_holds_up_nobody_and_may_be_tried_again(store: SqliteStore) -> None:
    bad, good = pushed(0, 1), pushed(0, 1, WREN)
    row = new_map(store, bad, good)
    cache = CellCache(SMALL)
    fold_pending(store, row, cache, limit=9)
    damage_diff(store, row, bad)
    store.append(row, new_of(pushed(1, 0, cells={}, retracts=[bad, good])))
    store.append(row, new_of(pushed(2, 2)))
    assert fold_pending(store, row, cache, limit=9) == 2
    assert read(cells(store, row)) == sum_of([bad, pushed(2, 2)])
    assert not store.is_retracted(row, bad.id)
    sound = bad.cells[max(bad.cells)]
    target = (row.number, "mole", 0, max(bad.cells))
    damage(store, f"UPDATE diff SET body = ? WHERE {ONE_DIFF} AND cell = ?", sound, *target)
    store.append(row, new_of(pushed(3, 0, cells={}, retracts=[bad])))
    fold_pending(store, row, cache, limit=9)
    assert read(cells(store, row)) == sum_of([pushed(2, 2)])


@pytest.mark.parametrize("column", ["body", "digest"])
def test_a_damaged_cell_is_made_anew_from_the_log(store: SqliteStore, column: str) -> None:
    commits = [pushed(n, 1) for n in range(3)]
    row = new_map(store, *commits[:2])
    fold_pending(store, row, CellCache(SMALL), limit=9)
    damage(store, f"UPDATE cell SET {column} = ? WHERE map = ?", b"x" * 32, row.number)
    store.append(row, new_of(commits[2]))
    fold_pending(store, row, CellCache(SMALL), limit=9)
    assert read(cells(store, row)) == sum_of(commits)


def test_a_damaged_cell_is_an_error_of_the_server_when_read(live: Live) -> None:
    row = live.new_map()
    live.push(row, commit := pushed(0, 1))
    live.folded(row)
    store = live.service.store
    assert isinstance(store, SqliteStore)
    damage(store, "UPDATE cell SET body = ? WHERE map = ?", b"x", row.number)
    damage(store, "UPDATE diff SET body = ? WHERE commit_number = (SELECT max(number) FROM commits)", b"x")
    answer = live.http.get(f"/maps/{row.name}/main/cells/{cell_of_key(next(iter(commit.cells)))}.npz")
    assert (answer.status_code, answer.json()["kind"]) == (500, "damaged_store")


def test_a_map_that_cannot_be_folded_holds_up_no_other_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken: list[str] = ["map0"]

    def fold(store: SqliteStore, row: MapRow, cache: CellCache, *rest: object, limit: int, order: object) -> int:
        if row.name in broken:
            raise MemoryError
        return fold_pending(store, row, cache, limit=limit)

    monkeypatch.setattr(group_folding, "fold_around", fold)
    monkeypatch.setattr(fold_thread, "RETRY_S", 0.01)
    with Live(tmp_path) as live:
        first, second = live.new_map(), live.new_map()
        for row in (first, second):
            live.push(row, pushed(0, 1, MOLE))
        live.folded(second)
        assert live.pending(first) == 1
        broken.clear()
        until(lambda: live.pending(first) == 0, "the failed map is tried again")
