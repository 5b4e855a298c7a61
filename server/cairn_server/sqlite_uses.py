"""What robots' commits took, read from the commits (`quota_store.Uses`)."""

from collections import defaultdict
from collections.abc import Mapping

from cairn_server.quota_store import Robot, Use
from cairn_server.sqlite_readers import Readers


class SqliteUses:
    """`quota_store.Uses`."""

    def __init__(self, readers: Readers) -> None:
        self._readers = readers

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """What each robot's commits took that came after a time; reads from the newest back, and no further."""
        found: defaultdict[Robot, Use] = defaultdict(Use)
        query = "SELECT received_s, map, robot, size_bytes, cells FROM commits ORDER BY number DESC"
        with self._readers.reading() as reader:
            for received_s, number, robot, size_bytes, cells in reader.execute(query):
                if received_s < time_s:
                    break
                found[number, robot] += Use(size_bytes, cells)
        return found
