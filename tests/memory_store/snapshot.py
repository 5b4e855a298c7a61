"""Reading one state of a map in memory."""

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice

from tests.memory_store.map import Kept, MemoryMap

from cairn_map.commits.cursor import ENTRY_FOLD, Cursor, first_chain
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.mark import MarkKey
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import LogEntry
from cairn_server.store.store_rows import (
    CAPTURED_AHEAD_MAX_S,
    CellRow,
    ChainedEntry,
    Contribution,
    Entry,
    MarkBox,
    MarkChange,
    NamedCommit,
    Selection,
    Totals,
    overlap,
)
from cairn_server.store.tiles import Box


class MemorySnapshot:
    """`store.Snapshot` of dictionaries that nobody changes any more."""

    def __init__(self, state: MemoryMap) -> None:
        self._state = state

    @property
    def head(self) -> Cursor:
        """The state."""
        return self._state.head

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        if seq == 0:
            return first_chain(self.head.log_id, self._state.row.layer.digest())
        return self._state.entries[seq - 1].chain if 0 < seq <= len(self._state.entries) else None

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        return self._state.cells.get(key)

    def cells(
        self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None, box: Box | None = None
    ) -> Iterator[CellRow]:
        """Cells changed after a log entry, in a box, of numbers above `after_key`, at most `limit`; no bodies."""
        found = (cell for key, cell in sorted(self._state.cells.items()) if key > after_key and cell.lm > after_seq)
        for cell in islice((cell for cell in found if _is_in(box, cell)), limit):
            yield replace(cell, body=b"", stamps=b"")

    def hold_cells(self, keys: Collection[CellKey]) -> None:
        """Nothing: they are in memory."""

    def cells_of(self, keys: Collection[CellKey]) -> list[CellRow]:
        """Those of these cells that are stored, without their bodies, by rising number."""
        found = (self._state.cells[key] for key in sorted(keys) if key in self._state.cells)
        return [replace(cell, body=b"", stamps=b"") for cell in found]

    def fingerprint_sum(self, box: Box | None = None) -> Fingerprint:
        """Sum of the fingerprints of all cells, or of those in a box."""
        return sum((cell.fingerprint for cell in self._state.cells.values() if _is_in(box, cell)), ZERO)

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest."""
        seqs = [seq for seq in self._state.touched.get(key, ()) if seq > after_seq]
        return [self._contribution(key, seq) for seq in seqs[-(newest or len(seqs)) :]]

    def named(self, commits: Sequence[CommitId]) -> list[NamedCommit]:
        """State of each of these commits, folded or not, in the same order."""
        return [self._named(commit) for commit in commits]

    def touched_cells(self, commits: Iterable[CommitId]) -> frozenset[CellKey]:
        """Cells in which these commits have evidence that is kept."""
        known = (self._state.commits[commit] for commit in commits if commit in self._state.commits)
        return frozenset(key for kept in known for key in kept.new.diff)

    def diff(self, commit: CommitId, key: CellKey) -> bytes | None:
        """The bytes of a commit's evidence in a cell; None if they are not kept any more."""
        kept = self._state.commits.get(commit)
        return kept.new.diff.get(key) if kept else None

    def marks(self, *, after_seq: int | None, limit: int, box: MarkBox | None = None) -> list[MarkChange]:
        """Marks that changed after a log entry, or those of the map, in a box, oldest first: as `Snapshot.marks`."""
        found = [
            MarkChange(
                seq=kept.unfolded_seq or kept.folded_seq,
                key=MarkKey(kept.new.id, number),
                record=None if kept.unfolded_seq else mark.to_json(),
                amends=kept.new.retracts,
            )
            for kept in self._folded()
            for number, mark in enumerate(kept.new.marks)
            if kept.folded_seq is not None and (box is None or overlap(mark.low_mm, mark.high_mm, box))
        ]
        if after_seq is None:
            found = [change for change in found if change.record is not None]
        found = sorted((change for change in found if change.seq > (after_seq or 0)), key=lambda change: change.seq)
        return [change for change in found if change.seq <= found[min(limit, len(found)) - 1].seq]

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        mine = [kept.new for kept in self._folded() if kept.new.id.author == author]
        return max(((commit.id.n, commit.sha) for commit in mine), default=None)

    def newest_captured_s(self) -> float | None:
        """Latest time at which a commit in the map says credibly that it was captured."""
        times = [
            kept.new.captured_s[1]
            for kept in self._folded()
            if kept.new.captured_s and kept.cells and not kept.unfolded_seq
            if kept.new.captured_s[1] <= kept.received_s + CAPTURED_AHEAD_MAX_S
        ]
        return max(times, default=None)

    def commits_where(self, selection: Selection) -> list[CommitId]:
        """Every commit with evidence that fits and is not retracted, folded or not, in order of arrival."""
        return [
            commit
            for commit, kept in self._state.commits.items()
            if kept.cells and commit not in self._state.retracted and _fits(kept, selection)
        ]

    def pending(self) -> VersionVector:
        """Commits that are kept but not folded, without those that are set aside as damaged."""
        return EMPTY.with_commits(kept.new.id for kept in self._state.waiting())

    def vector_at(self, seq: int) -> VersionVector:
        """Ids of the commits folded at or before a log entry."""
        return EMPTY.with_commits(
            self._state.ids[entry.commit] for entry in self._state.entries[:seq] if entry.kind == ENTRY_FOLD
        )

    def seq_before(self, age_s: float) -> int:
        """Newest log entry with a commit that was folded before an age of the store; 0: there is none."""
        return max((kept.folded_seq or 0 for kept in self._folded() if kept.folded_age_s < age_s), default=0)

    def log(self, *, after_seq: int, limit: int, names_max: int | None = None) -> list[LogEntry]:
        """Log entries, oldest first: the first one, and as many more as name so many commits together at most."""
        found = self._state.entries[after_seq : after_seq + limit]
        entries = [self._log_entry(seq, entry) for seq, entry in enumerate(found, start=after_seq + 1)]
        while names_max is not None and len(entries) > 1 and sum(e.names for e in entries) > names_max:
            entries.pop()
        return entries

    def chained(self, *, after_seq: int, limit: int) -> list[ChainedEntry]:
        """Log entries, oldest first, without what they say."""
        found = enumerate(self._state.entries[after_seq : after_seq + limit], start=after_seq + 1)
        commits = ((seq, entry, self._state.commits[self._state.ids[entry.commit]].new) for seq, entry in found)
        return [ChainedEntry(seq, entry.kind, new.id, new.sha, entry.chain) for seq, entry, new in commits]

    def totals(self) -> Totals:
        """Sizes."""
        cells = [cell for cell in self._state.cells.values() if cell.voxels]
        axes = list(zip(*(cell_of_key(cell.key) for cell in cells), strict=True))
        return Totals(
            cells=len(cells),
            size_bytes=sum(cell.size_bytes for cell in cells),
            history_bytes=sum(cell.history_bytes for cell in cells),
            evidence_bytes=self._state.evidence_bytes(),
            commits=sum(not kept.is_damaged for kept in self._state.commits.values()),
            branches=len(self._state.branches),
            corner_cells=((min(axes[0]), min(axes[1]), min(axes[2])), (max(axes[0]), max(axes[1]), max(axes[2])))
            if cells
            else None,
        )

    def _named(self, commit: CommitId) -> NamedCommit:
        is_retracted = commit in self._state.retracted
        kept = self._state.commits.get(commit)
        if kept is None or kept.folded_seq is None:
            return NamedCommit(commit, is_retracted=is_retracted)
        return NamedCommit(commit, True, kept.is_gone, is_retracted, kept.cells, kept.new.bricks or kept.new.size_bytes)

    def _folded(self) -> Iterator[Kept]:
        return (kept for kept in self._state.commits.values() if kept.folded_seq is not None)

    def _contribution(self, key: CellKey, seq: int) -> Contribution:
        entry = self._state.entries[seq - 1]
        commit = self._state.ids[entry.commit]
        new = self._state.commits[commit].new
        return Contribution(seq, entry.kind, commit, len(new.diff[key]), new.epoch)

    def _log_entry(self, seq: int, entry: Entry) -> LogEntry:
        kept = self._state.commits[self._state.ids[entry.commit]]
        meta = json.loads(kept.new.text) if kept.new.text else {}
        scans = meta.get("scans")
        return LogEntry(
            seq=seq,
            kind="+" if entry.kind == ENTRY_FOLD else "-",
            id=str(kept.new.id),
            sha=kept.new.sha.hex(),
            size_bytes=kept.new.size_bytes,
            cells=kept.cells,
            captured_s=kept.new.captured_s,
            retracts=[str(target) for target in kept.new.retracts],
            parent=meta.get("parent"),
            seen=meta.get("seen"),
            place_m=scans[-1]["t_map_rig"] if scans else None,
            via=kept.new.via,
            note=meta.get("note", ""),
            pushed_s=kept.received_s,
        )


def _is_in(box: Box | None, cell: CellRow) -> bool:
    return box is None or all(a <= n <= b for a, n, b in zip(box[0], cell_of_key(cell.key), box[1], strict=True))


def _fits(kept: Kept, selection: Selection) -> bool:
    first_s, last_s = kept.new.captured_s or (float("inf"), float("-inf"))
    return (
        selection.robot in (None, kept.new.id.author.robot)
        and selection.rig in (None, kept.new.rig)
        and selection.pushed_s[0] <= kept.received_s <= selection.pushed_s[1]
        and selection.captured_s[0] <= last_s
        and first_s <= selection.captured_s[1]
    )
