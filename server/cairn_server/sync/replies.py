"""Which commits no restore can lose any more: without backups, those folded longer ago than a setting of time."""

import threading
import time

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import ConflictError, NotFoundError
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import MapRow

ENTRIES_MAX = 10_000
"""Who asks for a vector has just got its cursor; further back nobody looks."""

KEEP_S = 10.0
"""The answer is kept this long: it only ever grows, so an old one is safe."""


class StableVectors:
    """Stable vectors of all maps, computed at most every few seconds."""

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._keep_s = min(KEEP_S, after_s)
        self._lock = threading.Lock()
        self._kept: dict[int, tuple[float, VersionVector]] = {}

    def of(self, row: MapRow, snapshot: Snapshot) -> VersionVector:
        """The stable vector of the map in this snapshot."""
        now_s = time.time()
        with self._lock:
            made_s, vector = self._kept.get(row.number, (float("-inf"), EMPTY))
            if now_s - made_s < self._keep_s and made_s <= now_s:
                return vector
            vector = snapshot.folded_before(now_s - self._after_s)
            self._kept[row.number] = (now_s, vector)
            return vector


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
