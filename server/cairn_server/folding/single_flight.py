"""Single-flight cache: concurrent requests for one key compute its value once, and it is kept for later ones."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

IDLE_S = 60.0
"""Time without a request after which a value is dropped, with the next one made: most are past states of cells."""


class MadeOnce(Generic[K, V]):
    """Values by key, within bounds of memory and of idle time, the least recently used dropped first; thread-safe.

    Callers must not change the values. A function that makes a value must not ask the same cache for another one.
    """

    def __init__(
        self,
        *,
        limit_bytes: int,
        size_of: Callable[[V], int],
        idle_s: float = IDLE_S,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Keep values up to so many bytes, each for so long after its last request (infinite: as long as they fit)."""
        self._limit_bytes = limit_bytes
        self._idle_s = idle_s
        self._size_of = size_of
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._kept: OrderedDict[K, tuple[V, float]] = OrderedDict()
        self._making: dict[K, Future[V]] = {}
        self._size_bytes = 0

    def here(self, name: K) -> V | None:
        """Value of a key if it is kept; it is not made otherwise."""
        with self._lock:
            kept = self._kept.get(name)
            if kept is None:
                return None
            self._kept.move_to_end(name)
            self._kept[name] = kept[0], self._steady_s()
            return kept[0]

    def get(self, name: K, make: Callable[[], V]) -> V:
        """Value of a key, made unless it is kept; an error of `make` is raised to all that wait, and not kept."""
        mine: Future[V] = Future()
        with self._lock:
            if name in self._kept:
                value, _ = self._kept.pop(name)
                self._kept[name] = value, self._steady_s()
                return value
            maker = self._making.setdefault(name, mine)
        if maker is not mine:
            return maker.result()
        try:
            value = make()
        except BaseException as exc:
            with self._lock:
                del self._making[name]
            mine.set_exception(exc)
            raise
        with self._lock:
            del self._making[name]
            self._keep(name, value)
        mine.set_result(value)
        return value

    def _keep(self, name: K, value: V) -> None:
        now_s = self._steady_s()
        self._kept[name] = value, now_s
        self._size_bytes += self._size_of(value)
        while self._kept:
            oldest, (least, used_s) = next(iter(self._kept.items()))
            if self._size_bytes <= self._limit_bytes and now_s - used_s <= self._idle_s:
                return
            del self._kept[oldest]
            self._size_bytes -= self._size_of(least)
