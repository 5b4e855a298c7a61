"""Threads of a store in PostgreSQL: a few for pushes, and one for notes, which are written in their order."""

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from cairn_map.errors import UnreachableError
from cairn_server.store.postgres.connections import Connection, Connections

T = TypeVar("T")

log = logging.getLogger(__name__)

WRITERS = 8
"""Threads that push: what commits at the same time shares one flush of the database's disk."""
QUEUE_MAX = 1024
"""Most pushes that wait; beyond it the database does not keep up."""


class WritingThreads:
    """Threads that run jobs on a store; closed together with it."""

    def __init__(self, noting: Connections) -> None:
        """Start no thread before it is needed; notes are written by these connections."""
        self._noting = noting
        self._pushes = ThreadPoolExecutor(WRITERS, "cairn-push")
        self._notes = ThreadPoolExecutor(1, "cairn-notes")
        self._room = threading.BoundedSemaphore(QUEUE_MAX)
        self._lock = threading.Lock()
        self._closed = False
        self.queued = 0
        """Count of the pushes that wait or are at work."""

    def submit(self, job: Callable[[], T]) -> "Future[T]":
        """Run a job that pushes.

        Raises:
            UnreachableError: the server is shutting down, or the database does not keep up.
        """
        # Never wait here: a database that does not keep up is to show as `busy`, not as threads that pile up.
        if not self._room.acquire(blocking=False):
            raise UnreachableError("busy", "the database does not keep up", retry_after_s=1.0)
        with self._lock:
            if self._closed:
                self._room.release()
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            self.queued += 1
            future = self._pushes.submit(job)
        future.add_done_callback(self._ended)
        return future

    def note(self, job: Callable[[Connection], object]) -> None:
        """Run a job soon that writes notes: after a crash of the database the newest of them may be lost."""

        def run() -> None:
            try:
                self._noting.run(job)
            except UnreachableError as exc:  # they are only notes, and what they are about was done
                log.info("notes were not written: %s", exc.message)

        with self._lock:
            if not self._closed:
                self._notes.submit(run)

    def flush(self) -> None:
        """Return when all notes that were made are written, or given up."""
        with self._lock:
            if self._closed:
                return
            written = self._notes.submit(lambda: None)
        written.result()

    def close(self) -> None:
        """Finish what was accepted; may be called twice."""
        with self._lock:
            self._closed = True
        self._pushes.shutdown()
        self._notes.shutdown()

    def _ended(self, _: object) -> None:
        with self._lock:
            self.queued -= 1
        self._room.release()
