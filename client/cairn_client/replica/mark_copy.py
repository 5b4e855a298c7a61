"""Copy of a map's marks in a robot's folder: it goes on from where it was, and is read without a link.

    marks-cursor    state of the map up to which the copy goes; none: no program asked for marks here
    mark KEY        an entry as the server sent it, JSON

It is the server's word. What a robot marked itself, and is not in it yet, is in the outbox.
"""

import logging

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.wire.mark_messages import MarkEntry, MarkPage

CURSOR, ENTRY = "marks-cursor", "mark "
"""Key of the cursor, and first letters of those of entries, among the texts of the folder."""
MARKS_MAX = 1 << 17
"""Most marks in a copy, some 100 MB with the longest texts; what came beyond them is left out."""

log = logging.getLogger(__name__)


class MarkCopy:
    """Marks of the server's map as they were at some state; every method may be called from any thread."""

    def __init__(self, store: ReplicaStore) -> None:
        self._store = store
        self._is_full = False
        """True once it was logged that marks are left out."""

    @property
    def cursor(self) -> str | None:
        """State up to which the copy goes; None: there is none."""
        return self._store.get(CURSOR)

    def take(self, page: MarkPage) -> None:
        """Take a page that goes on from the copy's cursor; all of it or nothing.

        Raises:
            UnreachableError: kind `store_failed`.
        """
        with self._store.transaction():
            gone = set(page.removed)
            known = set(self._store.keys(ENTRY))
            for key in sorted(known):
                if page.from_start or key.removeprefix(ENTRY).partition(":")[0] in gone:
                    self._store.put(key, None)
                    known.remove(key)
            for entry in page.marks:
                key = f"{ENTRY}{entry.key}"
                if key in known or len(known) < MARKS_MAX:
                    self._store.put(key, entry.model_dump_json())
                    known.add(key)
                elif not self._is_full:
                    log.warning("a robot keeps %d marks of a map; the server has more, which are left out", MARKS_MAX)
                    self._is_full = True
            self._store.put(CURSOR, page.cursor)

    def entries(self) -> list[MarkEntry]:
        """All marks of the copy, by key."""
        found = (self._store.get(key) for key in self._store.keys(ENTRY))
        return [MarkEntry.model_validate_json(text) for text in found if text is not None]
