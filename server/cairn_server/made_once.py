"""What many ask for at the same time is made once: the first one makes it, the others wait. What was made is kept."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class MadeOnce(Generic[K, V]):
    """Values by name within a bound of memory, those that nobody asked for longest forgotten; thread-safe.

    Nobody changes what it hands out. Whoever makes a value must not ask for another one here.
    """

    def __init__(self, *, limit_bytes: int, size_of: Callable[[V], int]) -> None:
        self._limit_bytes = limit_bytes
        self._size_of = size_of
        self._lock = threading.Lock()
        self._kept: OrderedDict[K, V] = OrderedDict()
        self._making: dict[K, Future[V]] = {}
        self._size_bytes = 0

    def get(self, name: K, make: Callable[[], V]) -> V:
        """The value of a name; what `make` raises is raised to all who wait for it, and not kept."""
        mine: Future[V] = Future()
        with self._lock:
            if name in self._kept:
                self._kept.move_to_end(name)
                return self._kept[name]
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
            self._kept[name] = value
            self._size_bytes += self._size_of(value)
            while self._size_bytes > self._limit_bytes:
                self._size_bytes -= self._size_of(self._kept.popitem(last=False)[1])
        mine.set_result(value)
        return value
