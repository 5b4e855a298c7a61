"""Reading connections, lent and given back.

Not one for each thread: the web server's threads come and go, and each would leave an open file behind.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw

from cairn_map.errors import UnreachableError
from cairn_server.store.sqlite.failures import read_failure
from cairn_server.store.sqlite.writer import connect

IDLE_MAX = 48
"""Most connections kept open while none reads: one for each thread of the web server, and a few. To open one takes
longer than most reads."""


class Readers:
    """Lends connections that can only read; usable from any thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._idle: list[apsw.Connection] = []
        self._closed = False

    @contextmanager
    def reading(self) -> Iterator[apsw.Connection]:
        """A connection for the length of a `with`.

        Raises:
            UnreachableError: the store is closed, or its file cannot be read.
        """
        connection = self._taken()
        try:
            yield connection
        except apsw.Error as exc:
            raise read_failure(exc) from exc
        finally:
            self._give_back(connection)

    @contextmanager
    def transaction(self) -> Iterator[apsw.Connection]:
        """A connection that sees one state of the file, whatever is written meanwhile."""
        with self.reading() as connection:
            connection.execute("BEGIN")
            try:
                yield connection
            finally:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")

    def close(self) -> None:
        """Close what is not lent; what is lent is closed when it comes back."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()

    def _taken(self) -> apsw.Connection:
        with self._lock:
            if self._closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            if self._idle:
                return self._idle.pop()
        try:
            connection = connect(self._path)
            connection.execute("PRAGMA query_only = ON")
        except apsw.Error as exc:
            raise UnreachableError("store_failed", f"the store cannot be opened: {exc}", retry_after_s=5.0) from exc
        return connection

    def _give_back(self, connection: apsw.Connection) -> None:
        with self._lock:
            if not self._closed and len(self._idle) < IDLE_MAX:
                self._idle.append(connection)
                return
        connection.close()
