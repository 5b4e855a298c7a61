"""Two lanes of folding: cheap commits at once, costly ones planned in the background, one plan at a time.

A commit waits for at most one slice of other robots' work (`commit_work.SLICE_S`), unless it touches a cell that a plan
under way changes, or is named by it: then for that plan. A retract is planned part by part (`commit_work`), and in
between others have their turn. Each robot's own commits keep their order, so those behind a costly one wait for it.
Which robot's costly commits are next is decided as in `fold_turns`, by the time that each robot's took.
"""

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from cairn_map.commits.ids import CommitId, RobotName
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import CellKey
from cairn_server.folding.background_plan import BackgroundPlan
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.commit_work import (
    NAME_S,
    SLICE_S,
    SLICE_S_PER_BYTE,
    commit_work_s,
    decoding_of,
    part_of,
    slice_s,
)
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_turns import FoldTurns
from cairn_server.folding.folding import FoldStore
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import MapRow, StoredCommit

log = logging.getLogger(__name__)

PLAN_S = 1.0
"""Work of a robot's commits that are planned at once, if the first of them does not have more."""

Piece = tuple[int, int | None]
"""Number of a commit, and the part of its retract that is next (`StoredCommit.due_from`)."""


class _Weight(NamedTuple):
    """Estimated work of a commit with what it retracts, and their bytes."""

    work_s: float
    size_bytes: int


class PlanOutcome(NamedTuple):
    """Result of a plan."""

    folded: int = 0
    """Count of its commits that are folded."""
    left: tuple[StoredCommit, ...] = ()
    """Those that wait for bytes in an object store, which does not answer."""


class _Weighing(NamedTuple):
    """A state of a map, on which commits are weighed."""

    snapshot: Snapshot
    decoding_s: Callable[[CellKey], float]
    """`commit_work.decoding_of`."""


