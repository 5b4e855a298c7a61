"""Group commit: the one connection that writes takes jobs from all threads, many in one transaction and one flush.

A job's result is handed out only after COMMIT with `synchronous=FULL`: what was acknowledged survives a power cut.
A job that raises is rolled back alone (savepoint); the others of its group go through.

The writer also keeps the write-ahead log short, since SQLite's own checkpoints never empty it while some connection
always reads. A checkpoint copies the log into the database; only when no reader looks at the log any more may it begin
again. With readers that overlap there is never such a moment by chance, so the writer makes one: it waits for the
present readers, while later ones read the database alone. It waits little while the log is merely long, and longer once
it is much too long.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import apsw

from cairn_map.errors import UnreachableError
from cairn_server.store.sqlite.failures import opening_failure, write_failure

log = logging.getLogger(__name__)

IDLE_S = 0.5
"""Time without a job after which the writer is idle."""
IDLE_BYTES = 4 << 20
"""Length of the log above which an idle writer empties it."""
LONG_BYTES = 64 << 20
"""Length of the log above which a writer at work empties it."""
TOO_LONG_FACTOR = 4
"""Multiple of `LONG_BYTES` above which the writer waits longer for readers."""
WAIT_MS = 50
WAIT_LONG_MS = 2000
RETRY_S = 1.0
"""Pause between two attempts, plus five times the wait: readers that stay cost a sixth of the time at most."""


T = TypeVar("T")
Job = tuple[Callable[[apsw.Connection], Any], "Future[Any]"]

GROUP_MAX = 64
"""Most jobs in one transaction."""
QUEUE_MAX = 1024
BUSY_MS = 10_000
Values = tuple[str | int | float | bytes | None, ...]


def connect(path: Path) -> apsw.Connection:
    """A connection with the settings that durability rests on.

    16 kB pages suit blobs of some 50 kB; WAL lets readers go on while the writer commits.
    """
    connection = apsw.Connection(str(path))
    connection.set_busy_timeout(BUSY_MS)
    connection.execute("PRAGMA page_size = 16384")
    # Of a new file: its unused pages can be given back one by one. Of any other, the pragma would be a write.
    if not connection.pragma("page_count"):
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
    connection.execute("PRAGMA journal_mode = WAL")
    # FULL: COMMIT returns only after the log is on the disk, and every acknowledgement rests on that.
    connection.execute("PRAGMA synchronous = FULL")
    # 0: read through a map, a failing disk would end the process (SIGBUS) and not one request.
    connection.execute("PRAGMA mmap_size = 0")
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA journal_size_limit = 67108864")
    return connection


def connect_to_store(path: Path) -> apsw.Connection:
    """`connect`, for a command that opens a store that was there; raises as `opening_failure`."""
    try:
        return connect(path)
    except apsw.Error as exc:
        raise opening_failure(exc, path) from exc


def rows(connection: apsw.Connection, query: str, values: Values = ()) -> list[tuple[Any, ...]]:
    """All rows of a query."""
    return list(connection.execute(query, values))


def first(connection: apsw.Connection, query: str, values: Values = ()) -> Any:
    """The first row of a query: its only column, or a tuple of several; None without a row."""
    return connection.execute(query, values).get


class Checkpoints:
    """Checkpoints that empty the write-ahead log; for the writer's thread."""

    def __init__(self, connection: apsw.Connection, path: Path, *, busy_ms: int) -> None:
        self.count = 0
        """Count of the times that the log was emptied."""
        self._connection = connection
        self._wal = path.with_name(f"{path.name}-wal")
        self._busy_ms = busy_ms
        self._next_s = 0.0

    def after_work(self) -> None:
        """Empty a log that became too long, if that costs little."""
        size_bytes = self.size_bytes()
        # A try that meets readers costs the jobs that wait, so the next one comes after a pause (`RETRY_S`).
        if size_bytes <= LONG_BYTES or time.monotonic() < self._next_s:
            return
        self._try(WAIT_LONG_MS if size_bytes > LONG_BYTES * TOO_LONG_FACTOR else WAIT_MS)

    def when_idle(self) -> None:
        """Empty a log while no job waits for the writer."""
        if self.size_bytes() > IDLE_BYTES:
            self._try(WAIT_MS)

    def size_bytes(self) -> int:
        """Length of the log."""
        try:
            return self._wal.stat().st_size
        except FileNotFoundError:
            return 0

    def _try(self, wait_ms: int) -> None:
        # TRUNCATE waits for the present readers within the busy timeout, and then empties the log.
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


