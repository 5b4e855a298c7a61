"""Fold of costly commits, planned in a thread of low priority while cheap commits are folded.

    background    plan on the state at seq 7, 1 s long  ──────────────┐
    folding       8 = a scan   9 = a scan   10 = a scan               └─> the same plan, written as entry 11

A plan says what its cells become, and that depends on its commits and these cells alone. While it is under way no
other commit that touches one of its cells, or is named or names one that it names, is folded, so it can be moved onto
the newest state: its entries get their numbers and chain values, and the stamps of its blocks those of its entries.
What it read is compared again, so a plan that stands on anything else than the map is thrown away. It writes nothing: a
kill loses time only.

The thread that folds reads no evidence to begin or to write a plan: what a commit takes out in one fold is bounded
(`commit_work`), and only the numbers of its cells and their digests are looked up.
"""

import os
import threading
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from cairn_map.commits.cursor import Cursor, next_chain
from cairn_map.commits.ids import CommitId
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.commit_work import part_of
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.folding import FoldStore, plan_fold
from cairn_server.store.stamps import raised_stamps
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Entry, Fold, MapRow, NamedCommit, StoredCommit

NICE = 10
"""Priority of the thread: a tenth of the processor if others need it."""


class _CellState(NamedTuple):
    """State of a stored cell that a plan adds to."""

    key: CellKey
    lm: int
    digest: bytes


@dataclass(frozen=True, slots=True)
class _Ground:
    """State of a map that a plan depends on."""

    cells: tuple[_CellState, ...]
    """Each stored cell of the plan."""
    commits: tuple[NamedCommit, ...]
    """Each commit that is folded or named."""


class BackgroundPlan:
    """One plan and the thread that makes it."""

    def __init__(
        self, store: FoldStore, row: MapRow, commits: Sequence[StoredCommit], memory: FoldMemory, *, cells_bytes: int
    ) -> None:
        """Start to plan folding some pending commits; the cells under change have so much of the memory."""
        self.row = row
        self.commits = tuple(commits)
        self.seconds = 0.0
        """Time that it took."""
        self._store = _NotingStore(store)
        self._memory = memory
        self._fold: Fold | None = None
        self._is_away = False
        with store.snapshot(row) as snapshot:
            self._head = snapshot.head
            parts = [part_of(commit, snapshot) for commit in commits if commit.retracts]
            self.cells = frozenset(key for commit in commits for key in commit.diff).union(*(p.cells for p in parts))
            """Cells that it changes."""
            self.named = frozenset(each.id for part in parts for each in part.named)
            """Commits that it takes out, or notes to be taken out when they come."""
            self._ground = self._ground_in(snapshot)
        self._thread = threading.Thread(target=self._run, args=(cells_bytes,), name="cairn-plan", daemon=True)
        self._thread.start()

    def is_done(self) -> bool:
        """True if the plan is made, or failed."""
        return not self._thread.is_alive()

    def join(self) -> None:
        """Wait until it is done."""
        self._thread.join()

    def is_failed(self) -> bool:
        """True if something is damaged: the commits are to be folded without a plan, which tells what."""
        return self.is_done() and self._fold is None and not self._is_away

    def is_away(self) -> bool:
        """True if bytes that it needs are in an object store, which does not answer."""
        return self.is_done() and self._is_away

    def write(self) -> Fold | None:
        """Write the fold on top of the newest state; None if that is not what the plan stands on."""
        if self._fold is None:
            return None
        with self._store.snapshot(self.row) as snapshot:
            head = snapshot.head
            is_same = self._ground_in(snapshot) == self._ground
        if not is_same:
            return None
        known = self._store.known | {commit.number: (commit.id, commit.sha) for commit in self.commits}
        fold = moved_fold(self._fold, head, known, self.row.geometry, self._memory)
        if not self._store.fold(self.row, fold):
            return None
        self._store.write_notes()
        return fold

    def _run(self, cells_bytes: int) -> None:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        start_s = time.monotonic()
        cache = CellCache(self.row.geometry, self._memory, limit_bytes=cells_bytes)
        cache.begin(self._head)
        # Whatever it is: folding without a plan meets it again, in the thread that can report it.
        with suppress(Exception):
            fold = plan_fold(self._store, self.row, self._head, self.commits, cache)
            self._is_away = bool(fold.left)
            self._fold = None if fold.damaged or fold.left else fold
        self.seconds = time.monotonic() - start_s

    def _ground_in(self, snapshot: Snapshot) -> _Ground:
        commits = {commit.id for commit in self.commits} | self.named
        cells = (_CellState(cell.key, cell.lm, cell.digest) for cell in snapshot.cells_of(self.cells))
        return _Ground(tuple(cells), tuple(snapshot.named(sorted(commits))))


def moved_fold(
    fold: Fold, base: Cursor, known: dict[int, tuple[CommitId, bytes]], geometry: Geometry, memory: FoldMemory
) -> Fold:
    """The same fold on top of a newer state, in which its cells are unchanged.

    Args:
        fold: made from an older state.
        base: the newer state.
        known: id and SHA-256 of each commit of its entries, by number.
        geometry: of the map.
        memory: for its cells.
    """
    chain = base.chain
    entries: list[Entry] = []
    for entry in fold.entries:
        chain = next_chain(chain, entry.kind, *known[entry.commit])
        entries.append(replace(entry, chain=chain))
    return replace(
        fold,
        base=base,
        head=Cursor(base.log_id, base.seq + len(entries), chain),
        entries=tuple(entries),
        cells=_moved_cells(fold.cells, fold.base.seq, base.seq - fold.base.seq, geometry, memory),
    )


def _moved_cells(
    cells: Iterable[CellRow], after: int, by: int, geometry: Geometry, memory: FoldMemory
) -> Iterable[CellRow]:
    if by == 0:
        return cells
    return memory.spool(_moved_cell(cell, after, by, geometry) for cell in cells)


def _moved_cell(cell: CellRow, after: int, by: int, geometry: Geometry) -> CellRow:
    """A cell whose stamps of the entries `after` one, and its own, are raised."""
    stamps = raised_stamps(cell.stamps, after, by, depth=geometry.depth, lm=cell.lm)
    return replace(cell, lm=cell.lm + by, stamps=stamps)


class _NotingStore:
    """`FoldStore` for the thread of a plan: audit lines are kept until the fold is written."""

    def __init__(self, store: FoldStore) -> None:
        self._store = store
        self._notes: list[tuple[str, str]] = []
        self.known: dict[int, tuple[CommitId, bytes]] = {}
        """Id and SHA-256 of the folded commits that were asked for, by number."""

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        return self._store.pending(row, limit=limit, size_bytes_max=size_bytes_max, skip=skip)

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        found = self._store.folded(row, commit)
        if found is not None:
            self.known[found.number] = found.id, found.sha
        return found

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        return self._store.is_retracted(row, commit)

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        return self._store.snapshot(row)

    def fold(self, row: MapRow, fold: Fold) -> bool:
        return self._store.fold(row, fold)

    def audit(self, what: str, detail: str) -> None:
        self._notes.append((what, detail))

    def write_notes(self) -> None:
        """Write the lines kept."""
        for what, detail in self._notes:
            self._store.audit(what, detail)
