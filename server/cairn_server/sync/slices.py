"""Slices of computing: a few replies are made at once, each for some milliseconds, then those that wait.

    long reply     ####----####----####      a slice each, behind those that wait
    short reply        ####                  most need only one

The interpreter computes in one thread at a time, and threads that all want to compute keep pushes and the event loop
from it: of 200 robots, pushes took 62 ms (median) while two replies were made at once, and 96 while eight were.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

SLICE_S = 0.01
"""Time after which a reply lets others go on; most are made in less."""
SLICES_OF_FILE, SLICES_OF_DATABASE = 2, 4
"""Replies in the making at once from a file of SQLite, and from a database, where they wait most of the time."""


class Slices:
    """Turns at computing, handed from each to the one that waits longest; thread-safe."""

    def __init__(self, places: int, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        """At most `places` compute at once."""
        self._free = places
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._waiting: deque[threading.Lock] = deque()
        """Locks that threads wait for, one of each, the oldest first."""

    @property
    def waiting(self) -> int:
        """Count of the threads that wait for a slice now."""
        return len(self._waiting)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Compute in a slice, and give it back at the end."""
        self._take()
        try:
            yield
        finally:
            self._give()

    def of(self, parts: Iterable[T]) -> Iterator[T]:
        """The same parts, each slice handed on when it is over; inside a `turn`, without a wait between two parts."""
        end_s = self._steady_s() + SLICE_S
        for part in parts:
            yield part
            if self._steady_s() >= end_s:
                self._let_others()
                end_s = self._steady_s() + SLICE_S

    def _take(self) -> None:
        with self._lock:
            if self._free:
                self._free -= 1
                return
            mine = self._queue()
        mine.acquire()

    def _give(self) -> None:
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()  # handed over, so that no other thread takes it first
            else:
                self._free += 1

    def _let_others(self) -> None:
        """Hand the slice to the one that waits longest, and wait behind all others; if none waits, go on."""
        with self._lock:
            if not self._waiting:
                return
            mine = self._queue()
            self._waiting.popleft().release()
        mine.acquire()

    def _queue(self) -> threading.Lock:
        mine = threading.Lock()
        mine.acquire()
        self._waiting.append(mine)
        return mine
