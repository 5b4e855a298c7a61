"""When each branch was last written as seen: a robot pushes many commits a second, its row changes every few."""

import threading
import time

KEEP_S = 10.0
ENTRIES_MAX = 10_000


class LastSeen:
    """Remembers what was written about each branch; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._written: dict[tuple[int, str], tuple[float, str | None]] = {}

    def is_news(self, map_number: int, name: str, cursor: str | None) -> bool:
        """Whether this is worth writing: a cursor that moved, or the first sign of life for a while."""
        now_s = time.monotonic()
        with self._lock:
            written_s, known = self._written.get((map_number, name), (float("-inf"), None))
            if now_s - written_s < KEEP_S and cursor in (None, known):
                return False
            if len(self._written) >= ENTRIES_MAX:
                self._written.clear()
            self._written[map_number, name] = (now_s, cursor or known)
            return True

    def forget(self, map_number: int, name: str) -> None:
        """The branch's row was made anew, or is gone."""
        with self._lock:
            self._written.pop((map_number, name), None)