class Writer:
    """A thread that owns the writing connection."""

    def __init__(self, path: Path) -> None:
        self._connection = connect(path)
        self.checkpoints = Checkpoints(self._connection, path, busy_ms=BUSY_MS)
        self.written = 0
        self.failures: dict[str, int] = {}
        self._jobs: queue.Queue[Job | None] = queue.Queue(QUEUE_MAX)
        self._lock = threading.Lock()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="cairn-writer", daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[apsw.Connection], T]) -> "Future[T]":
        """Run a job inside a transaction; the future resolves when it is durable, and cannot be cancelled.

        Raises:
            UnreachableError: the server is shutting down, or its disk does not keep up.
        """
        future: Future[T] = Future()
        future.set_running_or_notify_cancel()  # the thread that waits may be gone at a shutdown, and this one must live
        # Under the lock no job gets behind the None with which `close` ends the queue.
        with self._lock:
            if self._closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            try:
                # Never wait here: a disk that does not keep up is to show as `busy`, not as threads that pile up.
                self._jobs.put_nowait((job, future))
            except queue.Full:
                raise UnreachableError("busy", "the server's disk does not keep up", retry_after_s=1.0) from None
        return future

    def run(self, job: Callable[[apsw.Connection], T]) -> T:
        """Run a job and wait until it is durable."""
        return self.submit(job).result()

    @property
    def queued(self) -> int:
        """Count of the jobs that wait."""
        return self._jobs.qsize()

    @property
    def is_alive(self) -> bool:
        """True while the writer's thread runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Finish all jobs and close the connection; may be called twice."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        try:
            # One transaction, one flush for each group of jobs; between groups, the log is kept short.
            while (group := self._group()) is not None:
                # No job came for a while: an emptied log costs no push anything now.
                if not group:
                    self.checkpoints.when_idle()
                    continue
                failure = _commit_group(self._connection, group)
                if failure is None:
                    self.written += 1
                else:
                    self.failures[failure.kind] = self.failures.get(failure.kind, 0) + 1
                self.checkpoints.after_work()
        finally:
            self._connection.close()

    def _group(self) -> list[Job] | None:
        """Jobs for one transaction; empty after a while without any, None when closed."""
        try:
            first = self._jobs.get(timeout=IDLE_S)
        except queue.Empty:
            return []
        if first is None:
            return None
        # What came while the last group was written is written together.
        group = [first]
        while len(group) < GROUP_MAX:
            try:
                job = self._jobs.get_nowait()
            except queue.Empty:
                break
            if job is None:
                self._jobs.put(None)  # `submit` accepts nothing any more, so there is room
                break
            group.append(job)
        return group


def _commit_group(connection: apsw.Connection, group: list[Job]) -> UnreachableError | None:
    """Write a group in one transaction and answer its threads; the failure if nothing was written."""
    # Nothing is answered before COMMIT: until then every result may still be lost.
    results: list[tuple[Future[Any], Any, BaseException | None]] = []
    try:
        # IMMEDIATE takes the write lock at once, so that no job fails halfway for want of it.
        connection.execute("BEGIN IMMEDIATE")
        for job, future in group:
            results.append((future, *_run_job(connection, job)))
        connection.execute("COMMIT")
    except (apsw.Error, MemoryError) as exc:  # whatever it is, this thread must live: it is the only writer
        failure = write_failure(exc, connection)
        with suppress(apsw.Error):
            if connection.in_transaction:
                connection.execute("ROLLBACK")
        log.error("%s", failure.message)
        for _, future in group:
            future.set_exception(failure)
        return failure
    # Durable: each thread gets its own job's result, or the error that rolled back that job alone.
    for future, value, error in results:
        if error is None:
            future.set_result(value)
        else:
            future.set_exception(error)
    return None


def _run_job(connection: apsw.Connection, job: Callable[[apsw.Connection], Any]) -> tuple[Any, BaseException | None]:
    # A job that raises is undone alone; an error of SQLite itself ends the whole group.
    connection.execute("SAVEPOINT job")
    try:
        value = job(connection)
    except apsw.Error:
        raise
    except Exception as exc:  # noqa: BLE001 - handed to the waiting thread, which raises it there
        connection.execute("ROLLBACK TO job")
        connection.execute("RELEASE job")
        return None, exc
    connection.execute("RELEASE job")
    return value, None
