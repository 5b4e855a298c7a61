"""Folding: pending commits become log entries and new cells. Pure but for reading the store.

    fold a commit                 entry +     its diff is added
    retract of a folded commit    entry -     its diff is subtracted, once per target for ever
    a commit retracted before it came   both, one after the other (SYNC.md rule 11)

A group of commits is folded at once, so that a cell is decoded and encoded once for all of them.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from cairn_map.brick_cell import BrickCell
from cairn_map.cell_code import decode_cell, encode_cell
from cairn_map.cursor import ENTRY_FOLD, ENTRY_UNFOLD, Cursor, next_chain
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence import Evidence
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import CellKey, cell_of_key
from cairn_map.ids import CommitId
from cairn_server.store import CellRow, Entry, Fold, Head, MapRow, Store, StoredCommit

CACHE_BYTES = 512 << 20
"""Memory for cells that were changed lately."""


@dataclass(slots=True)
class CellCache:
    """The cells changed last, in the form that adds fast; valid for one map at one head."""

    cells: OrderedDict[CellKey, BrickCell] = field(default_factory=OrderedDict)

    def trim(self, limit_bytes: int) -> None:
        """Forget the cells that were not changed for longest."""
        total = sum(cell.size_bytes for cell in self.cells.values())
        while self.cells and total > limit_bytes:
            _, cell = self.cells.popitem(last=False)
            total -= cell.size_bytes


def fold_pending(store: Store, row: MapRow, cache: CellCache, *, limit: int) -> int:
    """Fold up to `limit` pending commits; returns how many were.

    Raises:
        DamagedDataError: a cell or a diff at rest is not sound.
    """
    commits = store.pending(row, limit=limit)
    if not commits:
        return 0
    with store.snapshot(row) as snapshot:
        head = snapshot.head
    try:
        fold = plan_fold(store, row, head, commits, cache)
        written = store.fold(row, fold)
    except CairnError:
        cache.cells.clear()
        raise
    if not written:  # another folder was faster; its result is as good as ours
        cache.cells.clear()
        return 0
    cache.trim(CACHE_BYTES)
    return len(commits)


def plan_fold(store: Store, row: MapRow, head: Head, commits: Sequence[StoredCommit], cache: CellCache) -> Fold:
    """What folding these commits on top of `head` changes."""
    entries: list[Entry] = []
    retracted: list[CommitId] = []
    last_change: dict[CellKey, int] = {}
    folded: dict[CommitId, StoredCommit] = {}
    chain = head.cursor.chain

    def enter(kind: bytes, commit: StoredCommit) -> None:
        nonlocal chain
        chain = next_chain(chain, kind, commit.id, commit.sha)
        entries.append(Entry(kind=kind, commit=commit.number, chain=chain))
        _apply(store, row, kind, commit, cache)
        last_change.update(dict.fromkeys(commit.diff, head.cursor.seq + len(entries)))

    for commit in commits:
        enter(ENTRY_FOLD, commit)
        folded[commit.id] = commit
        if commit.id in retracted or store.is_retracted(row, commit.id):
            enter(ENTRY_UNFOLD, commit)
        for target in commit.retracts:
            if target in retracted or store.is_retracted(row, target):
                continue
            retracted.append(target)
            known = folded.get(target) or store.folded(row, target)
            if known is not None:
                enter(ENTRY_UNFOLD, known)
    return Fold(
        base=head.cursor,
        head=Cursor(head.cursor.log_id, head.cursor.seq + len(entries), chain),
        vector=head.vector.with_commits(folded),
        entries=tuple(entries),
        cells=_cell_rows(row, last_change, cache),
        retracted=tuple(retracted),
    )


def _apply(store: Store, row: MapRow, kind: bytes, commit: StoredCommit, cache: CellCache) -> None:
    for key, body in commit.diff.items():
        diff = decode_cell(body).evidence
        cell = _cell(store, row, key, cache)
        if kind == ENTRY_FOLD:
            cell.merge(diff)
        else:
            cell.unmerge(diff)


def _cell(store: Store, row: MapRow, key: CellKey, cache: CellCache) -> BrickCell:
    cell = cache.cells.get(key)
    if cell is None:
        cell = BrickCell(row.geometry)
        with store.snapshot(row) as snapshot:
            stored = snapshot.cell(key)
        if stored is not None:
            cell.merge(stored_evidence(stored))
        cache.cells[key] = cell
    cache.cells.move_to_end(key)
    return cell


def stored_evidence(stored: CellRow) -> Evidence:
    """The evidence of a cell at rest.

    Raises:
        DamagedDataError: kind `damaged_store`: its digest is not that of its bytes.
    """
    decoded = decode_cell(stored.body)
    if decoded.digest != stored.digest:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(stored.key)} at rest does not have its digest")
    return decoded.evidence


def _cell_rows(row: MapRow, last_change: Mapping[CellKey, int], cache: CellCache) -> tuple[CellRow, ...]:
    rows: list[CellRow] = []
    for key, lm in sorted(last_change.items()):
        evidence = cache.cells[key].packed()
        encoded = encode_cell(key, evidence, row.geometry)
        rows.append(
            CellRow(
                key=key,
                lm=lm,
                digest=encoded.digest,
                fingerprint=fingerprint(evidence, key),
                voxels=len(evidence),
                body=encoded.data,
                size_bytes=len(encoded.data),
            )
        )
    return tuple(rows)
