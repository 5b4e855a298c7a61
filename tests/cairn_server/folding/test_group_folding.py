"""While a cell is damaged for good, what does not touch it is folded; healed, all is as if nothing had happened."""

import random
from collections.abc import Sequence
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.answers import cell_path
from tests.fixtures.server.commit_contract import bodies
from tests.fixtures.server.damage import BROKEN, damage
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import new_of
from tests.memory_store.store import MemoryStore

from cairn_map.commits.commit import Commit
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding import commit_work
from cairn_server.folding import group_folding as module
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.damaged_cells import DamagedCells
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.group_folding import PLAN_SHARE, LocalFolding, Waiting, fold_around
from cairn_server.store.history import head_of
from cairn_server.store.store_rows import MapRow

FIRST, SECOND = pushed(0, 0), pushed(0, 0, WREN)
"""In the damaged cell, and in another."""
BASE = [FIRST, SECOND]


def broken_map(live: Live) -> tuple[MapRow, bytes]:
    """A map of these, its cell damaged, and of the first one what it says of that cell, too; and the cell as it was."""
    row = live.new_map()
    for commit in BASE:
        live.push(row, commit)
    whole = live.cells(row)[BROKEN]
    damage(live, "UPDATE cell SET body = x'00' WHERE map = ? AND cell = ?", row.number, BROKEN)
    damage(
        live,
        "UPDATE diff SET body = NULL WHERE cell = ? AND commit_number ="
        " (SELECT number FROM commits WHERE map = ? AND robot = 'mole' AND n = 0)",
        BROKEN,
        row.number,
    )
    live.service._fold_thread._local._caches.clear()  # the folder still knows the cell, and would write it again
    return row, whole


def touches(commit: Commit) -> bool:
    return BROKEN in commit.cells


def ids_pending(live: Live, row: MapRow) -> set[str]:
    with live.service.store.snapshot(row) as snapshot:
        return {str(commit) for commit in snapshot.pending()}


def heal(live: Live, row: MapRow, whole: bytes) -> None:
    assert live.http.put(cell_path(row, BROKEN), content=whole).status_code == 204
    live.folded(row)


def cells_of_a_sound_map(live: Live, commits: Sequence[Commit]) -> dict[int, bytes]:
    row = live.new_map()
    for commit in commits:
        live.push(row, commit)
    return live.cells(row)


def test_commits_elsewhere_are_folded_and_those_in_the_damaged_cell_wait_until_it_is_healed(live: Live) -> None:
    row, whole = broken_map(live)
    commits = [pushed(n, n) for n in range(1, 7)]
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    waiting = {str(commit.id) for commit in commits if touches(commit)}
    assert 0 < len(waiting) < len(commits)
    until(lambda: ids_pending(live, row) == waiting, "all others are folded")
    elsewhere = sum_of([*BASE, *(commit for commit in commits if not touches(commit))])
    assert read({KEYS[2]: live.http.get(cell_path(row, KEYS[2])).content}) == {KEYS[2]: elsewhere[KEYS[2]]}
    assert live.http.get(cell_path(row, BROKEN)).status_code == 500
    assert live.service.readiness._folds.held_up() == {row.name}
    damage(live, "UPDATE commits SET received_age_s = -1e9 WHERE folded_seq IS NULL")
    assert live.http.get("/readyz").status_code == 200  # however long they wait
    heal(live, row, whole)
    assert live.cells(row) == cells_of_a_sound_map(live, [*BASE, *commits])
    until(lambda: live.service.readiness._folds.held_up() == frozenset(), "the map is well")


def test_a_retract_of_what_is_in_the_damaged_cell_waits_and_one_of_what_waits_does_not(live: Live) -> None:
    row, whole = broken_map(live)
    waits, elsewhere = pushed(1, 2), pushed(2, 1)
    live.push(row, waits)
    live.push(row, elsewhere)
    live.retract(row, waits)
    until(lambda: ids_pending(live, row) == {str(waits.id)}, "the retract is folded")
    live.retract(row, SECOND)
    live.push(row, pushed(3, 1))
    until(lambda: len(ids_pending(live, row)) == 2, "the commit after it is folded")
    assert any(text.startswith("operator.") for text in ids_pending(live, row))
    heal(live, row, whole)
    assert read(live.cells(row)) == sum_of([FIRST, elsewhere, pushed(3, 1)])


