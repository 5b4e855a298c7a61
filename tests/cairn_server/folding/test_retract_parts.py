"""Retracts of many commits are folded part by part: the map is the same, and what comes meanwhile does not wait."""

import random
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.fixtures.map.costly import air, dust
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.folding import FAR, HERE, THERE, WIDE, Folder, cells_of, costly, scan, small_slices, straight
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.store_contract import NAMES, new_of
from tests.memory_store.store import MemoryStore

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.grid import cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.messages import LogEntry
from cairn_server.folding import commit_work, fold_lanes
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.commit_work import part_of
from cairn_server.folding.folding import fold_commits, fold_pending
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, StoredCommit

ANY_SIZE = 1 << 30
KEYS = [cell_key((n, 0, 0)) for n in range(5)]

__all__ = ["small_slices"]


@pytest.fixture(params=["memory", "disk"], scope="module")
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    if request.param == "memory":
        yield MemoryStore()
        return
    kept = SqliteStore(tmp_path_factory.mktemp("store"))
    yield kept
    kept.close()


@pytest.fixture
def single_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part is one name."""
    monkeypatch.setattr(commit_work, "PART_NAMES_MAX", 1)


def out(n: int, retracts: Sequence[Commit]) -> Commit:
    return pushed(n, 0, MOLE, geometry=WIDE, cells={}, scans=9, retracts=retracts)


def log_of(store: Store, row: MapRow) -> list[LogEntry]:
    with store.snapshot(row) as snapshot:
        return snapshot.log(after_seq=0, limit=1000)


def waiting(store: Store, row: MapRow) -> list[StoredCommit]:
    return store.pending(row, limit=99, size_bytes_max=ANY_SIZE)


MADE = [pushed(n, n) for n in range(5)]
RETRACTING = [
    pushed(5, 3, retracts=MADE[:3]),
    pushed(6, 0, cells={}, retracts=[*MADE[4:], *MADE[:4]]),
    pushed(0, 0, WREN, cells={}, retracts=[MADE[1], MADE[3]]),
]


@settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=[
        HealthCheck.too_slow,
        HealthCheck.differing_executors,
        HealthCheck.function_scoped_fixture,
    ],
)
@given(
    steps=st.lists(st.sampled_from([*MADE, *RETRACTING, 1, 2, "forget"]), max_size=16),
    names_max=st.integers(1, 3),
)
def test_in_parts_or_at_once_whatever_comes_in_between_the_cells_are_the_same(
    store: Store, steps: list[Commit | int | str], names_max: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commit_work, "PART_NAMES_MAX", names_max)
        row, _ = store.create_map(next(NAMES), SMALL, SensorModel())
        cache, arrived = CellCache(SMALL), dict[CommitId, Commit]()
        for step in [*steps, *MADE, *RETRACTING, 64]:
            if isinstance(step, int):
                fold_pending(store, row, cache, limit=step)
            elif isinstance(step, Commit):
                store.append(row, new_of(step))
                arrived[step.id] = step
            elif len(arrived) == len(MADE) + len(RETRACTING):
                # No later commit names what is forgotten now; one whose retract is under way may.
                store.forget_evidence(row, before_s=float("inf"), limit=99)
        while fold_pending(store, row, cache, limit=64):
            pass
    assert not waiting(store, row)
    with store.snapshot(row) as snapshot:
        found = {cell.key: snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels}
    assert read({key: cell.body for key, cell in found.items() if cell}) == sum_of(arrived.values())
    taken_out = [entry.id for entry in log_of(store, row) if entry.kind == "-"]
    assert sorted(taken_out) == sorted({*taken_out}) == sorted(str(commit.id) for commit in MADE)
    assert not [line for line in store.audit_log.page(after=0, limit=99) if line.what == "retract_failed"]


@pytest.mark.usefixtures("single_names")
def test_a_retract_under_way_goes_on_after_a_start_and_from_a_backup_of_that_moment(tmp_path: Path) -> None:
    folder = tmp_path / "store"
    folder.mkdir()
    store = SqliteStore(folder)
    row, _ = store.create_map("lab", SMALL, SensorModel())
    for commit in [*MADE, RETRACTING[1]]:
        store.append(row, new_of(commit))
    fold_pending(store, row, CellCache(SMALL), limit=64)
    assert store.health.backlogs()[0].commits == 1
    assert not store.forget_evidence(row, before_s=float("inf"), limit=99), "what is still to be taken out is kept"
    store.close()
    store = SqliteStore(folder)
    [rest] = waiting(store, row)
    assert (rest.id, rest.due_from) == (RETRACTING[1].id, 1)
    while fold_pending(store, row, CellCache(SMALL), limit=64):
        pass
    assert [entry.kind for entry in log_of(store, row)] == ["+"] * 6 + ["-"] * 5
    assert store.health.backlogs() == []
    store.close()


def test_a_part_is_what_one_commit_may_have_or_one_commit_of_any_size(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, _ = store.create_map(next(NAMES), WIDE, SensorModel())
    sizes = [2, 1, 1, 5, 1]
    commits = [costly(n, dust(WIDE), keys=KEYS[:count]) for n, count in enumerate(sizes)]
    gone, unknown = costly(7, air(WIDE)), costly(8, air(WIDE))
    for commit in [*commits, gone, pushed(6, 0, geometry=WIDE, cells={}, retracts=[gone])]:
        store.append(row, new_of(commit))
    while fold_pending(store, row, CellCache(WIDE), limit=64):
        pass
    store.append(row, new_of(out(9, [*commits[:2], gone, *commits[2:], unknown])))
    [commit] = waiting(store, row)
    bricks = 8 ** (WIDE.depth - 3)
    for bound, most in (("PART_CELLS_MAX", 3), ("PART_BRICKS_MAX", 3 * bricks)):
        with monkeypatch.context() as patch:
            patch.setattr(commit_work, bound, most)
            parts = []
            while commit.due_from is None or parts[-1].due_from is not None:
                with store.snapshot(row) as snapshot:
                    parts.append(part_of(commit, snapshot))
                commit = StoredCommit(
                    number=commit.number,
                    id=commit.id,
                    sha=b"",
                    text=b"",
                    retracts=commit.retracts,
                    diff={},
                    due_from=parts[-1].due_from or len(commit.retracts),
                )
            assert [[target.n for target in part.targets] for part in parts] == [[0, 1], [2], [3], [4]]
            assert [len(part.cells) for part in parts] == [2, 1, 5, 1]
            [commit] = waiting(store, row)


@pytest.mark.usefixtures("small_slices", "single_names")
def test_a_commit_in_a_cell_of_a_retract_waits_for_one_part_of_it(store: Store) -> None:
    commits = [costly(n, [dust(WIDE), air(WIDE)][n % 2]) for n in range(6)]
    folder = Folder(store, commits)
    folder.finish()
    retract = out(9, commits)
    folder.push([retract])
    assert folder.look() == 0
    folder.push([scan(0, HERE)])
    folder.look()  # the part under way; a scan in such a cell is costly, too, and is next
    folder.look()
    assert scan(0, HERE).id in folder.vector()
    assert sum(entry.kind == "-" for entry in log_of(store, folder.row)) < len(commits)
    folder.finish()
    assert cells_of(store, folder.row) == straight([*commits, scan(0, HERE), retract])


@pytest.mark.usefixtures("small_slices")
def test_the_thread_that_folds_reads_little_evidence_to_begin_and_to_write_a_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fold_lanes, "PLAN_S", 1e-4)
    store, reads = MemoryStore(), list[CommitId]()
    commits = [costly(n, [dust(WIDE), air(WIDE)][n % 2]) for n in range(9)]
    folder = Folder(store, commits)
    folder.finish()
    here, folded = threading.current_thread(), store.folded

    def counted(row: MapRow, commit: CommitId) -> StoredCommit | None:
        if threading.current_thread() is here:
            reads.append(commit)
        return folded(row, commit)

    monkeypatch.setattr(store, "folded", counted)
    folder.push([out(9, commits)])
    while waiting(store, folder.row):
        reads.clear()
        folder.look()
        assert len(reads) <= 2, "its work is estimated once for a lane, once for a plan"
    assert sum(entry.kind == "-" for entry in log_of(store, folder.row)) == len(commits)


@pytest.mark.usefixtures("small_slices")
def test_what_a_plan_notes_to_be_taken_out_comes_in_after_it(store: Store) -> None:
    """Else the plan would stand on a commit that was unknown when it began, and be made again with each that comes."""
    first, late = costly(0, air(WIDE)), pushed(0, 0, WREN, geometry=WIDE, cells={THERE: random_evidence(1, WIDE)})
    folder = Folder(store, [first])
    folder.finish()
    retract = out(1, [first, late])
    folder.push([retract])
    assert folder.look() == 0
    folder.push([late, pushed(1, 0, WREN, geometry=WIDE, cells={}, retracts=[late]), scan(2, FAR)])
    assert folder.look() > 0
    assert retract.id in folder.vector(), "the plan that was under way is written"
    folder.finish()
    assert cells_of(store, folder.row) == straight([first, retract, late, scan(2, FAR)])


@pytest.mark.usefixtures("small_slices")
def test_no_commit_waits_for_ever_because_its_plans_do_not_fit(store: Store) -> None:
    folder, others = Folder(store, [costly(0, air(WIDE))]), list[Commit]()
    while costly(0, air(WIDE)).id not in folder.vector():
        assert len(others) < 9, "its plan is thrown away again and again"
        folder.look()
        folder.folding.close()
        others.append(scan(len(others), HERE))
        folder.push(others[-1:])
        fold_commits(store, folder.row, CellCache(WIDE), folder.waiting_of(WREN))  # by another folding
    folder.finish()
    assert cells_of(store, folder.row) == straight([costly(0, air(WIDE)), *others])


@pytest.mark.usefixtures("small_slices", "single_names")
@pytest.mark.parametrize("seed", range(4))
def test_retracts_of_each_other_s_commits_in_parts_end_with_the_sum_of_what_is_left(store: Store, seed: int) -> None:
    chance = random.Random(seed)
    folder, commits = Folder(store, []), list[Commit]()
    for n in range(14):
        evidence = chance.choice([air(WIDE), dust(WIDE), random_evidence(n, WIDE, voxels=5, air=0)])
        own = [commit for commit in commits if commit.id.author == MOLE and commit.cells]
        many = chance.sample(own, min(len(own), chance.randrange(5)))
        commits.append(costly(n, evidence, keys=[chance.choice([HERE, FAR])], retracts=many))
        both = chance.sample(own, min(len(own), 3))
        commits.append(scan(n, chance.choice([HERE, THERE])) if n % 3 else by_wren(n, both))
        folder.push(chance.sample(commits[-2:], 2))
        chance.choice([folder.look, lambda: folder.folding.fold(folder.row).commits])()
    folder.finish()
    assert cells_of(store, folder.row) == straight(commits)


def by_wren(n: int, retracts: Sequence[Commit]) -> Commit:
    """A retract by another author, as a server's operators make them."""
    return pushed(n, 0, WREN, geometry=WIDE, cells={}, scans=9, retracts=retracts)
