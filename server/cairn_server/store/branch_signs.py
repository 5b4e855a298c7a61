"""Notes on branches: their protocol, and the last sign of each, gathered so that a crowd's signs are one write."""

import threading
import time
from dataclasses import dataclass
from typing import Protocol

from cairn_server.store.store_rows import EntrySize, HeardRobot, MapRow

KEEP_S = 10.0
"""Time between two writes of a branch that only gives signs of life."""
WRITE_EVERY_S = 1.0
"""Time between two writes of all branches' signs."""
ENTRIES_MAX = 10_000
Key = tuple[int, str]
"""Key of a branch: number of the map, and name."""


@dataclass(frozen=True, slots=True)
class Sign:
    """Last sign of one branch."""

    time_s: float
    cursor: str | None


class LastSeen:
    """Signs of branches that are still to be written, and those that were; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._written: dict[Key, tuple[float, str | None]] = {}
        self._unwritten: dict[Key, Sign] = {}
        self._written_s = float("-inf")

    def note(self, map_number: int, name: str, cursor: str | None) -> bool:
        """Note a sign; True if it is time to write: there is news, and the last write was `WRITE_EVERY_S` ago."""
        now_s, key = time.monotonic(), (map_number, name)
        with self._lock:
            written_s, known = self._written.get(key, (float("-inf"), None))
            if now_s - written_s >= KEEP_S or cursor not in (None, known):
                before = self._unwritten.get(key)
                self._unwritten[key] = Sign(time.time(), cursor or (before.cursor if before else None))
            return bool(self._unwritten) and now_s - self._written_s >= WRITE_EVERY_S

    def taken(self) -> dict[Key, Sign]:
        """Take the signs to be written now; they count as written."""
        now_s = time.monotonic()
        with self._lock:
            signs, self._unwritten = self._unwritten, {}
            if len(self._written) + len(signs) > ENTRIES_MAX:
                self._written.clear()
            for key, sign in signs.items():
                self._written[key] = now_s, sign.cursor or self._written.get(key, (0.0, None))[1]
            self._written_s = now_s
            return signs

    def forget(self, map_number: int, name: str) -> None:
        """Forget a branch whose row is replaced or removed; its signs are `taken` before."""
        with self._lock:
            self._written.pop((map_number, name), None)


class BranchNotes(Protocol):
    """Notes on branches (`Store.notes`); every method may be called from any thread."""

    def put_status(self, row: MapRow, branch: str, status: str) -> None:
        """Keep the last status of a branch, as JSON, if there is such a branch; may be written later.

        It goes with the branch.
        """
        ...

    def statuses(self, row: MapRow) -> dict[str, str]:
        """Last status of each branch that ever reported one."""
        ...

    def heard(self, *, limit: int) -> list[HeardRobot]:
        """Robots of all maps by their last signs, the newest first; a sign may be missing for some seconds."""
        ...

    def entry_sizes(self, row: MapRow, *, after_seq: int, limit: int) -> list[EntrySize]:
        """Sizes of log entries after one, oldest first, at most `limit`."""
        ...

    def assign(self, row: MapRow, robot: str, assignment: str | None) -> None:
        """Keep which layers of a map a robot takes part in, as JSON, or (None) no more; durable on return.

        The robot need not be registered; it goes with the map alone.

        Raises:
            ConflictError: kind `too_many_assignments`.
        """
        ...

    def assignments(self, row: MapRow, robot: str | None = None) -> dict[str, str]:
        """Assignments of a map by robot: of all, or (one at most) of a robot."""
        ...
