"""Turns of robots in folding: one robot's costly commits hold up another's by one of them, and no longer."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from tests.fixtures.map.costly import air
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed
from tests.fixtures.server.store_contract import NAMES, new_of
from tests.memory_store.store import MemoryStore

from cairn_map.commits.ids import Author, CommitId
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.fold_turns import GROUP_S, FoldTurns
from cairn_server.folding.folding import fold_pending
from cairn_server.store.store_rows import StoredCommit

WIDE = SMALL.model_copy(update={"depth": 5})


class Clock:
    """Steady time that passes only by what folding takes."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def waiting(author: Author, count: int, *, first: int) -> list[StoredCommit]:
    return [
        StoredCommit(number=first + n, id=CommitId(author, n), sha=b"", text=b"", retracts=(), diff={})
        for n in range(count)
    ]


def fold(
    turns: FoldTurns, clock: Clock, commits: Sequence[StoredCommit], *, costs_s: dict[str, float]
) -> list[StoredCommit]:
    """Commits that one group folds."""
    taken, start_s = [], clock.now_s
    for commit in turns.in_turn(commits):
        taken.append(commit)
        clock.now_s += costs_s[commit.id.author.robot]
    turns.end_group(clock.now_s - start_s)
    return taken


def test_costly_commits_hold_up_another_robot_s_by_one_of_them() -> None:
    clock = Clock()
    turns, costs_s = FoldTurns(steady_s=clock), {"mole": 1.0, "wren": 0.001}
    left = waiting(MOLE, 30, first=0)
    done = fold(turns, clock, left, costs_s=costs_s)
    assert len(done) == 1
    left = [commit for commit in left if commit not in done] + waiting(WREN, 50, first=30)
    done = fold(turns, clock, left, costs_s=costs_s)
    assert [commit.id.author for commit in done] == [WREN] * 50 + [MOLE]


def test_cheap_commits_stay_in_one_group_and_in_order_of_arrival() -> None:
    clock = Clock()
    turns, costs_s = FoldTurns(steady_s=clock), {"mole": GROUP_S / 400, "wren": GROUP_S / 400}
    mine, other = waiting(MOLE, 100, first=0), waiting(WREN, 100, first=100)
    done = fold(turns, clock, [*mine, *other], costs_s=costs_s)
    assert [commit for commit in done if commit.id.author == MOLE] == mine
    assert [commit for commit in done if commit.id.author == WREN] == other


def test_robots_share_the_time_and_what_took_long_is_forgotten() -> None:
    clock = Clock()
    turns, costs_s = FoldTurns(steady_s=clock), {"mole": 0.2, "wren": 0.01}
    left = waiting(MOLE, 500, first=0) + waiting(WREN, 500, first=500)
    spent_s = {"mole": 0.0, "wren": 0.0}
    for _ in range(8):
        done = fold(turns, clock, left, costs_s=costs_s)
        left = [commit for commit in left if commit not in done]
        for commit in done:
            spent_s[commit.id.author.robot] += costs_s[commit.id.author.robot]
    assert abs(spent_s["mole"] - spent_s["wren"]) <= 0.2 + 1e-6
    clock.now_s += 3600
    assert turns.spent_s("mole") < 1e-6


def test_what_encoding_took_counts_for_those_whose_commits_were_folded() -> None:
    clock = Clock()
    turns = FoldTurns(steady_s=clock)
    for _ in turns.in_turn(waiting(MOLE, 1, first=0)):
        clock.now_s += 0.1
    clock.now_s += 0.9  # encoding
    turns.end_group(1.0)
    assert turns.spent_s("mole") == pytest.approx(1.0, rel=0.02)


def test_no_cell_stays_in_the_cache_that_takes_far_more_than_its_bytes() -> None:
    store, cache = MemoryStore(), CellCache(WIDE)
    row, _ = store.create_map(next(NAMES), WIDE, SensorModel())
    costly = pushed(0, 0, geometry=WIDE, cells={KEYS[0]: air(WIDE)}, scans=9)
    honest = pushed(1, 0, geometry=WIDE, cells={KEYS[1]: random_evidence(1, WIDE, voxels=9000)}, scans=9)
    for commit in (costly, honest):
        store.append(row, new_of(commit))
    assert fold_pending(store, row, cache, limit=9) == 2
    assert list(cache._cells) == [KEYS[1]]
    again = pushed(2, 0, geometry=WIDE, cells={KEYS[0]: air(WIDE)}, scans=9)
    store.append(row, new_of(again))
    assert fold_pending(store, row, cache, limit=9) == 1
    with store.snapshot(row) as snapshot:
        stored = snapshot.cell(KEYS[0])
        assert stored is not None and stored.voxels == 8**WIDE.depth


def test_a_commit_that_takes_far_more_than_its_bytes_ends_its_group() -> None:
    clock = Clock()
    turns = FoldTurns(steady_s=clock)
    bodies = {KEYS[0]: bytes(500_000)}
    large = [replace(commit, diff=bodies) for commit in waiting(MOLE, 3, first=0)]
    assert len(fold(turns, clock, large, costs_s={"mole": 0.3})) == 3
    assert len(fold(turns, clock, waiting(WREN, 3, first=0), costs_s={"wren": 0.3})) == 1
