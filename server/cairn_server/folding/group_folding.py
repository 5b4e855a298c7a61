"""Folding of one group of commits, around damaged cells: what touches one waits, the other commits are folded.

A commit is one entry of the log, of all its cells or of none: chain, `lm`, coverage and later retracts know no half
commits. So it waits as a whole, and so does a retract of a commit that is in a damaged cell. That is allowed, since any
order of the same commits gives the same cells; and robots do not push a waiting commit again, since it is in `pending`.
Each commit that is passed by leaves a gap in the version vector, which every robot reads: so of a robot of which many
wait, and of a map where very many do, the later commits wait, too.
"""

import logging
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

from cairn_map.commits.ids import RobotName
from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.cells_at_rest import DamagedCellError, cell_to_change, row_of_cell
from cairn_server.folding.commit_work import part_of
from cairn_server.folding.fold_lanes import FoldLanes
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_turns import FoldTurns
from cairn_server.folding.folding import GROUP_BYTES_MAX, Damage, FoldStore, Order, as_they_came, fold_commits
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import MapRow, StoredCommit

log = logging.getLogger(__name__)

GROUP_MAX = 256
"""Most commits in a group."""
WAITING_OF_ROBOT_MAX = 64
"""Most commits of a robot that wait while later ones of it are folded."""
WAITING_MAX = 2048
"""Most commits of a map that wait while later ones of the same robots are folded: 70 kB in each reply's vector."""
PLAN_SHARE = 0.25
"""Share of the memory for cells under change that plans in the background have."""
AWAY_S, AWAY_MAX_S = 5.0, 60.0
"""Time after which one of the commits is tried again that wait for bytes in an object store, doubled each time that it
has to wait on, and the longest."""
HELD_PAGES_MAX = 4
"""Most pages of pending commits that are read at one look, all of which have to wait behind such commits."""
PROBE_S = 60.0
"""Time between two attempts to read a damaged cell again while none is reported as healed."""


@dataclass(slots=True)
class Waiting:
    """Damaged cells of one map, and the commits that wait for them."""

    cells: set[CellKey] = field(default_factory=set)
    commits: set[int] = field(default_factory=set)
    """Numbers of the commits found to touch these cells, and of those held back behind them."""
    of_robot: Counter[RobotName] = field(default_factory=Counter)
    """Count of these commits, by robot."""
    why: DamagedCellError | None = None
    """Error of the cell found last; None: no cell is damaged."""
    away: set[int] = field(default_factory=set)
    """Numbers of those of them that need bytes which an object store did not give."""
    away_s: float | None = None
    """Steady time at which it was asked for them last; None: none needs any."""
    away_wait_s: float = 0.0
    """Time from then on until it is asked again; 0: `AWAY_S`."""
    trial: int | None = None
    """Number of the one that is tried again: all others are not read before it has what it needs."""
    healed: int = 0
    """Count `Damage.healed` at the last look; taken before the look, so that no healing falls between."""
    probed_s: float = 0.0
    """Steady time of the last attempt to read these cells."""

    def add(self, error: DamagedCellError) -> None:
        """Wait for one more damaged cell."""
        self.cells.add(error.key)
        self.why, self.probed_s = error, time.monotonic()

    def take(self, store: FoldStore, row: MapRow, commits: list[StoredCommit]) -> list[StoredCommit]:
        """Those of these commits that may be folded; the others wait from now on."""
        ready: list[StoredCommit] = []
        for commit in commits:
            robot = commit.id.author.robot
            waits, is_trial = self.of_robot[robot], commit.number == self.trial
            is_many = waits >= WAITING_OF_ROBOT_MAX or (waits > 0 and len(self.commits) >= WAITING_MAX)
            is_held = is_many and not is_trial
            if is_held or _touches(store, row, commit, self.cells):
                self._wait(commit)
                if is_trial:  # and tells nothing of the object store: another one is to be tried
                    self.away.discard(commit.number)
                    self.trial = None
            else:
                ready.append(commit)
        return ready

    def leave(self, commits: Sequence[StoredCommit], numbers: Collection[int]) -> None:
        """Leave those of these numbers for later: an object store keeps bytes that they need, and does not answer."""
        for commit in commits:
            if commit.number in numbers:
                self._wait(commit)
                self.away.add(commit.number)
                self.away_s = self.away_s or time.monotonic()
        if self.trial in numbers:
            self.away_s, self.away_wait_s = time.monotonic(), min(2 * (self.away_wait_s or AWAY_S), AWAY_MAX_S)
            self.trial = None

    def end_trial(self, pending: Iterable[int], tried: Collection[int]) -> None:
        """Try all again if the one that is tried has what it needs: it did not wait on, or is not pending any more."""
        if self.trial is not None and (self.trial in tried or self.trial not in pending):
            self._clear()

    def _wait(self, commit: StoredCommit) -> None:
        self.commits.add(commit.number)
        if commit.number != self.trial:  # which was counted before
            self.of_robot[commit.id.author.robot] += 1

    def _clear(self) -> None:
        """Try all commits again."""
        self.commits.clear()
        self.of_robot.clear()
        self.away.clear()
        self.away_s, self.away_wait_s, self.trial = None, 0.0, None

    def error(self) -> CairnError | None:
        """Error for which commits wait."""
        if self.why is None and self.away_s is not None:
            return AwayError("commits wait for cells or evidence in the object store, which does not answer")
        return self.why

    def probe(self, store: FoldStore, row: MapRow, damaged: Damage) -> None:
        """Read the damaged cells again if it is time; if one is sound, everything that waits is tried again.

        Of what waits for an object store one commit is tried, if it is time.
        """
        if self.trial is None and self.away_s is not None:
            if not self.away:
                self._clear()
            elif time.monotonic() - self.away_s > (self.away_wait_s or AWAY_S):
                self.trial = min(self.away)
                self.away.discard(self.trial)
                self.commits.discard(self.trial)
        # The count is taken before the look: a cell healed during it makes the next call look again.
        healed = damaged.healed(row.name)
        if self.cells and (healed != self.healed or time.monotonic() - self.probed_s > PROBE_S):
            self.probed_s = time.monotonic()
            sound = [key for key in self.cells if _can_be_read(store, row, key)]
            for key in sound:
                damaged.forget(row.name, key)
            if sound:
                self.cells.clear()
                self._clear()
                self.why = None
        self.healed = healed