def test_a_retract_under_way_waits_at_a_damaged_cell_and_goes_on_once_that_is_healed(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commit_work, "PART_NAMES_MAX", 1)
    row, whole = broken_map(live)
    before, behind = pushed(1, 1), pushed(2, 1)
    live.push(row, before)
    live.push(row, behind)
    live.folded(row)
    assert live.retract(row, before, SECOND, behind).status_code == 201
    until(lambda: taken_out(live, row) == [str(before.id)], "the first part is folded")
    live.push(row, pushed(3, 1))
    live.folded(row)
    assert taken_out(live, row) == [str(before.id)]
    heal(live, row, whole)
    until(lambda: len(taken_out(live, row)) == 3, "the retract goes on")
    assert read(live.cells(row)) == sum_of([FIRST, pushed(3, 1)])


def taken_out(live: Live, row: MapRow) -> list[str]:
    with live.service.store.snapshot(row) as snapshot:
        return [entry.id for entry in snapshot.log(after_seq=0, limit=99) if entry.kind == "-"]


@pytest.mark.parametrize("seed", range(4))
def test_any_history_around_damage_ends_as_without_it(live: Live, seed: int) -> None:
    rng = random.Random(seed)
    (row, whole), commits = broken_map(live), list(BASE)
    for n in range(1, 12):
        targets = rng.sample(commits[1:], min(2, len(commits) - 1)) if rng.random() < 0.4 else []
        targets = [commit for commit in targets if not commit.meta.retracts]
        if targets and rng.random() < 0.5:
            commits.append(pushed(n, rng.randrange(9), cells={}, retracts=targets))
        else:
            commits.append(pushed(n, rng.randrange(9), retracts=targets))
    rest = commits[2:]
    rng.shuffle(rest)
    for commit in rest:
        assert live.push(row, commit).status_code == 201
    heal(live, row, whole)
    assert read(live.cells(row)) == sum_of(commits)


def test_many_that_wait_do_not_stop_those_behind_them(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        _folds_what_comes_last(live)


def _folds_what_comes_last(live: Live) -> None:
    row, _ = broken_map(live)
    live.service._fold_thread.close()
    commits = [pushed(n, 0) for n in range(1, 8)] + [pushed(8, 1)]
    for commit in commits:
        live.push(row, commit)
    waiting, cache, damaged = Waiting(), CellCache(row.geometry), DamagedCells()
    assert fold_around(live.service.store, row, cache, waiting, damaged, limit=2) == 1
    assert ids_pending(live, row) == {str(commit.id) for commit in commits[:-1]}
    assert len(waiting.commits) == 7
    assert fold_around(live.service.store, row, cache, waiting, damaged, limit=2) == 0


@pytest.mark.parametrize(("limit", "folded"), [("WAITING_OF_ROBOT_MAX", 4), ("WAITING_MAX", 4), ("GROUP_MAX", 6)])
def test_of_a_robot_of_which_many_wait_later_commits_wait_so_that_the_vector_has_few_gaps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, folded: int
) -> None:
    monkeypatch.setattr(module, limit, 2)
    with Live(tmp_path) as live:
        row, whole = broken_map(live)
        ours = [pushed(n, n % 2, MOLE) for n in range(1, 9)]  # every other one in the damaged cell
        theirs = [pushed(n, 1, WREN) for n in range(10, 12)]
        for commit in (*ours, *theirs):
            live.push(row, commit)
        until(lambda: live.pending(row) == len(ours) + len(theirs) - folded, "the others are folded")
        with live.service.store.snapshot(row) as snapshot:
            gaps = len(head_of(snapshot).vector.intervals[MOLE])
            assert {commit.id for commit in theirs} <= set(head_of(snapshot).vector)
        assert gaps == folded - len(theirs)
        heal(live, row, whole)
        assert read(live.cells(row)) == sum_of([*BASE, *ours, *theirs])


