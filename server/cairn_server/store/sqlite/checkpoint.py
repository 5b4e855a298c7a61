"""Keeping the write-ahead log short: SQLite's own checkpoints never empty it while somebody always reads.

A checkpoint copies the log into the database; only when no reader looks at the log any more may it begin anew. With
readers that overlap there is never such a moment by chance, so the writer makes one: it waits for those who read, while
whoever comes later reads the database alone. It waits little while the log is merely long, and longer once it is
much too long.
"""

import logging
import time
from pathlib import Path

import apsw

log = logging.getLogger(__name__)

IDLE_S = 0.5
"""Without a job for this long the writer is idle."""
IDLE_BYTES = 4 << 20
"""An idle writer empties a log longer than this."""
LONG_BYTES = 64 << 20
"""A writer at work empties a log longer than this ..."""
TOO_LONG_FACTOR = 4
"""... and waits longer for readers if it is so many times longer."""
WAIT_MS = 50
WAIT_LONG_MS = 2000
RETRY_S = 1.0
"""Between two attempts while at work, and five times the wait: readers who stay cost a sixth of the time at most."""


class Checkpoints:
    """When the writer empties its log; for the writer's thread."""

    def __init__(self, connection: apsw.Connection, path: Path, *, busy_ms: int) -> None:
        self.count = 0
        """Logs emptied."""
        self._connection = connection
        self._wal = path.with_name(f"{path.name}-wal")
        self._busy_ms = busy_ms
        self._next_s = 0.0

    def after_work(self) -> None:
        """Empty a log that became too long, if that costs little."""
        size_bytes = self.size_bytes()
        if size_bytes <= LONG_BYTES or time.monotonic() < self._next_s:
            return
        self._try(WAIT_LONG_MS if size_bytes > LONG_BYTES * TOO_LONG_FACTOR else WAIT_MS)

    def when_idle(self) -> None:
        """Empty a log while nobody waits for the writer."""
        if self.size_bytes() > IDLE_BYTES:
            self._try(WAIT_MS)

    def size_bytes(self) -> int:
        """Length of the log."""
        try:
            return self._wal.stat().st_size
        except FileNotFoundError:
            return 0

    def _try(self, wait_ms: int) -> None:
        self._connection.set_busy_timeout(wait_ms)
        try:
            self._connection.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_TRUNCATE)
            self.count += 1
        except apsw.BusyError:
            log.info("somebody reads: the write-ahead log is emptied later")
        except apsw.Error as exc:
            log.warning("the write-ahead log could not be emptied: %s", exc)
        finally:
            self._connection.set_busy_timeout(self._busy_ms)
            self._next_s = time.monotonic() + RETRY_S + 5e-3 * wait_ms
