"""Check of a whole store, map by map: every finding is something that is not as it should be.

    log       every chain follows from the one before, the head is the last, stored vectors name what was folded
    commits   every diff that is kept decodes, and all of a commit together have its SHA-256
    sums      totals and tiles are those of the cells
    marks     those of the map are those of its commits that are not taken out; attachments have their SHA-256
    cells     bytes, digest, fingerprint and size agree; and where every diff is kept, the cell is their sum

Sums are compared by fingerprint, which adds as evidence does, so nothing is merged.
"""

import hashlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
from pydantic import ValidationError

from cairn_map.commits.commit import CommitMeta, commit_sha, version_of_meta
from cairn_map.commits.cursor import ENTRY_FOLD, next_chain
from cairn_map.commits.ids import CommitId
from cairn_map.commits.mark import Mark, MarkKey
from cairn_map.commits.version_vector import EMPTY
from cairn_map.epochs.cell_history import row_fingerprint
from cairn_map.epochs.epoch import Epoch
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.kernels.morton_kernels import UInts
from cairn_server.folding.cells_at_rest import check_stored, decode_stored, rebuilt_cell
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, ChainedEntry, MapRow, MarkChange, StoredCommit
from cairn_server.store.tiles import corners_of, first_and_last_key, tile_of

PAGE = 500
PENDING_BYTES_MAX = 256 << 20
"""Most bytes of the pending commits that are checked; folding checks each of them in any case."""
MISSING_MAX = 1_000_000
"""Most missing attachments that are counted."""
Report = Callable[[int, int], None]
"""Callback for progress: steps done, and all steps."""
KnownDiffs = dict[tuple[bytes, Epoch], Fingerprint]
"""Fingerprints that diffs add to their cells, by the SHA-256 of their bytes and the epoch of their commit."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Damage found in a store."""

    map: str
    what: str
    """Description for people."""
    cell: CellRow | None = None
    """Cell that it is about; None: no single cell."""
    sound: CellRow | None = None
    """Same cell rebuilt from the log; None where the log cannot."""
    attachment: bytes | None = None
    """SHA-256 of the attachment that it is about."""
    is_sum: bool = False
    """True if a sum or a vector is wrong that the store keeps besides cells and log, and can compute again."""

    def __str__(self) -> str:
        return f"{self.map}: {self.what}"


@dataclass(slots=True)
class MapCheck:
    """Result of checking one map."""

    commits: int = 0
    cells: int = 0
    not_kept: int = 0
    """Count of the commits whose evidence was dropped; they cannot be checked."""
    attachments: int = 0
    missing_attachments: int = 0
    """Count of the attachments that marks name and that did not come, or not whole."""
    findings: list[Finding] = field(default_factory=list)


def check_map(store: Store, row: MapRow, report: Report) -> MapCheck:
    """Check the log, the commits and the cells of one map.

    Raises:
        AwayError: some of it is in the object store, which does not answer: it is not known to be damaged.
    """
    checked = MapCheck()
    with store.snapshot(row) as snapshot:
        keys = [cell.key for cell in snapshot.cells()]
        total = snapshot.totals().commits + len(keys)
    known: KnownDiffs = {}
    marks: dict[CommitId, tuple[Mark, ...]] = {}
    for commit in _commits(store, row, checked, marks):
        checked.commits += 1
        checked.findings += _of_commit(row, commit, known, checked)
        report(checked.commits, total)
    for key in keys:
        with store.snapshot(row) as snapshot:
            checked.findings += _of_cell(snapshot, row, key, known)
        checked.cells += 1
        report(checked.commits + checked.cells, total)
    checked.findings += _of_marks(store, row, marks)
    checked.findings += _of_attachments(store, row, checked)
    # Of damaged cells the rows may be wrong, so that the sums cannot be judged by them.
    if not any(finding.cell for finding in checked.findings):
        with store.snapshot(row) as snapshot:
            checked.findings += _of_sums(snapshot, row)
    return checked


