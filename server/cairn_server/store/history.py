"""Identity of a map's history: the log's chain at an entry, which proves every entry up to it.

A store may be restored, or fail over to a copy that lost its newest entries, while a server remembers more than is
left. Then entries are numbered again, and a cell reaches the same digest by other commits. So a cached value of a
state is named by the chain at its entry, and code that goes on from a state asks first whether it is still in the log.
"""

from cairn_map.commits.cursor import Cursor
from cairn_server.store.store import Snapshot


def is_proven(cursor: Cursor, snapshot: Snapshot) -> bool:
    """True if a cursor is a state of this log, at or before the snapshot's (SYNC.md rule 1)."""
    head = snapshot.head.cursor
    return cursor.seq <= head.seq and snapshot.chain_at(cursor.seq) == cursor.chain
