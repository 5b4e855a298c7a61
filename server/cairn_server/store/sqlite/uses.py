"""What robots' commits took, read from the commits (`quota_store.Uses`)."""

from collections import defaultdict
from collections.abc import Mapping

from cairn_server.store.quota_store import Robot, Use, relay_of
from cairn_server.store.sqlite.readers import Readers


class SqliteUses:
    """`quota_store.Uses`."""

    def __init__(self, readers: Readers) -> None:
        self._readers = readers

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """What each robot's commits took that came at or after a time, and what each relay handed over."""
        found: defaultdict[Robot, Use] = defaultdict(Use)
        # Not from the newest back to the first older one: a clock may be set back, and so the order of the numbers
        # says nothing. Nor summed up by SQL, which would go through all commits to have them in groups.
        query = "SELECT map, robot, via, size_bytes, cells FROM commits WHERE received_s >= ?"
        with self._readers.reading() as reader:
            for number, robot, via, size_bytes, cells in reader.execute(query, (time_s,)):
                found[number, relay_of(via) if via else robot] += Use(size_bytes, cells)
        return found