def _commits(
    store: Store, row: MapRow, checked: MapCheck, marks: dict[CommitId, tuple[Mark, ...]]
) -> Iterator[StoredCommit]:
    """Every folded commit once, in the order of the log, which is checked on the way; then the pending ones.

    The marks that folded ones brought are put into `marks`.
    """
    with store.snapshot(row) as snapshot:
        head = snapshot.head
        chain = snapshot.chain_at(0) or b""
    vector, seq = EMPTY, 0
    while page := _log_page(store, row, after_seq=seq):
        for entry in page:
            if entry.seq > head.seq:  # folded while we read
                continue
            if entry.seq != seq + 1:
                checked.findings.append(Finding(row.name, f"log: entry {seq + 1} is not there"))
            seq = entry.seq
            chain = next_chain(chain, entry.kind, entry.commit, entry.sha)
            if chain != entry.chain:
                checked.findings.append(Finding(row.name, f"log: entry {seq} does not continue the chain"))
                chain = entry.chain
            if entry.kind == ENTRY_FOLD:
                vector = vector.with_commits([entry.commit])
                commit = store.folded(row, entry.commit)
                if commit is not None:
                    brought = _marks_of(commit)
                    if brought:
                        marks[commit.id] = brought
                    yield commit
        with store.snapshot(row) as snapshot:
            is_stated = snapshot.vector_at(seq) == vector
        if not is_stated:
            checked.findings.append(Finding(row.name, f"vector at {seq}: it does not name the commits", is_sum=True))
        if seq >= head.seq or page[-1].seq > head.seq:
            break
    if (seq, chain) != (head.seq, head.chain):
        checked.findings.append(Finding(row.name, f"log: it ends at {seq}, the head is {head}"))
    waiting = store.pending(row, limit=PAGE, size_bytes_max=PENDING_BYTES_MAX)
    yield from (commit for commit in waiting if commit.due_from is None)


def _marks_of(commit: StoredCommit) -> tuple[Mark, ...]:
    """Marks that a commit brought; none of one whose meta is damaged, which its SHA-256 shows."""
    try:
        return CommitMeta.model_validate_json(commit.text, strict=True).marks if b'"marks"' in commit.text else ()
    except ValidationError:
        return ()


def _of_marks(store: Store, row: MapRow, brought: dict[CommitId, tuple[Mark, ...]]) -> Iterator[Finding]:
    """Marks of the map that are not those of its commits, and marks of commits that the map lacks.

    A server that works meanwhile folds and takes out more than was read of the log: only what was there, and is there
    still, is said to be lacking, and of what came since each mark is compared with its commit.
    """
    with store.snapshot(row) as snapshot:
        listed = {change.key: change.record for change in _listed(snapshot)}
        out = {named.id for named in snapshot.named(list(brought)) if named.is_retracted}
    for commit, marks in brought.items():
        for number, mark in enumerate(marks if commit not in out else ()):
            if listed.pop(key := MarkKey(commit, number), None) != mark.to_json():
                yield Finding(row.name, f"mark {key} is not in the map as its commit has it")
    for key, record in listed.items():
        found = None if key.commit in out else store.folded(row, key.commit)
        own = _marks_of(found) if found is not None else ()
        if key.number >= len(own) or own[key.number].to_json() != record:
            yield Finding(row.name, f"mark {key} is in the map, and of no commit in it")


def _listed(snapshot: Snapshot) -> Iterator[MarkChange]:
    """Marks of a map, page by page."""
    after: int | None = None
    while page := snapshot.marks(after_seq=after, limit=PAGE):
        # After None only those that are in the map; after an entry those, too, that were taken out since.
        yield from (change for change in page if change.record is not None)
        after = page[-1].seq


def _of_attachments(store: Store, row: MapRow, checked: MapCheck) -> Iterator[Finding]:
    """Attachments whose bytes are not those that marks name."""
    for attachment in store.attachments.whole(row.number):
        checked.attachments += 1
        if hashlib.sha256(store.attachments.data(row.number, attachment.sha)).digest() != attachment.sha:
            what = f"attachment {attachment.sha256} does not have its SHA-256"
            yield Finding(row.name, what, attachment=attachment.sha)
    checked.missing_attachments = len(store.attachments.wanted(row.number, robot=None, limit=MISSING_MAX))