def fold_around(
    store: FoldStore,
    row: MapRow,
    cache: CellCache,
    waiting: Waiting,
    damaged: Damage,
    *,
    limit: int,
    order: Order = as_they_came,
) -> int:
    """Fold up to `limit` pending commits that touch no damaged cell; returns their count.

    Args:
        store: of the map.
        row: the map.
        cache: of its cells.
        waiting: what was found damaged until now; changed here.
        damaged: record of damaged cells, where clients report healed ones.
        limit: of one group.
        order: of the commits in it; it may leave some for the next group.
    """
    waiting.probe(store, row, damaged)
    held_pages, tried = 0, set[int]()

    def noted(chosen: Sequence[StoredCommit], snapshot: Snapshot) -> Iterator[StoredCommit]:
        for commit in order(chosen, snapshot):
            tried.add(commit.number)
            yield commit

    # Each turn folds, or sets commits or a cell aside, so the loop ends.
    while commits := store.pending(row, limit=limit, size_bytes_max=GROUP_BYTES_MAX, skip=waiting.commits):
        ready = waiting.take(store, row, commits)
        if not ready:
            held_pages += 1
            if waiting.away_s is not None and held_pages == HELD_PAGES_MAX:
                return 0
            continue
        # A cell found damaged only now joins the others, and the rest of the commits is tried without it.
        tried.clear()
        try:
            outcome = fold_commits(store, row, cache, ready, order=noted)
        except DamagedCellError as exc:
            if exc.key in waiting.cells:
                raise
            log.error("map %s: what touches cell %s waits: %s", row.name, cell_of_key(exc.key), exc.message)
            waiting.add(exc)
            damaged.note(row.name, [exc.key])
            continue
        waiting.leave(ready, outcome.left)
        waiting.end_trial({commit.number for commit in commits}, tried)
        if outcome.folded or not outcome.left:
            return outcome.folded
    waiting.end_trial((), tried)
    return 0


