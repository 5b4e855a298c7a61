"""What must hold of a store after a crash: everything that was acknowledged, and a map that is the sum of it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import apsw
from tests.fixtures.map.made import as_dict
from tests.fixtures.server.pushes import Cells, read
from tests.naive import evidence as naive_evidence

from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import next_chain
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.errors import CairnError
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.history import head_of
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, StoredCommit


@dataclass(slots=True)
class Verdict:
    """What is wrong with a store, if anything; `lost` counts acknowledged commits."""

    lost: list[CommitId] = field(default_factory=list)
    corrupt: list[str] = field(default_factory=list)
    """What SQLite itself complains of."""
    wrong: list[str] = field(default_factory=list)
    """What does not agree with the commits that are there."""

    @property
    def is_sound(self) -> bool:
        """Whether everything holds."""
        return not (self.lost or self.corrupt or self.wrong)


def verdict_on(folder: Path, name: str, *, acked: Iterable[CommitId], offered: Mapping[CommitId, Commit]) -> Verdict:
    """Open the store and look at everything.

    Args:
        folder: of the store.
        name: of its only map; may be missing if nothing was acknowledged.
        acked: commits that the store said to keep.
        offered: all that were ever offered to it: with those not acknowledged it may do what it likes, but wholly.
    """
    found = Verdict()
    expected = list(acked)
    try:
        found.corrupt += integrity(folder / FILE_NAME)
        store = SqliteStore(folder)
    except (apsw.Error, CairnError) as exc:
        found.corrupt.append(f"it does not open: {exc}")
        found.lost += expected
        return found
    try:
        rows = [row for row in store.maps() if row.name == name]
        if rows:
            compare(store, rows[0], expected, offered, found)
        else:
            found.lost += expected
    except CairnError as exc:
        found.wrong.append(f"{exc.kind}: {exc.message}")
    finally:
        store.close()
    return found


def integrity(path: Path) -> list[str]:
    """What SQLite finds wrong with a file."""
    connection = apsw.Connection(str(path))
    try:
        found = [str(line) for (line,) in connection.execute("PRAGMA integrity_check") if line != "ok"]
        return found + [f"foreign key: {line}" for line in connection.execute("PRAGMA foreign_key_check")]
    finally:
        connection.close()


def compare(
    store: Store, row: MapRow, acked: list[CommitId], offered: Mapping[CommitId, Commit], found: Verdict
) -> None:
    """Compare a map with the commits that were acknowledged and offered; `found` gets what is wrong."""
    pending = store.pending(row, limit=100_000, size_bytes_max=1 << 40)
    with store.snapshot(row) as snapshot:
        folded = list(head_of(snapshot).vector)
        entries = snapshot.log(after_seq=0, limit=1_000_000)
        chain = [snapshot.chain_at(n) for n in range(len(entries) + 1)]
        head = snapshot.head
    steps = [
        next_chain(before or b"", entry.kind.encode(), commit_id_from_text(entry.id), bytes.fromhex(entry.sha))
        for before, entry in zip(chain[:-1], entries, strict=True)
    ]
    if steps != chain[1:] or chain[-1] != head.chain or head.seq != len(entries):
        found.wrong.append("the chain is not whole")
    if sorted(folded) != sorted(commit_id_from_text(entry.id) for entry in entries if entry.kind == "+"):
        found.wrong.append("the vector is not what the log says")
    there = {commit: store.folded(row, commit) for commit in folded} | {commit.id: commit for commit in pending}
    found.lost += [commit for commit in acked if not _is_whole(there.get(commit), offered[commit])]
    found.wrong += [
        f"{commit} is not what was offered" for commit in there if not _is_whole(there[commit], offered[commit])
    ]
    if cells_of(store, row) != sum_of(offered[commit] for commit in folded):
        found.wrong.append("the cells are not the sum of the folded commits")
    cache = CellCache(row.geometry)
    while fold_pending(store, row, cache, limit=64):
        pass
    if cells_of(store, row) != sum_of(offered[commit] for commit in there):
        found.wrong.append("after folding, the cells are not the sum of all commits")


def _is_whole(stored: StoredCommit | None, commit: Commit) -> bool:
    return stored is not None and (stored.sha, stored.text, stored.diff) == (
        commit.sha,
        commit.text,
        dict(commit.cells),
    )


def cells_of(store: Store, row: MapRow) -> Cells:
    """The map's cells with evidence."""
    with store.snapshot(row) as snapshot:
        found = [snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels]
    return read({cell.key: cell.body for cell in found if cell})


def sum_of(commits: Iterable[Commit]) -> Cells:
    """As `pushes.sum_of`, for many commits of few bodies."""
    kept = list(commits)
    retracted = {target for commit in kept for target in commit.meta.retracted_ids}
    total: Cells = {}
    for commit in kept:
        for key, body in commit.cells.items() if commit.id not in retracted else ():
            total[key] = naive_evidence.merged(total.get(key, {}), evidence_of(body))
    return {key: evidence for key, evidence in total.items() if evidence}


@lru_cache(maxsize=1024)
def evidence_of(body: bytes) -> naive_evidence.Evidence:
    """A cell of a commit as a dictionary."""
    return as_dict(decode_cell(body).evidence)
