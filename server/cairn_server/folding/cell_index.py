"""The cell index, a page at a time."""

from dataclasses import dataclass

from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import CellKey, cell_from_text, cell_key, cell_of_key
from cairn_map.wire.messages import INDEX_PAGE, CellEntry
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow
from cairn_server.store.tiles import Box


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexPage:
    """Entries that a client asks for."""

    after: CellKey | None = None
    """Number of the cell before the page; None: from the first cell on."""
    limit: int = INDEX_PAGE
    box: Box | None = None
    """Box of the cells; None: all."""
    is_hottest_asked: bool = False
    """True if each entry has its cell's hottest temperature."""
    is_held_asked: bool = False
    """True if each entry has the newest log entry whose evidence is still in its cell."""


FIRST_PAGE = IndexPage()
TOUCHES_MAX = 32
"""Newest log entries of a cell that are looked at."""


def entries_of(snapshot: Snapshot, page: IndexPage) -> list[CellEntry]:
    """Entries of the cells that were ever touched, emptied ones included, by rising number; one page of them."""
    rows = snapshot.cells(after_key=-1 if page.after is None else page.after, limit=page.limit, box=page.box)
    return [_asked_entry(snapshot, row, page) for row in rows]


def _entry(row: CellRow) -> CellEntry:
    return CellEntry(
        cell=cell_of_key(row.key),
        size_bytes=row.size_bytes,
        digest=row.digest.hex(),
        lm=row.lm,
        fingerprint=row.fingerprint.hex(),
        voxels=row.voxels,
    )


def _asked_entry(snapshot: Snapshot, row: CellRow, page: IndexPage) -> CellEntry:
    more: dict[str, float | None] = {}
    if page.is_hottest_asked:
        more["hottest_k"] = row.hottest_k
    if page.is_held_asked:
        more["held_lm"] = _held_lm(snapshot, row.key)
    return _entry(row).model_copy(update=more)


def _held_lm(snapshot: Snapshot, key: CellKey) -> int | None:
    """Newest log entry whose evidence no later one took out; None: there is none among the newest `TOUCHES_MAX`."""
    newest = snapshot.contributions(key, after_seq=0, newest=1)
    if newest and newest[0].kind == ENTRY_FOLD:  # nearly always
        return newest[0].seq
    out: set[CommitId] = set()
    for touch in reversed(snapshot.contributions(key, after_seq=0, newest=TOUCHES_MAX)):
        if touch.kind != ENTRY_FOLD:
            out.add(touch.commit)
        elif touch.commit not in out:
            return touch.seq
    return None


def box_from_text(text: str) -> Box:
    """Lowest and highest cell of the box written `i0,j0,k0,i1,j1,k1`, both corners included.

    Raises:
        BadInputError: kind `bad_box`, or of a cell that cannot be.
    """
    parts = text.split(",")
    low, high = cell_from_text(",".join(parts[:3])), cell_from_text(",".join(parts[3:]))
    for corner in (low, high):
        cell_key(corner)
    if any(first > last for first, last in zip(low, high, strict=True)):
        raise BadInputError("bad_box", f"a box is i0,j0,k0,i1,j1,k1 with the lower corner first, got {text!r}")
    return low, high