def _touches(store: FoldStore, row: MapRow, commit: StoredCommit, cells: set[CellKey]) -> bool:
    """True if folding a commit, or taking out the next part of what it retracts, changes one of these cells."""
    if not cells:
        return False
    if commit.due_from is None and not cells.isdisjoint(commit.diff):
        return True
    with store.snapshot(row) as snapshot:
        return not cells.isdisjoint(part_of(commit, snapshot).cells)


def _can_be_read(store: FoldStore, row: MapRow, key: CellKey) -> bool:
    try:
        with store.snapshot(row) as snapshot:
            cell_to_change(snapshot, key, row_of_cell(snapshot, key), row.layer)
    except (DamagedCellError, AwayError):
        return False
    return True


@dataclass(frozen=True, slots=True)
class Folded:
    """Result of one group."""

    commits: int
    """Count of the commits folded."""
    waits_for: CairnError | None
    """Error of a damaged cell, or of an object store, that other commits wait for; None: none waits."""
    is_planning: bool = False
    """True while costly commits, of any map, are planned in the background: look again soon."""


class LocalFolding:
    """Folding in the calling thread, with the cells under change of all maps in memory; one thread at a time."""

    def __init__(self, store: FoldStore, damaged: Damage, memory: FoldMemory | None = None) -> None:
        """Fold what waits in a store, with this much memory."""
        self._memory = memory or FoldMemory()
        self._store = store
        self._damaged = damaged
        self._caches: dict[str, CellCache] = {}
        self._waiting: dict[str, Waiting] = {}
        self._turns: dict[str, FoldTurns] = {}
        self._lanes = FoldLanes(store, self._memory, cells_bytes=int(PLAN_SHARE * self._memory.cells_bytes))

    def close(self) -> None:
        """Wait for what is planned in the background."""
        self._lanes.close()

    def fold(self, row: MapRow, *, is_news: bool = True) -> Folded:
        """Fold one group of a map's pending commits.

        Without news, if nothing came since a fold that left all the rest to the background, that alone is looked at.

        Raises:
            CairnError: nothing was folded.
        """
        if not is_news and self._lanes.is_planning():
            return Folded(0, self._waiting[row.name].error() if row.name in self._waiting else None, is_planning=True)
        cache = self._cache_of(row)
        waiting = self._waiting.setdefault(row.name, Waiting())
        turns, start_s = self._turns.setdefault(row.name, FoldTurns()), time.monotonic()
        count, left = self._lanes.write_plan(row, cache, turns)
        waiting.leave(left, [commit.number for commit in left])

        def order(commits: Sequence[StoredCommit], snapshot: Snapshot) -> Iterator[StoredCommit]:
            return turns.in_turn(self._lanes.cheap(row, commits, cache, snapshot))

        count += fold_around(self._store, row, cache, waiting, self._damaged, limit=GROUP_MAX, order=order)
        turns.end_group(time.monotonic() - start_s)
        cache.trim()
        self._lanes.plan_next(row, turns)
        return Folded(count, waiting.error(), is_planning=self._lanes.has_plan())

    def _cache_of(self, row: MapRow) -> CellCache:
        """Cells of a map that stay decoded from one group to the next: a robot's next scans touch the same ones.

        All maps share one memory. Those that were folded longest ago give theirs up when the map that is folded now
        needs it, until that has half of all.
        """
        cache = self._caches.pop(row.name, None) or CellCache(
            row.geometry, self._memory, more=partial(self._given_up, row.name)
        )
        self._caches[row.name] = cache
        others = sum(other.size_bytes for other in self._caches.values()) - cache.size_bytes
        cache.limit(self._bound_bytes - others)
        return cache

    @property
    def _bound_bytes(self) -> int:
        """Memory of all maps' cells between two groups."""
        return int((1 - PLAN_SHARE) * self._memory.cells_bytes)

    def _given_up(self, name: str) -> int:
        """Bytes of the map's cells that were dropped for the map of this name; 0: it may have half of all."""
        others = {other: cache.size_bytes for other, cache in self._caches.items() if other != name}
        if sum(others.values()) <= self._bound_bytes // 2:
            return 0
        oldest = next(other for other, size_bytes in others.items() if size_bytes)
        del self._caches[oldest]
        return others[oldest]
