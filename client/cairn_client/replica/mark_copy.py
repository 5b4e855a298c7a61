"""Copy of a map's marks in a robot's folder: it goes on from where it was, and is read without a link.

    marks-cursor    state of the map up to which the copy goes; none: no program asked for marks here
    mark KEY        an entry as the server sent it, JSON

It is the server's word. What a robot marked itself, and is not in it yet, is in the outbox.
"""

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.errors import BadInputError
from cairn_map.wire.mark_messages import MarkEntry, MarkPage

CURSOR, ENTRY = "marks-cursor", "mark "
"""Key of the cursor, and first letters of those of entries, among the texts of the folder."""
MARKS_MAX = 1 << 17
"""Most marks in a copy, some 100 MB with the longest texts."""


class MarkCopy:
    """Marks of the server's map as they were at some state; every method may be called from any thread."""

    def __init__(self, store: ReplicaStore) -> None:
        self._store = store

    @property
    def cursor(self) -> str | None:
        """State up to which the copy goes; None: there is none."""
        return self._store.get(CURSOR)

    def take(self, page: MarkPage) -> None:
        """Take a page that goes on from the copy's cursor; all of it or nothing.

        Raises:
            BadInputError: kind `too_many_marks`: the copy would have more than `MARKS_MAX`.
            UnreachableError: kind `store_failed`.
        """
        with self._store.transaction():
            known = self._store.keys(ENTRY)
            gone = set(page.removed)
            for key in known:
                if page.from_start or key.removeprefix(ENTRY).partition(":")[0] in gone:
                    self._store.put(key, None)
            for entry in page.marks:
                self._store.put(f"{ENTRY}{entry.key}", entry.model_dump_json())
            self._store.put(CURSOR, page.cursor)
            if len(known) + len(page.marks) > MARKS_MAX and len(self._store.keys(ENTRY)) > MARKS_MAX:
                raise BadInputError("too_many_marks", f"a robot keeps {MARKS_MAX} marks of a map, the server has more")

    def entries(self) -> list[MarkEntry]:
        """All marks of the copy, by key."""
        found = (self._store.get(key) for key in self._store.keys(ENTRY))
        return [MarkEntry.model_validate_json(text) for text in found if text is not None]
