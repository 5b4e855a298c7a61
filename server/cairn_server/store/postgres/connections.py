"""Connections to PostgreSQL, lent and given back, and the kinds of transactions that a store has.

    lent         each statement is a transaction of its own
    transaction  READ COMMITTED; its jobs lock rows in one order: head, authors, accounts, commits, cells
    snapshot     REPEATABLE READ, for reading one state

Not a pool that connects in the background: while the database is away, a request is refused at once (503, later), and
the first one after it finds a fresh connection.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import psycopg
from psycopg import conninfo, errors
from psycopg.pq import TransactionStatus
from psycopg.types.array import ListBinaryDumper
from psycopg.types.numeric import Int8BinaryDumper, Int8Dumper

from cairn_map.errors import UnreachableError
from cairn_server.store.postgres.failures import AGAIN, failure_of

T = TypeVar("T")
Connection = psycopg.Connection[tuple[Any, ...]]

TRIES_MAX = 8
"""Most runs of one transaction that meets others."""
WAIT_S = 10.0
"""Time for which a thread waits for a connection while all are lent."""
CONNECT_S = 5
"""Time in which the database has to accept a connection, unless its URL says another."""
LINK = {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3, "tcp_user_timeout": 10_000}
"""libpq's options by which a connection over a cut link fails after some 10 s, not after TCP's quarter of an hour."""
PRIMARY = "read-write"
"""libpq's `target_session_attrs` of all connections of a store: of several servers the one that takes commits."""
PREPARE_AFTER = 2
"""Runs of a statement on one connection after which it is prepared: a push is longer parsed and planned than run."""
SETTINGS = (
    # Of a process that sleeps in the middle of a write the locks are free again after this time.
    "SET default_transaction_isolation TO 'read committed'; SET idle_in_transaction_session_timeout TO '3s';"
    " SET client_min_messages TO error"
)
SNAPSHOT = (
    # It holds no lock that others wait for, and between two reads a long answer is made.
    "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY; SET LOCAL idle_in_transaction_session_timeout TO '10min'"
)


NOTING = "SET synchronous_commit TO off"
"""Settings of connections for what may be lost in a crash of the database, if it is of the last second."""


def connect(url: str, settings: str = "") -> Connection:
    """A connection to the primary of a URL's servers, with the settings that the store rests on, and more of them.

    Raises:
        psycopg.Error: it cannot be had.
    """
    # A standby is behind, and an asker that is ahead of it would be sent each cell again.
    return connect_to_any(url, settings, target_session_attrs=PRIMARY)


def connect_to_any(url: str, settings: str = "", **options: str) -> Connection:
    """The same to the first server of a URL that answers, be it a standby; `options` are libpq's.

    Raises:
        psycopg.Error: it cannot be had.
    """
    stated = conninfo.conninfo_to_dict(url)
    defaults = {name: value for name, value in {"connect_timeout": CONNECT_S, **LINK}.items() if name not in stated}
    made = psycopg.connect(
        url,
        autocommit=True,
        prepare_threshold=PREPARE_AFTER,
        application_name="cairn",
        **(defaults | options),  # type: ignore[arg-type]
    )
    try:
        made.execute(f"{SETTINGS}; {settings}".encode())
    except BaseException:
        made.close()
        raise
    # One width for all integers: else a statement is parsed again for each mix of widths of its values, and of several
    # lists in it all would have the width that the first one needs.
    made.adapters.register_dumper(int, Int8Dumper)
    made.adapters.register_dumper(int, Int8BinaryDumper)
    # As text, the bodies of a push are escaped in hexadecimal and searched for quotes: a seventh of a fold.
    made.adapters.register_dumper(list, ListBinaryDumper)
    return made


def rows(connection: Connection, query: str, values: Sequence[Any] | dict[str, Any] = ()) -> list[tuple[Any, ...]]:
    """All rows of a query."""
    return connection.execute(query.encode(), values, binary=True).fetchall()


