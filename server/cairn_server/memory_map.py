"""One map as dictionaries: the rows of `memory_store`, their changes, and a snapshot of them."""

import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from cairn_map.cursor import Cursor, first_chain
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.evidence import COUNT_MAX, SUM_MAX
from cairn_map.grid import CellKey, Geometry, cell_of_key
from cairn_map.ids import Author, CommitId, new_incarnation
from cairn_map.messages import LogEntry
from cairn_map.sensor_model import SensorModel
from cairn_map.version_vector import EMPTY, VersionVector
from cairn_server.push_policy import Numbering, check_number
from cairn_server.store_rows import (
    Branch,
    CellRow,
    Contribution,
    Entry,
    Fold,
    Head,
    MapRow,
    NewCommit,
    StoredCommit,
    Totals,
)


@dataclass(slots=True)
class MemoryMap:
    """Everything about one map. Values are never changed, only put in place of others."""

    row: MapRow
    head: Head
    tops: tuple[int, ...]
    is_shared: bool = False
    """A snapshot has these dictionaries: copy them before they are changed."""
    commits: dict[CommitId, NewCommit] = field(default_factory=dict)
    """In order of arrival."""
    numbers: dict[CommitId, int] = field(default_factory=dict)
    ids: list[CommitId] = field(default_factory=list)
    """By number."""
    diffs: list[tuple[CommitId, CellKey]] = field(default_factory=list)
    """By the number of the diff."""
    diff_numbers: dict[tuple[CommitId, CellKey], int] = field(default_factory=dict)
    authors: dict[Author, tuple[int, int]] = field(default_factory=dict)
    """Highest number, and intervals of the numbers."""
    folded: dict[CommitId, float] = field(default_factory=dict)
    """When each was."""
    damaged: set[CommitId] = field(default_factory=set)
    entries: list[Entry] = field(default_factory=list)
    touched: dict[CellKey, tuple[int, ...]] = field(default_factory=dict)
    """Log entries that concern a cell."""
    retracted: set[CommitId] = field(default_factory=set)
    cells: dict[CellKey, CellRow] = field(default_factory=dict)
    branches: dict[str, Branch] = field(default_factory=dict)
    tokens: dict[str, bytes] = field(default_factory=dict)

    def copied(self) -> "MemoryMap":
        """The same in other dictionaries."""
        other = replace(self, is_shared=False)
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, dict | list | set):
                setattr(other, name, value.copy())
        return other

    def append(self, commit: NewCommit) -> bool:
        """Keep a commit; False if the same one is kept already."""
        known = self.commits.get(commit.id)
        if known is not None:
            if known.sha != commit.sha:
                raise ConflictError("id_taken", f"commit {commit.id} is already here with other bytes")
            if commit.id not in self.damaged:
                return False
            self.damaged.remove(commit.id)
        else:
            intervals = self._checked_intervals(commit.id)
            self.tops = self._checked_tops(commit.tops)
            top, _ = self.authors.get(commit.id.author, (0, 0))
            self.authors[commit.id.author] = max(top, commit.id.n), intervals
            self.numbers[commit.id] = len(self.ids)
            self.ids.append(commit.id)
        self.commits[commit.id] = commit
        for key in commit.diff:
            if (commit.id, key) not in self.diff_numbers:
                self.diff_numbers[commit.id, key] = len(self.diffs)
                self.diffs.append((commit.id, key))
        return True

    def next_number(self, author: Author) -> int:
        """The number after an author's highest."""
        return self.authors[author][0] + 1 if author in self.authors else 0

    def fold(self, fold: Fold) -> bool:
        """Cells, entries and head, if the head is still the fold's base."""
        if fold.base != self.head.cursor:
            return False
        self.head = Head(cursor=fold.head, vector=fold.vector)
        now_s = time.time()
        for entry in fold.entries:
            commit = self.commits[self.ids[entry.commit]]
            self.entries.append(entry)
            self.folded.setdefault(commit.id, now_s)
            for key in commit.diff:
                self.touched[key] = (*self.touched.get(key, ()), len(self.entries))
        self.retracted.update(fold.retracted)
        self.damaged.update(self.ids[number] for number, _ in fold.damaged)
        self.cells.update((cell.key, cell) for cell in fold.cells)
        return True

    def waiting(self) -> Iterator[NewCommit]:
        """Commits to be folded, in order of arrival."""
        return (c for i, c in self.commits.items() if i not in self.folded and i not in self.damaged)

    def stored(self, commit: CommitId) -> StoredCommit:
        """A commit as the folder reads it."""
        kept = self.commits[commit]
        return StoredCommit(
            number=self.numbers[commit],
            id=commit,
            sha=kept.sha,
            text=kept.text,
            retracts=kept.retracts,
            diff=dict(sorted(kept.diff.items())),
        )

    def _checked_intervals(self, commit: CommitId) -> int:
        """Intervals of the author's numbers with this one, if `push_policy` lets it in."""
        author = commit.author
        top, intervals = self.authors.get(author, (None, 0))
        neighbours = sum(CommitId(author, n) in self.commits for n in (commit.n - 1, commit.n + 1))
        numbering = Numbering(
            top=top,
            intervals=intervals,
            neighbours=neighbours,
            incarnations=sum(known.robot == author.robot for known in self.authors),
            authors_in_map=len(self.authors),
            intervals_in_map=sum(count for _, count in self.authors.values()),
        )
        check_number(commit, numbering)
        return intervals + 1 - neighbours

    def _checked_tops(self, tops: tuple[int, ...]) -> tuple[int, ...]:
        sums = tuple(total + top for total, top in zip(self.tops, tops, strict=True))
        if max(sums[:2]) > COUNT_MAX or max(sums[2:], default=0) > SUM_MAX:
            raise BadInputError("evidence_overflow", "the map could not take this much evidence without an overflow")
        return sums