def test_a_cell_that_the_log_tells_again_is_found_out_without_a_word(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, _ = broken_map(live)
    live.push(row, pushed(1, 0))
    until(lambda: live.service.readiness._folds.held_up() == {row.name}, "the cell is found damaged")
    damage(live, "UPDATE diff SET body = ? WHERE cell = ? AND body IS NULL", FIRST.cells[BROKEN], BROKEN)
    live.push(row, pushed(2, 1))
    until(lambda: len(ids_pending(live, row)) == 1, "what is elsewhere is folded")
    monkeypatch.setattr(module, "PROBE_S", 0.0)
    live.push(row, pushed(3, 1))
    live.folded(row)
    assert read(live.cells(row)) == sum_of([*BASE, pushed(1, 0), pushed(2, 1), pushed(3, 1)])


def test_a_server_that_is_started_anew_folds_around_the_cell_again(tmp_path: Path) -> None:
    with Live(tmp_path) as live:
        row, whole = broken_map(live)
        live.push(row, pushed(1, 0))
        live.push(row, pushed(2, 1))
    with Live(tmp_path) as live:
        row = live.service.store.map(row.name)
        until(lambda: ids_pending(live, row) == {str(pushed(1, 0).id)}, "what is elsewhere is folded")
        heal(live, row, whole)
        assert read(live.cells(row)) == sum_of([*BASE, pushed(1, 0), pushed(2, 1)])


def test_maps_that_are_folded_in_turn_share_one_memory_and_keep_their_cells_in_it() -> None:
    store, memory = MemoryStore(), FoldMemory(cells_bytes=8 << 20)
    folding = LocalFolding(store, DamagedCells(), memory)
    rows = [store.create_map(f"hall{n}", SMALL, SensorModel())[0] for n in range(60)]
    for n in range(3):
        for row in rows:
            store.append(row, new_of(pushed(n, n)))
            assert folding.fold(row).commits == 1
            kept = [cache for cache in folding._caches.values() if cache.size_bytes]
            assert sum(cache.size_bytes for cache in kept) <= memory.cells_bytes
    # Small maps fit all together: none is read again for each commit, however many there are.
    assert len(kept) == len(rows)
    for row in rows:
        assert read(bodies(store, row)) == sum_of([pushed(n, n) for n in range(3)])
    # In less memory those that were folded longest ago give their cells up, and the map under work has half of it.
    folding._memory = FoldMemory(cells_bytes=4 * kept[0].size_bytes)
    for row in rows:
        store.append(row, new_of(pushed(3, 3)))
        assert folding.fold(row).commits == 1
        assert sum(cache.size_bytes for cache in folding._caches.values()) <= folding._memory.cells_bytes
    for row in rows:
        assert read(bodies(store, row)) == sum_of([pushed(n, n) for n in range(4)])
    folding.close()


def test_maps_give_up_no_cells_that_there_is_memory_for() -> None:
    """Four maps fill the memory together, and none is decoded again for each commit."""
    store = MemoryStore()
    folding = LocalFolding(store, DamagedCells())
    rows = [store.create_map(f"hall{n}", SMALL, SensorModel())[0] for n in range(5)]
    for row in rows[:4]:
        store.append(row, new_of(pushed(0, 0)))
        folding.fold(row)
    sizes = sum(cache.size_bytes for cache in folding._caches.values())
    folding._memory = FoldMemory(cells_bytes=int(1.1 * sizes / (1 - PLAN_SHARE)))
    for row in rows[:4]:
        folding.fold(row)
    assert [name for name, cache in folding._caches.items() if cache.size_bytes] == [row.name for row in rows[:4]]
    # One more than fits: the one that was folded longest ago goes.
    store.append(rows[4], new_of(pushed(0, 0)))
    folding.fold(rows[4])
    assert [name for name, cache in folding._caches.items() if cache.size_bytes] == [row.name for row in rows[1:]]
    folding.close()