class FoldLanes:
    """The lanes of all maps of a store; one thread at a time."""

    def __init__(self, store: FoldStore, memory: FoldMemory, *, cells_bytes: int) -> None:
        """Plan with this memory, of which the cells under change have so much."""
        self._store = store
        self._memory = memory
        self._cells_bytes = cells_bytes
        self._plan: BackgroundPlan | None = None
        self._costly: dict[RobotName, list[StoredCommit]] = {}
        """Commits of each robot that wait for the background, of the map under way: the first is costly."""
        self._known_costly: set[int] = set()
        """Numbers of commits that were found to be costly, and wait."""
        self._misfits: set[Piece] = set()
        """Pieces of work of which a plan was thrown away."""
        self._unplanned: set[Piece] = set()
        """Pieces of work of which planning failed, or twice did not fit."""

    def has_plan(self) -> bool:
        """True if a plan is under way, or done and not written yet."""
        return self._plan is not None

    def is_planning(self) -> bool:
        """True while a plan is under way."""
        return self._plan is not None and not self._plan.is_done()

    def close(self) -> None:
        """Wait for the plan under way, which is not written."""
        if self._plan is not None:
            self._plan.join()

    def write_plan(self, row: MapRow, cache: CellCache, turns: FoldTurns) -> PlanOutcome:
        """Write the plan of this map if it is done."""
        plan, self._costly = self._plan, {}
        if plan is None or plan.row.number != row.number or not plan.is_done():
            return PlanOutcome()
        self._plan = None
        turns.charge(plan.commits[0].id.author.robot, plan.seconds)
        if plan.is_away():
            return PlanOutcome(left=plan.commits)
        if plan.is_failed():
            self._set_aside(plan.commits)
            return PlanOutcome()
        fold = plan.write()
        if fold is None:
            log.info("map %s: a plan of %d commits does not fit any more", row.name, len(plan.commits))
            # After the second time it is folded without a plan, so that no commit waits for ever.
            pieces = set(map(_piece, plan.commits))
            if pieces & self._misfits:
                self._set_aside(plan.commits)
            self._misfits |= pieces
            return PlanOutcome()
        cache.moved(fold.base, fold.head, plan.cells)
        self._known_costly.difference_update(commit.number for commit in plan.commits)
        return PlanOutcome(len(plan.commits))

    def cheap(
        self, row: MapRow, commits: Sequence[StoredCommit], cache: CellCache, snapshot: Snapshot
    ) -> list[StoredCommit]:
        """Those of a map's pending commits that may be folded now; the costly ones are remembered for `plan_next`."""
        # They are weighed here, and folded on the same state.
        snapshot.hold_cells([key for commit in commits for key in commit.diff if key not in cache])
        weighing = _Weighing(snapshot, decoding_of(snapshot, cache))
        self._costly = {}
        found: list[StoredCommit] = []
        behind: set[RobotName] = set()
        dear_s = 0.0
        plan = self._plan if self._plan is not None and self._plan.row.number == row.number else None
        held = plan.cells if plan is not None else frozenset[CellKey]()
        named = plan.named if plan is not None else frozenset[CommitId]()
        planned = {commit.number for commit in plan.commits} if plan is not None else set[int]()
        for commit in commits:
            robot = commit.id.author.robot
            if robot in self._costly:
                self._costly[robot].append(commit)
            if robot in behind:
                continue
            if commit.number in planned:
                behind.add(robot)
                continue
            if commit.number in self._known_costly:
                self._costly[robot] = [commit]
                behind.add(robot)
                continue
            # The plan's ground: neither what it takes out, nor what it notes to be taken out, may change.
            is_held = commit.id in named or not named.isdisjoint(commit.retracts)
            weight = None if is_held else self._weight(row, commit, weighing, held)
            if weight is None:
                behind.add(robot)
                continue
            if weight.work_s > slice_s(weight.size_bytes) and _piece(commit) not in self._unplanned:
                self._known_costly.add(commit.number)
                self._costly[robot] = [commit]
                behind.add(robot)
                continue
            # Many that are nearly costly end the group as one that is.
            dear_s += weight.work_s if weight.work_s > SLICE_S_PER_BYTE * weight.size_bytes else 0.0
            if dear_s > SLICE_S and found:
                behind.add(robot)
            else:
                found.append(commit)
        return found

    def plan_next(self, row: MapRow, turns: FoldTurns) -> None:
        """Begin to plan the costly commits of the robot whose turn it is, unless a plan is under way."""
        if self._plan is not None or not self._costly:
            return
        robot = min(self._costly, key=lambda robot: (turns.spent_s(robot), self._costly[robot][0].number))
        chosen: list[StoredCommit] = []
        work_s = 0.0
        with self._store.snapshot(row) as snapshot:
            weighing = _Weighing(snapshot, decoding_of(snapshot, cached=()))
            for commit in self._costly[robot]:
                weight = self._weight(row, commit, weighing, held=())
                work_s += weight.work_s if weight is not None else 0.0
                if chosen and work_s > PLAN_S:
                    break
                chosen.append(commit)
        try:
            self._plan = BackgroundPlan(self._store, row, chosen, self._memory, cells_bytes=self._cells_bytes)
        except DamagedDataError:
            self._set_aside(chosen)

    def _set_aside(self, commits: Sequence[StoredCommit]) -> None:
        """Have these commits folded without a plan."""
        self._unplanned.update(map(_piece, commits))
        self._known_costly.difference_update(commit.number for commit in commits)

    def _weight(
        self, row: MapRow, commit: StoredCommit, weighing: _Weighing, held: Collection[CellKey]
    ) -> _Weight | None:
        """Weight of a commit, from `PLAN_S` on not all of it; None if it changes one of the `held` cells."""
        own = commit if commit.due_from is None else replace(commit, diff={})
        size_bytes = sum(map(len, own.diff.values()))
        try:
            part = part_of(commit, weighing.snapshot)
            if not (part.cells.isdisjoint(held) and own.diff.keys().isdisjoint(held)):
                return None
            work_s = NAME_S * len(part.named) + commit_work_s(own, weighing.decoding_s)
            # What is taken out is read one by one, and not all of it if it is much.
            for target in part.targets:
                if work_s > PLAN_S:
                    break
                known = self._store.folded(row, target)
                if known is not None:
                    size_bytes += sum(map(len, known.diff.values()))
                    work_s += commit_work_s(known, weighing.decoding_s)
        except (DamagedDataError, AwayError):
            return _Weight(0.0, size_bytes)  # a cell that cannot be read: folding finds it
        return _Weight(work_s, size_bytes)


def _piece(commit: StoredCommit) -> Piece:
    return commit.number, commit.due_from
