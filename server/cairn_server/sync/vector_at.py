"""Which ids were folded at a cursor that is not the newest; and boxes of cells."""

from collections.abc import Callable

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence.grid import cell_from_text, cell_key
from cairn_server.store.store import Snapshot

ENTRIES_MAX = 10_000
"""Who asks for a vector has just got its cursor; further back nobody looks."""


def vector_at(snapshot: Snapshot, cursor: Cursor) -> VersionVector:
    """The version vector at a cursor: that of the head without what was folded since.

    Raises:
        ConflictError: kind `other_log`: the cursor is another server's.
        NotFoundError: kind `no_cursor`: it is not proven by the log, or too far back.
    """
    head = snapshot.head
    if cursor.log_id != head.cursor.log_id:
        raise ConflictError("other_log", "the cursor belongs to another server's log; start without one")
    since = head.cursor.seq - cursor.seq
    if not 0 <= since <= ENTRIES_MAX or snapshot.chain_at(cursor.seq) != cursor.chain:
        raise NotFoundError("no_cursor", "the log has no such cursor, or not of late; ask for the cell again")
    entries = snapshot.log(after_seq=cursor.seq, limit=ENTRIES_MAX)
    folded = EMPTY.with_commits(commit_id_from_text(entry.id) for entry in entries if entry.kind == "+")
    return head.vector.minus(folded)


def box_from_text(text: str) -> Callable[[tuple[int, int, int]], bool]:
    """Whether a cell lies in the box written `i0,j0,k0,i1,j1,k1`, both corners included.

    Raises:
        BadInputError: kind `bad_box`, or of a cell that cannot be.
    """
    parts = text.split(",")
    low, high = cell_from_text(",".join(parts[:3])), cell_from_text(",".join(parts[3:]))
    for corner in (low, high):
        cell_key(corner)
    if any(first > last for first, last in zip(low, high, strict=True)):
        raise BadInputError("bad_box", f"a box is i0,j0,k0,i1,j1,k1 with the lower corner first, got {text!r}")
    return lambda cell: all(a <= n <= b for a, n, b in zip(low, cell, high, strict=True))