def first(connection: Connection, query: str, values: Sequence[Any] | dict[str, Any] = ()) -> Any:
    """The first row of a query: its only column, or a tuple of several; None without a row."""
    found = connection.execute(query.encode(), values, binary=True).fetchone()
    if found is None:
        return None
    return found[0] if len(found) == 1 else found


class Connections:
    """Connections to one database, at most so many at a time; usable from any thread."""

    def __init__(self, url: str, *, limit: int, settings: str = "") -> None:
        """Connect when it is needed; `settings` is SQL that is run on each connection."""
        self._url = url
        self._settings = settings
        self._room = threading.BoundedSemaphore(limit)
        self._lock = threading.Lock()
        self._idle: list[Connection] = []
        self._closed = False
        self.written = 0
        """Count of the transactions written."""
        self.failures: dict[str, int] = {}
        """Count of those that were not, by kind of error."""

    @contextmanager
    def lent(self) -> Iterator[Connection]:
        """A connection for the length of a `with`.

        Raises:
            UnreachableError: the store is closed, the database does not answer, or all connections are lent.
        """
        connection = self._taken()
        try:
            yield connection
        except psycopg.Error as exc:
            if isinstance(exc, errors.ReadOnlySqlTransaction):  # it was the primary, and is a standby now
                connection.close()
            raise failure_of(exc) from exc
        finally:
            self._give_back(connection)

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """A connection that sees one state of the database, whatever is written meanwhile."""
        with self.lent() as connection:
            connection.execute(SNAPSHOT)
            try:
                yield connection
            finally:
                with suppress(psycopg.Error):  # a connection that broke is closed below
                    connection.execute("ROLLBACK")

    def run(self, job: Callable[[Connection], T]) -> T:
        """Run a job in a transaction, durable on return; again if it met another one that it has to come after.

        Raises:
            UnreachableError: as `lent`.
        """
        for _ in range(TRIES_MAX):
            try:
                with self.lent() as connection, connection.transaction():
                    value = job(connection)
            except UnreachableError as exc:
                if isinstance(exc.__cause__, AGAIN):
                    continue
                self.note_failure(exc)
                raise
            self.note_written()
            return value
        raise UnreachableError("busy", "too many write to the same map at once", retry_after_s=1.0)

    def note_written(self) -> None:
        """Count a transaction that was written."""
        with self._lock:
            self.written += 1

    def note_failure(self, exc: UnreachableError) -> None:
        """Count a transaction that was not written."""
        with self._lock:
            self.failures[exc.kind] = self.failures.get(exc.kind, 0) + 1

    def close(self) -> None:
        """Close what is not lent; what is lent is closed when it comes back."""
        with self._lock:
            self._closed = True
        self._drop_idle()

    def check_open(self) -> None:
        """Refuse to work on a closed store.

        Raises:
            UnreachableError: kind `shutting_down`.
        """
        if self._closed:
            raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)

    def _taken(self) -> Connection:
        self.check_open()
        if not self._room.acquire(timeout=WAIT_S):
            raise UnreachableError("busy", "all connections to the database are at work", retry_after_s=1.0)
        try:
            with self._lock:
                if self._idle:
                    return self._idle.pop()
            return connect(self._url, self._settings)
        except psycopg.Error as exc:
            self._room.release()
            raise failure_of(exc) from exc
        except BaseException:
            self._room.release()
            raise

    def _give_back(self, connection: Connection) -> None:
        is_sound = not connection.closed and connection.info.transaction_status == TransactionStatus.IDLE
        with self._lock:
            is_kept = is_sound and not self._closed
            if is_kept:
                self._idle.append(connection)
        if not is_kept:
            connection.close()
        # A server that restarted or was demoted has broken the others, too: none is to fail for it one by one.
        if not is_sound:
            self._drop_idle()
        self._room.release()

    def _drop_idle(self) -> None:
        with self._lock:
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()
