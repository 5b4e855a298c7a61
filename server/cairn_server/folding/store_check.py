"""Check of a whole store, map by map: every finding is something that is not as it should be.

    log       every chain follows from the one before, the head is the last, the vector names what was folded
    commits   every diff that is kept decodes, and all of a commit together have its SHA-256
    cells     bytes, digest, fingerprint and size agree; and where every diff is kept, the cell is their sum

Sums are compared by fingerprint, which adds as evidence does, so nothing is merged.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from cairn_map.codec.cell_code import DecodedCell
from cairn_map.commits.commit import commit_sha
from cairn_map.commits.cursor import ENTRY_FOLD, next_chain
from cairn_map.commits.version_vector import EMPTY
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.fingerprint import ZERO, Fingerprint, fingerprint
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_server.folding.cells_at_rest import decode_stored, rebuilt_cell, stored_evidence
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, ChainedEntry, MapRow, StoredCommit

PAGE = 500
PENDING_BYTES_MAX = 256 << 20
"""Most bytes of the pending commits that are checked; folding checks each of them in any case."""
Report = Callable[[int, int], None]
"""Callback for progress: steps done, and all steps."""


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

    def __str__(self) -> str:
        return f"{self.map}: {self.what}"


@dataclass(slots=True)
class MapCheck:
    """Result of checking one map."""

    commits: int = 0
    cells: int = 0
    not_kept: int = 0
    """Count of the commits whose evidence was dropped; they cannot be checked."""
    findings: list[Finding] = field(default_factory=list)


def check_map(store: Store, row: MapRow, report: Report) -> MapCheck:
    """Check the log, the commits and the cells of one map."""
    checked = MapCheck()
    with store.snapshot(row) as snapshot:
        keys = [cell.key for cell in snapshot.cells()]
        total = snapshot.totals().commits + len(keys)
    known: dict[bytes, Fingerprint] = {}
    for commit in _commits(store, row, checked):
        checked.commits += 1
        checked.findings += _of_commit(row, commit, known, checked)
        report(checked.commits, total)
    for key in keys:
        with store.snapshot(row) as snapshot:
            checked.findings += _of_cell(snapshot, row, key, known)
        checked.cells += 1
        report(checked.commits + checked.cells, total)
    return checked


def _commits(store: Store, row: MapRow, checked: MapCheck) -> Iterator[StoredCommit]:
    """Every folded commit once, in the order of the log, which is checked on the way; then the pending ones."""
    with store.snapshot(row) as snapshot:
        head = snapshot.head
        chain = snapshot.chain_at(0) or b""
    vector, seq = EMPTY, 0
    while page := _log_page(store, row, after_seq=seq):
        for entry in page:
            if entry.seq > head.cursor.seq:  # folded while we read
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
                    yield commit
        if seq >= head.cursor.seq or page[-1].seq > head.cursor.seq:
            break
    if (seq, chain) != (head.cursor.seq, head.cursor.chain):
        checked.findings.append(Finding(row.name, f"log: it ends at {seq}, the head is {head.cursor}"))
    if vector != head.vector:
        checked.findings.append(Finding(row.name, "log: the vector does not name what was folded"))
    waiting = store.pending(row, limit=PAGE, size_bytes_max=PENDING_BYTES_MAX)
    yield from (commit for commit in waiting if commit.due_from is None)


def _log_page(store: Store, row: MapRow, *, after_seq: int) -> list[ChainedEntry]:
    with store.snapshot(row) as snapshot:
        return snapshot.chained(after_seq=after_seq, limit=PAGE)


def _of_commit(
    row: MapRow, commit: StoredCommit, known: dict[bytes, Fingerprint], checked: MapCheck
) -> Iterator[Finding]:
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
        known[hashlib.sha256(body).digest()] = _sums(decoded, key)
    if commit_sha(commit.text, digests) != commit.sha:
        yield Finding(row.name, f"commit {commit.id} does not have its SHA-256")


def _of_cell(snapshot: Snapshot, row: MapRow, key: CellKey, known: dict[bytes, Fingerprint]) -> Iterator[Finding]:
    name = cell_of_key(key)
    try:
        stored = snapshot.cell(key)
    except CairnError as exc:
        yield Finding(row.name, f"cell {name}: {exc.message}")
        return
    if stored is None:
        return
    try:
        stored_evidence(stored)
        expected = _sum_of_diffs(snapshot, key, known)
        if stored.gone_seq or expected is None or expected == stored.fingerprint:
            return
        complaint = f"cell {name} is not the sum of its commits"
    except DamagedDataError as exc:
        complaint = exc.message
    try:
        yield Finding(row.name, complaint, stored, rebuilt_cell(snapshot, stored, row.geometry))
    except DamagedDataError as exc:
        yield Finding(row.name, f"{complaint}; it cannot be rebuilt from the log: {exc.message}", stored)


def _sum_of_diffs(snapshot: Snapshot, key: CellKey, known: dict[bytes, Fingerprint]) -> Fingerprint | None:
    """Fingerprint of a cell as the log says; None if evidence was dropped or is damaged."""
    total = ZERO
    for entry in snapshot.contributions(key, after_seq=0):
        body = snapshot.diff(entry.commit, key)
        if body is None:
            return None
        sums = known.get(hashlib.sha256(body).digest())
        if sums is None:
            try:
                sums = _sums(decode_stored(key, body), key)
            except DamagedDataError:
                return None
        total = total + sums if entry.kind == ENTRY_FOLD else total - sums
    return total


def _sums(decoded: DecodedCell, key: CellKey) -> Fingerprint:
    return fingerprint(decoded.evidence, key)
