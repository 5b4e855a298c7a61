"""Lanes of folding: what a robot's costly commits take is no other robot's to wait for, and the map is the same."""

import random
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from tests.fixtures.map.bombs import DEEP, cell_of_air
from tests.fixtures.map.costly import air, dust
from tests.fixtures.map.made import random_evidence
from tests.fixtures.server.folding import FAR, HERE, THERE, WIDE, Folder, cells_of, costly, scan, small_slices, straight
from tests.fixtures.server.pushes import MOLE, WREN, pushed
from tests.fixtures.server.store_contract import NAMES, new_of
from tests.memory_store.store import MemoryStore

from cairn_map.codec.cell_code import DecodedCell, encode_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding import commit_work, fold_lanes, folding, group_folding
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.commit_work import SLICE_S, commit_work_s, decoding_of
from cairn_server.folding.fold_turns import FoldTurns
from cairn_server.folding.folding import fold_commits
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.stamps import decode_stamps
from cairn_server.store.store import Store
from cairn_server.store.store_rows import Fold, MapRow, StoredCommit

__all__ = ["small_slices"]


@pytest.fixture(params=["memory", "disk"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    if request.param == "memory":
        yield MemoryStore()
        return
    kept = SqliteStore(tmp_path)
    yield kept
    kept.close()


def test_dust_air_and_very_many_cells_are_known_to_be_costly_before_they_are_decoded_and_scans_are_not() -> None:
    store = MemoryStore()
    row, _ = store.create_map(next(NAMES), DEEP, SensorModel())
    grain = encode_cell(HERE, dust(DEEP), DEEP).data
    random_grain = encode_cell(HERE, random_evidence(1, DEEP, voxels=1, air=0), DEEP).data
    diffs = [
        {cell_key((n, 0, 0)): grain for n in range(4)},
        {HERE: cell_of_air((0, 0, 0))},
        {cell_key((n, 0, 0)): random_grain for n in range(1000)},
        {HERE: encode_cell(HERE, random_evidence(1, DEEP, voxels=9000), DEEP).data},
    ]
    with store.snapshot(row) as snapshot:
        works_s = [
            commit_work_s(
                StoredCommit(number=n, id=CommitId(MOLE, n), sha=b"", text=b"", retracts=(), diff=diff),
                decoding_of(snapshot, ()),
            )
            for n, diff in enumerate(diffs)
        ]
    assert [work_s > SLICE_S for work_s in works_s] == [True, True, True, False]


@pytest.mark.parametrize("evidence", [dust(WIDE), air(WIDE), random_evidence(7, WIDE, voxels=99)])
def test_work_estimated_by_a_head_alone_is_not_less_than_by_the_masks(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = encode_cell(HERE, evidence, WIDE).data
    exact_s = commit_work._diff_work_s(body)
    monkeypatch.setattr(commit_work, "SLICE_S_PER_BYTE", 1.0)
    assert commit_work._diff_work_s(body) >= exact_s > 0


@pytest.mark.usefixtures("small_slices")
def test_a_commit_never_waits_for_another_robot_s_costly_ones(store: Store) -> None:
    """Thirty costly commits wait: each scan pushed now is in the map after one look, whatever is under way."""
    attack = [costly(n, [dust(WIDE), air(WIDE)][n % 2], keys=[HERE, FAR]) for n in range(30)]
    folder = Folder(store, attack)
    assert folder.folding.fold(folder.row).commits == 0
    for n in range(4):
        folder.push([scan(n)])
        # The plan may be done or not: it is the scan that counts.
        folder.folding.fold(folder.row)
        assert scan(n).id in folder.vector()
    folder.finish()
    assert cells_of(store, folder.row) == straight([*attack, *map(scan, range(4))])


@pytest.mark.usefixtures("small_slices")
@pytest.mark.parametrize("seed", range(3))
def test_whatever_a_robot_pushes_others_wait_for_no_more_than_a_slice_of_work(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work is counted, not timed: what the thread that folds scans decodes of another robot's commits in one look."""
    monkeypatch.setattr(commit_work, "CELL_S", 1e-5)
    worked_s: list[float] = []
    decode, here = folding._decoded, threading.current_thread()

    def counted(commit: StoredCommit, key: CellKey, body: bytes) -> DecodedCell:
        if commit.id.author == MOLE and threading.current_thread() is here:
            worked_s.append(commit_work.CELL_S + commit_work._diff_work_s(body))
        return decode(commit, key, body)

    monkeypatch.setattr(folding, "_decoded", counted)
    monkeypatch.setattr(group_folding, "FoldTurns", partial(FoldTurns, steady_s=lambda: 0.0))
    folder, commits = Folder(MemoryStore(), []), list[Commit]()
    chance = random.Random(seed)
    for n in range(24):
        commits += [mixed(n, commits, chance), scan(n)]
        folder.push(commits[-2:])
        worked_s.clear()
        folder.folding.fold(folder.row)
        assert commits[-1].id in folder.vector()
        assert sum(worked_s) <= 2 * commit_work.SLICE_S
    folder.finish()
    assert cells_of(folder.store, folder.row) == straight(commits)


def mixed(n: int, before: Sequence[Commit], chance: random.Random) -> Commit:
    """One of the commits that take the most work for their bytes, or a retract of some of them, or a small one."""
    many = sorted(cell_key((k, 1, 0)) for k in range(30))
    kinds = [(air(WIDE), [HERE]), (dust(WIDE), [HERE, FAR]), (random_evidence(n, WIDE, voxels=1, air=0), many)]
    kinds += [(random_evidence(n, WIDE, voxels=5, air=0), [FAR])]
    own = [commit for commit in before if commit.id.author == MOLE and commit.cells]
    if own and chance.random() < 0.3:
        return pushed(n, 0, MOLE, geometry=WIDE, cells={}, scans=9, retracts=chance.sample(own, min(len(own), 3)))
    evidence, keys = chance.choice(kinds)
    return costly(n, evidence, keys=keys)


@pytest.mark.usefixtures("small_slices")
def test_a_costly_commit_waits_for_one_plan_of_a_robot_of_which_thirty_wait(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fold_lanes, "PLAN_S", 1e-4)  # one commit each
    folder = Folder(store, [costly(n, [dust(WIDE), air(WIDE)][n % 2]) for n in range(30)])
    assert folder.look() == 0
    sweep = pushed(0, 0, WREN, geometry=WIDE, cells={THERE: air(WIDE)}, scans=9)
    folder.push([sweep])
    assert folder.look() == 1  # the plan that was under way
    assert folder.look() == 1
    assert sweep.id in folder.vector()
    folder.folding.close()


@pytest.mark.usefixtures("small_slices")
def test_who_changes_a_cell_of_a_plan_waits_for_that_plan_and_no_longer(store: Store) -> None:
    first, here, there = costly(0, air(WIDE)), scan(1, HERE), scan(0, THERE)
    folder = Folder(store, [first])
    assert folder.look() == 0
    folder.push([there, here])
    folder.folding.fold(folder.row)
    assert there.id in folder.vector()
    assert here.id not in folder.vector() or first.id in folder.vector()
    assert folder.look() >= 0
    assert first.id in folder.vector()
    folder.finish()
    assert cells_of(store, folder.row) == straight([first, here, there])


@pytest.mark.usefixtures("small_slices")
def test_a_plan_is_written_behind_what_came_meanwhile_with_the_stamps_of_its_own_entry(store: Store) -> None:
    folder = Folder(store, [costly(0, dust(WIDE))])
    assert folder.look() == 0  # its plan begins at the empty map
    folder.push([scan(0), scan(1)])
    assert fold_commits(store, folder.row, CellCache(WIDE), folder.waiting_of(WREN)).folded == 2
    assert folder.look() == 1
    with store.snapshot(folder.row) as snapshot:
        cell = snapshot.cell(HERE)
        assert cell is not None and cell.lm == snapshot.head.seq == 3
        assert set(decode_stamps(cell.stamps, depth=WIDE.depth, lm=3).tolist()) == {0, 3}


@pytest.mark.usefixtures("small_slices")
def test_a_plan_whose_cells_changed_is_thrown_away_and_made_again(store: Store) -> None:
    folder = Folder(store, [costly(0, air(WIDE))])
    assert folder.look() == 0
    folder.folding.close()
    folder.push([scan(0, HERE)])
    assert fold_commits(store, folder.row, CellCache(WIDE), folder.waiting_of(WREN)).folded == 1  # by another folding
    assert folder.look() == 0
    folder.finish()
    assert cells_of(store, folder.row) == straight([costly(0, air(WIDE)), scan(0, HERE)])


@pytest.mark.usefixtures("small_slices")
def test_retracts_of_costly_commits_are_planned_too(store: Store) -> None:
    first, second = costly(0, air(WIDE)), costly(1, dust(WIDE), keys=[FAR])
    folder = Folder(store, [first, second])
    folder.finish()
    out = pushed(2, 0, MOLE, geometry=WIDE, cells={}, scans=9, retracts=[first, second])
    folder.push([out, scan(0)])
    assert folder.folding.fold(folder.row).commits == 1
    folder.finish()
    assert cells_of(store, folder.row) == straight([first, second, out, scan(0)])


@pytest.mark.usefixtures("small_slices")
def test_a_costly_commit_that_is_damaged_is_set_aside_as_any_other(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path)
    folder = Folder(store, [costly(0, air(WIDE)), costly(1, air(WIDE))])
    store._writer.run(lambda connection: connection.execute("UPDATE commits SET sha = zeroblob(32) WHERE n = 0"))
    folder.finish()
    assert cells_of(store, folder.row) == straight([costly(1, air(WIDE))])
    assert [line.what for line in store.audit_log.page(after=0, limit=9)].count("damaged_commit") == 1
    store.close()


def test_what_another_folding_wrote_first_is_not_audited_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fold that is refused says nothing of the commits that it would have set aside."""
    store = MemoryStore()
    row, _ = store.create_map(next(NAMES), WIDE, SensorModel())
    store.append(row, new_of(scan(0)))
    lines: list[str] = []
    monkeypatch.setattr(store, "audit", lambda what, detail: lines.append(what))
    write = store.fold

    def refused(row: MapRow, fold: Fold) -> bool:
        assert fold.damaged
        return False

    (bad,) = store.pending(row, limit=9, size_bytes_max=1 << 26)
    bad = replace(bad, sha=bytes(32))
    monkeypatch.setattr(store, "fold", refused)
    assert fold_commits(store, row, CellCache(WIDE), [bad]).folded == 0
    assert not lines
    monkeypatch.setattr(store, "fold", write)
    assert fold_commits(store, row, CellCache(WIDE), [bad]).folded == 1
    assert lines == ["damaged_commit"]
