"""Folding: pending commits become log entries and new cells. It reads the store and writes nothing.

    fold a commit                 entry +     its diff is added
    retract of a folded commit    entry -     its diff is subtracted, once per target for ever
    commit retracted before it came    both, one after the other (SYNC.md rule 11)
    retract of very much          entry +, then entries - in several folds (`commit_work`)

A group of commits is folded at once, so that a cell is decoded and encoded once for all of them. A commit whose
bytes are damaged at rest is set aside, so that it does not hold up the others; its robot will push it again.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, Protocol

from cairn_map.codec.cell_code import DecodedCell
from cairn_map.commits.commit import commit_sha, version_of_meta
from cairn_map.commits.cursor import ENTRY_FOLD, ENTRY_UNFOLD, Cursor, next_chain
from cairn_map.commits.ids import CommitId
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.blocks import Blocks
from cairn_map.evidence.grid import CellKey
from cairn_server.cell_room import voxels_of
from cairn_server.folding.cell_cache import CellCache, Changed, Step
from cairn_server.folding.cells_at_rest import cell_to_change, decode_stored, row_of_cell
from cairn_server.folding.commit_work import part_of
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.stamps import CellStamps
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Entry, Fold, MapRow, NamedCommit, RetractStep, StoredCommit

log = logging.getLogger(__name__)

Order = Callable[[Sequence[StoredCommit], Snapshot], Iterable[StoredCommit]]
"""Order in which the commits of a group are folded on a state of the map; it may leave some for the next group."""
GROUP_BYTES_MAX = 64 << 20
"""Most bytes of the commits folded at once; a single larger commit is folded alone."""


class FoldReads(Protocol):
    """Part of `store.Store` that planning a fold reads; each process has its own."""

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """`Store.pending`."""
        ...

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """`Store.folded`."""
        ...

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """`Store.is_retracted`."""
        ...

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        """`Store.snapshot`."""
        ...


class FoldStore(FoldReads, Protocol):
    """Part of `store.Store` that folding needs: little enough to be served to another process."""

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """`Store.fold`."""
        ...

    def audit(self, what: str, detail: str) -> None:
        """`Store.audit`."""
        ...


class Damage(Protocol):
    """Part of `damaged_cells.DamagedCells` that folding needs."""

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        """`DamagedCells.note`."""
        ...

    def forget(self, map_name: str, key: CellKey) -> None:
        """`DamagedCells.forget`."""
        ...

    def healed(self, map_name: str) -> int:
        """`DamagedCells.healed`."""
        ...


class DamagedCommitError(DamagedDataError):
    """A stored commit is not what was pushed."""


def fold_pending(store: FoldStore, row: MapRow, cache: CellCache, *, limit: int) -> int:
    """Fold up to `limit` pending commits; returns their count.

    Raises:
        DamagedDataError: a stored cell is damaged and cannot be rebuilt.
    """
    return fold_commits(store, row, cache, store.pending(row, limit=limit, size_bytes_max=GROUP_BYTES_MAX)).folded


class GroupOutcome(NamedTuple):
    """GroupOutcome of folding some commits."""

    folded: int = 0
    """Count of the commits that were folded, set aside, or of whose retract a part was done."""
    left: tuple[int, ...] = ()
    """Numbers of those that stay pending (`Fold.left`)."""


def as_they_came(commits: Sequence[StoredCommit], snapshot: Snapshot) -> Iterable[StoredCommit]:
    """All commits, in their order."""
    return commits


def fold_commits(
    store: FoldStore, row: MapRow, cache: CellCache, commits: Sequence[StoredCommit], *, order: Order = as_they_came
) -> GroupOutcome:
    """Fold these pending commits, or those of them that `order` yields.

    Raises:
        DamagedCellError: a stored cell is damaged and cannot be rebuilt; nothing was folded.
    """
    if not commits:
        return GroupOutcome()
    written = False
    try:
        # One state for the whole plan: a store behind a network is asked once for all of a group's commits.
        with store.snapshot(row) as snapshot:
            named = snapshot.named([commit.id for commit in commits])
            # Another folding may have taken some of them since `pending`, and its head is our base; of a retract under
            # way `store.fold` finds out.
            folded = {each.id for each in named if each.is_folded}
            commits = [commit for commit in commits if commit.due_from is not None or commit.id not in folded]
            # Plan in memory, and write all of it or nothing.
            cache.begin(snapshot.head)
            fold = plan_fold(store, row, snapshot.head, order(commits, snapshot), cache, snapshot=snapshot, named=named)
        is_empty = not (fold.entries or fold.damaged or fold.steps)  # all of them are left for later
        written = is_empty or store.fold(row, fold)
    finally:
        if not written:  # it failed, or another folding was faster, whose result is as good
            cache.clear()
    if not written:
        return GroupOutcome()
    cache.finish(fold.head)
    audit_damaged(store, row, fold)
    begun = sum(entry.kind == ENTRY_FOLD for entry in fold.entries)
    return GroupOutcome(len(fold.damaged) + begun + sum(step.before is not None for step in fold.steps), fold.left)


def audit_damaged(store: FoldStore, row: MapRow, fold: Fold) -> None:
    """Write an audit line for each commit that a fold, which is written, set aside."""
    for number, why in fold.damaged:
        store.audit("damaged_commit", f"map {row.name}: commit number {number} is set aside: {why}")


def plan_fold(
    store: FoldStore,
    row: MapRow,
    head: Cursor,
    commits: Iterable[StoredCommit],
    cache: CellCache,
    *,
    snapshot: Snapshot | None = None,
    named: Iterable[NamedCommit] = (),
) -> Fold:
    """Plan of folding these commits on top of `head`, the state of the cells in `cache`.

    Args:
        store: of the map.
        row: the map.
        head: the state.
        commits: in their order; each is folded before the next is asked for.
        cache: of the map's cells.
        snapshot: the same state, to read it at once; without one each read has a snapshot of its own, so that a long
            plan holds none.
        named: what this snapshot says of some commits, so that the store is not asked for each.
    """
    plan = _Plan(store, row, cache, head, snapshot, {each.id: each.is_retracted for each in named})
    for commit in commits:
        plan.take(commit)
    return Fold(
        base=head,
        head=Cursor(head.log_id, head.seq + len(plan.entries), plan.chain),
        entries=tuple(plan.entries),
        cells=cache.rows(plan.last_change),
        retracted=tuple(plan.retracted),
        damaged=tuple(plan.damaged),
        steps=tuple(plan.steps),
        left=tuple(plan.left),
    )


@dataclass(slots=True)
class _Plan:
    """Log entries and changed cells of the commits taken so far, on top of `start`."""

    store: FoldStore
    map: MapRow
    cache: CellCache
    start: Cursor
    snapshot: Snapshot | None
    known: dict[CommitId, bool]
    """True for a commit that was retracted at the start."""
    chain: bytes = b""
    entries: list[Entry] = field(default_factory=list)
    folded: dict[CommitId, StoredCommit] = field(default_factory=dict)
    retracted: dict[CommitId, None] = field(default_factory=dict)
    last_change: dict[CellKey, int] = field(default_factory=dict)
    damaged: list[tuple[int, str]] = field(default_factory=list)
    steps: list[RetractStep] = field(default_factory=list)
    left: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.chain = self.start.chain

    def take(self, commit: StoredCommit) -> None:
        """Add a commit: its own entry, then its own retract if that came first, then a part of what it retracts."""
        if commit.due_from is None and not self._begin(commit):
            return
        if not commit.retracts:
            return
        # What it names in this part, of which the state at the start is known from here on.
        with self._reading() as snapshot:
            part = part_of(commit, snapshot)
        self.known |= {each.id: each.is_retracted for each in part.named}
        due_from = part.due_from
        for place, target in enumerate((each.id for each in part.named), start=commit.due_from or 0):
            # Once for ever: a second retract of the same target, in this group or in the store, changes nothing.
            if self._is_retracted(target):
                continue
            try:
                self._retract(target)
            except AwayError:
                self.left.append(commit.number)
                due_from = place
                break
        if commit.due_from != due_from:
            self.steps.append(RetractStep(commit.number, commit.due_from, due_from))

    def _begin(self, commit: StoredCommit) -> bool:
        """Add a commit's own entry; False if it is damaged, or has to wait for bytes of its cells."""
        try:
            self._enter(ENTRY_FOLD, commit)
        except DamagedCommitError as exc:
            log.error("commit %s is set aside: %s", commit.id, exc.message)
            self.damaged.append((commit.number, exc.message))
            return False
        except AwayError:
            self.left.append(commit.number)
            return False
        self.folded[commit.id] = commit
        # Retracted before it came: both entries stand in the log, so that every robot sees the same history.
        if self._is_retracted(commit.id):
            self._enter(ENTRY_UNFOLD, commit)
        return True

    def _retract(self, target: CommitId) -> None:
        # A target that did not come yet is only noted; `take` finds it when it comes.
        known = self.folded.get(target) or self.store.folded(self.map, target)
        try:
            # The evidence of a folded target may be gone, or damaged: then the map keeps it, and an audit line says so.
            if known is not None:
                self._enter(ENTRY_UNFOLD, known)
        except DamagedCommitError as exc:
            self.store.audit("retract_failed", f"map {self.map.name}: {target} stays in the map: {exc.message}")
            return  # and is not noted as retracted, so that a later retract may succeed
        self.retracted[target] = None

    def _is_retracted(self, commit: CommitId) -> bool:
        if commit not in self.known:
            self.known[commit] = self.store.is_retracted(self.map, commit)
        return commit in self.retracted or self.known[commit]

    def _enter(self, kind: bytes, commit: StoredCommit) -> None:
        # All of the commit's cells or none: a damaged one raises before there is an entry.
        blocks = self._apply(kind, commit)
        # Rule 1: each entry's chain value hashes the one before it, so a cursor proves the history that led to it.
        self.chain = next_chain(self.chain, kind, commit.id, commit.sha)
        self.entries.append(Entry(kind=kind, commit=commit.number, chain=self.chain))
        seq = self.start.seq + len(self.entries)
        self.last_change.update(dict.fromkeys(commit.diff, seq))
        # Rule 2: also where evidence was taken out, so that a state frame tells robots of the zeros (rule 10).
        for key, changed in blocks.items():
            self.cache.stamp(key, changed, seq, self)

    def _apply(self, kind: bytes, commit: StoredCommit) -> dict[CellKey, Blocks]:
        """Add or subtract a commit's diff, all of it or nothing; returns the blocks of each cell that it touches."""
        if commit.gone:
            raise DamagedCommitError("damaged_store", f"the evidence of commit {commit.id} is not kept any more")
        # The sums are integers, so that taking a diff back gives exactly the cell of before; and it is taken out of the
        # epoch that it was added to, whatever came since (rule T6).
        step, undo = HistoryCell.merge, HistoryCell.unmerge
        if kind == ENTRY_UNFOLD:
            step, undo = undo, step
        # The diffs are applied before their SHA-256 is known: each is decoded once, and taken back if it is wrong.
        done: dict[CellKey, Blocks] = {}
        digests: list[bytes] = []
        try:
            for key, body in commit.diff.items():
                done[key], digest = self._change(key, body, step, commit)
                digests.append(digest)
            if commit_sha(commit.text, digests, version=version_of_meta(commit.text)) != commit.sha:
                raise DamagedCommitError("damaged_store", f"commit {commit.id} at rest does not have its SHA-256")
        except (DamagedCommitError, AwayError):
            for key in done:
                self._change(key, commit.diff[key], undo, commit)
            raise
        return done

    def _change(self, key: CellKey, body: bytes, step: Step, commit: StoredCommit) -> Changed:
        try:
            read = partial(_decoded, commit, key, body)
            return self.cache.change(key, voxels_of(body), read, step, self, epoch=commit.epoch)
        except BadInputError as exc:
            raise DamagedCommitError("damaged_store", f"commit {commit.id} at rest: {exc.message}") from exc

    def _reading(self) -> AbstractContextManager[Snapshot]:
        """The state at the start, or a later one: if another folding wrote since then, `store.fold` refuses."""
        return nullcontext(self.snapshot) if self.snapshot is not None else self.store.snapshot(self.map)

    # As `StoredCells`.

    def row(self, key: CellKey) -> CellRow | None:
        """Row of a cell."""
        with self._reading() as snapshot:
            return row_of_cell(snapshot, key)

    def opened(self, key: CellKey, row: CellRow | None) -> tuple[HistoryCell, CellStamps]:
        """Cell of a row, to be changed."""
        with self._reading() as snapshot:
            return cell_to_change(snapshot, key, row, self.map.layer)


def _decoded(commit: StoredCommit, key: CellKey, body: bytes) -> DecodedCell:
    try:
        return decode_stored(key, body)
    except DamagedDataError as exc:
        raise DamagedCommitError(exc.kind, f"commit {commit.id}: {exc.message}") from exc