def new_memory_map(number: int, name: str, geometry: Geometry, sensor_model: SensorModel) -> MemoryMap:
    """A map without anything in it."""
    row = MapRow(number=number, name=name, geometry=geometry, sensor_model=sensor_model, operator=new_incarnation())
    log_id = secrets.token_bytes(16)
    head = Head(cursor=Cursor(log_id, 0, first_chain(log_id, geometry.digest())))
    return MemoryMap(row, head, tops=(0,) * (2 + geometry.plane_count))


class MemorySnapshot:
    """`store.Snapshot` of dictionaries that nobody changes any more."""

    def __init__(self, state: MemoryMap) -> None:
        self._state = state

    @property
    def head(self) -> Head:
        """The state."""
        return self._state.head

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        if seq == 0:
            return first_chain(self.head.cursor.log_id, self._state.row.geometry.digest())
        return self._state.entries[seq - 1].chain if 0 < seq <= len(self._state.entries) else None

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        return self._state.cells.get(key)

    def cells(self, *, after_seq: int = -1) -> Iterator[CellRow]:
        """All cells changed after a log entry, without bodies, rising in number."""
        for _, cell in sorted(self._state.cells.items()):
            if cell.lm > after_seq:
                yield replace(cell, body=b"")

    def contributions(self, key: CellKey, *, after_seq: int, limit: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most `limit`."""
        seqs = [seq for seq in self._state.touched.get(key, ()) if seq > after_seq]
        return [self._contribution(key, self._state.entries[seq - 1]) for seq in seqs[:limit]]

    def diff(self, number: int) -> bytes | None:
        """The bytes of a contribution."""
        commit, key = self._state.diffs[number]
        return self._state.commits[commit].diff[key]

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        mine = [commit.n for commit in self._state.folded if commit.author == author]
        return (max(mine), self._state.commits[CommitId(author, max(mine))].sha) if mine else None

    def commits_of(self, robot: str) -> list[CommitId]:
        """Every commit with evidence of a robot, all incarnations, that is not retracted."""
        return [
            commit.id
            for commit in self._state.commits.values()
            if commit.id.author.robot == robot and commit.diff and commit.id not in self._state.retracted
        ]

    def pending(self) -> VersionVector:
        """Commits that are kept but not folded, without those that are set aside as damaged."""
        return EMPTY.with_commits(commit.id for commit in self._state.waiting())

    def folded_before(self, time_s: float) -> VersionVector:
        """Commits folded before a time."""
        return EMPTY.with_commits(commit for commit, when_s in self._state.folded.items() if when_s < time_s)

    def retracting(self) -> list[CommitId]:
        """Commits that retract others."""
        return [c.id for c in self._state.commits.values() if c.retracts and c.id in self._state.folded]

    def log(self, *, after_seq: int, limit: int) -> list[LogEntry]:
        """Log entries, oldest first."""
        found = list(enumerate(self._state.entries, start=1))[after_seq : after_seq + limit]
        return [self._log_entry(seq, entry) for seq, entry in found]

    def totals(self) -> Totals:
        """Sizes."""
        cells = [cell for cell in self._state.cells.values() if cell.voxels]
        axes = list(zip(*(cell_of_key(cell.key) for cell in cells), strict=True))
        return Totals(
            cells=len(cells),
            size_bytes=sum(cell.size_bytes for cell in cells),
            commits=len(self._state.commits),
            branches=len(self._state.branches),
            corner_cells=((min(axes[0]), min(axes[1]), min(axes[2])), (max(axes[0]), max(axes[1]), max(axes[2])))
            if cells
            else None,
        )

    def _contribution(self, key: CellKey, entry: Entry) -> Contribution:
        commit = self._state.ids[entry.commit]
        size_bytes = len(self._state.commits[commit].diff[key])
        return Contribution(entry.kind, commit.author, self._state.diff_numbers[commit, key], size_bytes)

    def _log_entry(self, seq: int, entry: Entry) -> LogEntry:
        commit = self._state.commits[self._state.ids[entry.commit]]
        return LogEntry(
            seq=seq,
            kind="+" if entry.kind == b"+" else "-",
            id=str(commit.id),
            sha=commit.sha.hex(),
            size_bytes=commit.size_bytes,
            cells=len(commit.diff),
            captured_s=commit.captured_s,
            retracts=[str(target) for target in commit.retracts],
        )