def _of_sums(snapshot: Snapshot, row: MapRow) -> Iterator[Finding]:
    """Sums over cells that the store keeps and that are not those of its cells."""
    cells = list(snapshot.cells())
    known = [cell for cell in cells if cell.voxels]
    totals, sizes = snapshot.totals(), sum(cell.size_bytes for cell in known)
    history_bytes = sum(cell.history_bytes for cell in known)
    corners = corners_of(_numbers({tile_of(cell.key) for cell in known}), lambda _: [cell.key for cell in known])
    found = totals.cells, totals.size_bytes, totals.history_bytes, totals.corner_cells
    if found != (len(known), sizes, history_bytes, corners):
        yield Finding(row.name, f"totals: {totals} are not those of its {len(known)} cells", is_sum=True)
    if snapshot.fingerprint_sum() != sum((cell.fingerprint for cell in cells), ZERO):
        yield Finding(row.name, "totals: the fingerprint is not the sum of its cells'", is_sum=True)
    for tile, group in groupby(cells, key=lambda cell: tile_of(cell.key)):
        rows = list(group)
        first, last = first_and_last_key(tile)
        box = cell_of_key(first), cell_of_key(last)
        newest = max(cell.lm for cell in rows)
        is_newest = list(snapshot.cells(after_seq=newest - 1, box=box)) != []
        if snapshot.fingerprint_sum(box) != sum((cell.fingerprint for cell in rows), ZERO) or not is_newest:
            name = cell_of_key(rows[0].key)
            yield Finding(row.name, f"tile of cell {name}: it has not the sums of its cells", is_sum=True)


def _numbers(numbers: Collection[int]) -> UInts:
    return np.array(sorted(numbers), np.uint64)


def _log_page(store: Store, row: MapRow, *, after_seq: int) -> list[ChainedEntry]:
    with store.snapshot(row) as snapshot:
        return snapshot.chained(after_seq=after_seq, limit=PAGE)


def _of_commit(row: MapRow, commit: StoredCommit, known: KnownDiffs, checked: MapCheck) -> Iterator[Finding]:
    if commit.gone:
        checked.not_kept += 1
        return
    digests: list[bytes] = []
    for key, body in commit.diff.items():
        try:
            decoded = decode_stored(key, body)
        except DamagedDataError as exc:
            yield Finding(row.name, f"commit {commit.id}: {exc.message}")
            return
        digests.append(decoded.digest)
        known[hashlib.sha256(body).digest(), commit.epoch] = row_fingerprint(
            decoded.evidence, commit.epoch, key, layer_word=row.layer.word
        )
    if commit_sha(commit.text, digests, version=version_of_meta(commit.text)) != commit.sha:
        yield Finding(row.name, f"commit {commit.id} does not have its SHA-256")


def _of_cell(snapshot: Snapshot, row: MapRow, key: CellKey, known: KnownDiffs) -> Iterator[Finding]:
    name = cell_of_key(key)
    try:
        stored = snapshot.cell(key)
    except AwayError:
        raise
    except CairnError as exc:
        yield Finding(row.name, f"cell {name}: {exc.message}")
        return
    if stored is None:
        return
    try:
        check_stored(stored, row.layer)
        expected = _sum_of_diffs(snapshot, row, key, known)
        if stored.gone_seq or expected is None or expected == stored.fingerprint:
            return
        complaint = f"cell {name} is not the sum of its commits"
    except DamagedDataError as exc:
        complaint = exc.message
    try:
        yield Finding(row.name, complaint, stored, rebuilt_cell(snapshot, stored, row.layer))
    except DamagedDataError as exc:
        yield Finding(row.name, f"{complaint}; it cannot be rebuilt from the log: {exc.message}", stored)


def _sum_of_diffs(snapshot: Snapshot, row: MapRow, key: CellKey, known: KnownDiffs) -> Fingerprint | None:
    """Fingerprint of a cell as the log says; None if evidence was dropped or is damaged."""
    total = ZERO
    for entry in snapshot.contributions(key, after_seq=0):
        body = snapshot.diff(entry.commit, key)
        if body is None:
            return None
        sums = known.get((hashlib.sha256(body).digest(), entry.epoch))
        if sums is None:
            try:
                evidence = decode_stored(key, body).evidence
            except DamagedDataError:
                return None
            sums = row_fingerprint(evidence, entry.epoch, key, layer_word=row.layer.word)
        total = total + sums if entry.kind == ENTRY_FOLD else total - sums
    return total
