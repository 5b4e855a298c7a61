"""One map as dictionaries: the rows of `memory_store`, and their changes."""

import secrets
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from tests.memory_store.admission import Keys, admit_commit

from cairn_map.commits.cursor import ENTRY_FOLD, Cursor, first_chain
from cairn_map.commits.ids import SERVERS_OWN, Author, CommitId
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.admission import RobotKey
from cairn_server.store.numbering import AGAIN_KEPT_S, EvidenceGoneError, Numbering, check_number
from cairn_server.store.replica_notes import RobotView
from cairn_server.store.shares import (
    ALARM_PART,
    RESERVE,
    Tops,
    account_of,
    check_marks,
    check_reserve,
    check_sums,
    used_part,
)
from cairn_server.store.store_rows import (
    Branch,
    CellRow,
    ClosedRobot,
    Entry,
    Fold,
    MapRow,
    NewCommit,
    RobotShares,
    StoredCommit,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """A commit and what became of it."""

    number: int
    new: NewCommit
    """Without its meta and its diff once they are gone."""
    cells: int
    """That it touched, gone or not."""
    received_s: float
    received_age_s: float
    folded_age_s: float = 0.0
    folded_seq: int | None = None
    unfolded_seq: int = 0
    """Log entry that took it out again; 0 if none did."""
    due_from: int | None = None
    is_damaged: bool = False
    is_gone: bool = False

    @property
    def is_waiting(self) -> bool:
        """Whether it is to be folded."""
        return self.folded_seq is None and not self.is_damaged

    @property
    def is_due(self) -> bool:
        """True while a commit, or a part of its retract, waits to be folded."""
        return self.is_waiting or self.due_from is not None

    def stored(self) -> StoredCommit:
        """As the folder reads it."""
        return StoredCommit(
            number=self.number,
            id=self.new.id,
            sha=self.new.sha,
            text=self.new.text,
            retracts=self.new.retracts,
            diff=dict(sorted(self.new.diff.items())),
            gone=self.is_gone,
            signatures=self.new.signatures,
            due_from=self.due_from,
            epoch=self.new.epoch,
        )


@dataclass(slots=True)
class MemoryMap:
    """Everything about one map. Values are never changed, only put in place of others."""

    row: MapRow
    head: Cursor
    is_shared: bool = False
    """A snapshot has these dictionaries: copy them before they are changed."""
    commits: dict[CommitId, Kept] = field(default_factory=dict)
    """In order of arrival."""
    ids: list[CommitId] = field(default_factory=list)
    """By number."""
    authors: dict[Author, tuple[int, int]] = field(default_factory=dict)
    """Highest number, and intervals of the numbers."""
    closed: set[Author] = field(default_factory=set)
    entries: list[Entry] = field(default_factory=list)
    touched: dict[CellKey, tuple[int, ...]] = field(default_factory=dict)
    """Log entries that concern a cell."""
    retracted: set[CommitId] = field(default_factory=set)
    cells: dict[CellKey, CellRow] = field(default_factory=dict)
    branches: dict[str, Branch] = field(default_factory=dict)
    statuses: dict[str, str] = field(default_factory=dict)
    assignments: dict[str, str] = field(default_factory=dict)
    heard_s: dict[str, float] = field(default_factory=dict)
    """Times at which statuses were heard, where several servers note them."""
    views: dict[str, RobotView] = field(default_factory=dict)
    keys: dict[Author, RobotKey] = field(default_factory=dict)
    """That names are bound to."""

    def copied(self) -> "MemoryMap":
        """The same in other dictionaries."""
        other = replace(self, is_shared=False)
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, dict | list | set):
                setattr(other, name, value.copy())
        return other

    def evidence_bytes(self) -> int:
        """Bytes of the commits whose evidence is kept."""
        return sum(kept.new.size_bytes for kept in self.commits.values() if not kept.is_gone)

    def append(self, commit: NewCommit, *, age_s: float, keys: Keys) -> bool:
        """Keep a commit at an age of the store; False if the same one is known already.

        The keys are those that robots' names are bound to, of a layer its map's.
        """
        known = self.commits.get(commit.id)
        if known is not None:
            return self._append_again(known, commit, age_s)
        self._check_kept(commit.retracts)
        intervals = self._checked_intervals(commit.id, is_carried=commit.is_carried)
        self._check_sums(commit)
        admit_commit(keys, commit.id.author, commit.grounds)
        top, _ = self.authors.get(commit.id.author, (0, 0))
        if commit.marks:
            check_marks(commit, self._held_marks(commit.id.author.robot, without=commit.retracts))
        self.authors[commit.id.author] = max(top, commit.id.n), intervals
        self.commits[commit.id] = Kept(
            number=len(self.ids),
            new=commit,
            cells=len(commit.diff),
            received_s=time.time(),
            received_age_s=age_s,
        )
        self.ids.append(commit.id)
        return True

    def has_evidence(self, before_s: float) -> bool:
        """True if evidence is kept of a commit that was folded before an age of the store."""
        return any(
            kept.cells and not kept.is_gone and kept.folded_seq is not None and kept.folded_age_s < before_s
            for kept in self.commits.values()
        )

    def next_number(self, author: Author) -> int:
        """The number after an author's highest."""
        return self.authors[author][0] + 1 if author in self.authors else 0

    def fold(self, fold: Fold, *, age_s: float) -> bool:
        """Cells, entries and head at an age of the store, if head and retracts are still where the fold begins."""
        if fold.base != self.head:
            return False
        if any(self.commits[self.ids[step.commit]].due_from != step.before for step in fold.steps):
            return False
        self.head = fold.head
        for entry in fold.entries:
            self.entries.append(entry)
            self._note_entry(entry, len(self.entries), age_s)
        self.retracted.update(fold.retracted)
        for number, _ in fold.damaged:
            aside = self.ids[number]
            self.commits[aside] = replace(self.commits[aside], is_damaged=True)
        for step in fold.steps:
            begun = self.ids[step.commit]
            self.commits[begun] = replace(self.commits[begun], due_from=step.after)
        for cell in fold.cells:
            before = self.cells.get(cell.key)
            self.cells[cell.key] = replace(cell, gone_seq=before.gone_seq if before else 0)
        return True

    def forget_evidence(self, *, before_s: float, limit: int, age_s: float) -> int:
        """Drop the evidence and the meta of commits folded, and last pushed, before an age of the store; how many.

        What is left of a commit is its row in the log; see `sqlite_retention`.
        """
        naming = (kept for kept in self.commits.values() if kept.folded_seq is None or kept.due_from is not None)
        pinned = {target for kept in naming for target in kept.new.retracts}
        again_s = min(before_s, age_s - AGAIN_KEPT_S)
        old = [
            kept
            for commit, kept in self.commits.items()
            if kept.folded_seq is not None
            and kept.cells
            and not kept.is_gone
            and kept.folded_age_s < before_s
            and kept.received_age_s
            < (again_s if kept.received_age_s > kept.folded_age_s and not kept.unfolded_seq else before_s)
            and commit not in pinned
        ]
        old.sort(key=lambda kept: kept.folded_age_s)
        for kept in old[:limit]:
            self._forget(kept)
        return len(old[:limit])

    def waiting(self) -> Iterator[Kept]:
        """Commits to be folded, in order of arrival."""
        return (kept for kept in self.commits.values() if kept.is_waiting)

    def due(self) -> Iterator[Kept]:
        """Commits that folding has still to do with, in order of arrival."""
        return (kept for kept in self.commits.values() if kept.is_due)

    def heal(self, cell: CellRow) -> bool:
        """Other bytes for a cell, if it is still of the same entry; its stamps stay."""
        known = self.cells.get(cell.key)
        if known is None or known.lm != cell.lm:
            return False
        self.cells[cell.key] = replace(cell, stamps=known.stamps, gone_seq=known.gone_seq)
        return True

    def _append_again(self, known: Kept, commit: NewCommit, age_s: float) -> bool:
        if known.new.sha != commit.sha:
            raise ConflictError("id_taken", f"commit {commit.id} is already here with other bytes")
        if known.is_damaged:
            self.commits[commit.id] = replace(known, new=commit, is_damaged=False)
        elif known.is_gone and commit.id not in self.retracted:
            self.commits[commit.id] = replace(
                known, new=commit, is_gone=False, received_s=time.time(), received_age_s=age_s
            )
        return known.is_damaged

    def _note_entry(self, entry: Entry, seq: int, age_s: float) -> None:
        commit = self.ids[entry.commit]
        kept = self.commits[commit]
        for key in kept.new.diff:
            self.touched[key] = (*self.touched.get(key, ()), seq)
        if entry.kind != ENTRY_FOLD:
            self.commits[commit] = replace(kept, unfolded_seq=seq)
        elif kept.folded_seq is None:
            self.commits[commit] = replace(kept, folded_seq=seq, folded_age_s=age_s)

    def _forget(self, kept: Kept) -> None:
        seqs = (kept.folded_seq or 0, kept.unfolded_seq)
        for key in kept.new.diff:
            if key in self.cells:
                cell = self.cells[key]
                self.cells[key] = replace(cell, gone_seq=max(cell.gone_seq, *seqs))
            self.touched[key] = tuple(seq for seq in self.touched.get(key, ()) if seq not in seqs)
        self.commits[kept.new.id] = replace(kept, new=replace(kept.new, text=b"", diff={}), is_gone=True)

    def _check_kept(self, targets: tuple[CommitId, ...]) -> None:
        """Refuse to retract what cannot be subtracted any more."""
        known = [t for t in targets if t in self.commits and t not in self.retracted]
        if gone := [target for target in known if self.commits[target].is_gone]:
            raise EvidenceGoneError(gone)

    def _checked_intervals(self, commit: CommitId, *, is_carried: bool) -> int:
        """Intervals of the author's numbers with this one, if `numbering` lets it in."""
        author = commit.author
        top, intervals = self.authors.get(author, (None, 0))
        neighbours = sum(CommitId(author, n) in self.commits for n in (commit.n - 1, commit.n + 1))
        accounts = {share.robot: share for share in self.shares()}
        own = accounts.get(account_of(author.robot, is_closed=False))
        numbering = Numbering(
            top=top,
            neighbours=neighbours,
            is_closed=author in self.closed,
            incarnations=own.incarnations if own else 0,
            intervals=own.intervals if own else 0,
            robots=len(accounts.keys() - {RESERVE}),
            is_carried=is_carried,
        )
        check_number(commit, numbering)
        return intervals + 1 - neighbours

    def _held_marks(self, robot: str, *, without: tuple[CommitId, ...]) -> int:
        """Marks of a robot that are not taken out, nor of some of its commits."""
        own = (kept for commit, kept in self.commits.items() if commit.author.robot == robot and commit not in without)
        return sum(len(kept.new.marks) for kept in own if not kept.unfolded_seq)

    def shares(self) -> list[RobotShares]:
        """What every robot, and the reserve, has of its shares."""
        found: defaultdict[str, list[int]] = defaultdict(list)
        for author, (_, intervals) in self.authors.items():
            found[self._account(author)].append(intervals)
        parts = {account: self._fullest(account) for account in found}
        return [
            RobotShares(robot=account, incarnations=len(counts), intervals=sum(counts), sums=parts[account])
            for account, counts in sorted(found.items())
        ]

    def held(self, account: str) -> dict[int, Tops]:
        """Largest numbers of an account's commits that are pending or in the map, added up by region."""
        found: dict[int, Tops] = {}
        for commit, kept in self.commits.items():
            if not kept.unfolded_seq and self._account(commit.author) == account:
                for region, tops in kept.new.tops.items():
                    found[region] = _sum(tops, found.get(region))
        return found

    def close(self, robot: str) -> ClosedRobot:
        """Close a robot's authors."""
        own = [author for author in self.authors if author.robot == robot and author not in self.closed]
        if not own or robot in SERVERS_OWN:
            raise NotFoundError("no_author", f"robot {robot!r} has no commits in map {self.row.name} to close")
        intervals = sum(self.authors[author][1] for author in own)
        reserved = [share for share in self.shares() if share.robot == RESERVE]
        reserve = self.held(RESERVE)
        try:
            check_reserve(
                authors=len(own) + sum(share.incarnations for share in reserved),
                intervals=intervals + sum(share.intervals for share in reserved),
                what=robot,
            )
            for key, tops in self.held(robot).items():
                check_sums(RESERVE, key, _sum(tops, reserve.get(key)), self.row.geometry)
        except BadInputError as exc:
            raise ConflictError("reserve_full", exc.message) from exc
        self.closed.update(own)
        return ClosedRobot(authors=len(own), intervals=intervals)

    def _account(self, author: Author) -> str:
        return account_of(author.robot, is_closed=author in self.closed)

    def _fullest(self, account: str) -> float | None:
        held = self.held(account)
        part = max((used_part(account, total) for total in held.values()), default=0.0)
        return part if part > ALARM_PART else None

    def _check_sums(self, commit: NewCommit) -> None:
        account = account_of(commit.id.author.robot, is_closed=False)
        held = self.held(account)
        for region, tops in commit.tops.items():
            check_sums(account, region, _sum(tops, held.get(region)), self.row.geometry)


def _sum(tops: Tops, more: Tops | None) -> Tops:
    return tuple(a + b for a, b in zip(tops, more, strict=True)) if more else tops


def new_memory_map(
    number: int, name: str, layer: MapLayer, sensor_model: SensorModel, of_map: MapRow | None = None
) -> MemoryMap:
    """A map, or a layer of one, without anything in it."""
    row = MapRow(
        number=number,
        name=name,
        geometry=layer.geometry,
        sensor_model=sensor_model,
        seal_key=of_map.seal_key if of_map else secrets.token_bytes(32),
        epoch_s=layer.epoch_s,
        of_map=of_map.number if of_map else None,
    )
    log_id = secrets.token_bytes(16)
    return MemoryMap(row, Cursor(log_id, 0, first_chain(log_id, layer.digest())))
