"""Cold cells read ahead, several at a time, for one that needs them one after the other: folding.

An object never changes and its name is never used again, so what was read stays right for as long as it is kept.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import NamedTuple

from cairn_server.store.objects.cold_bytes import AwayError, ColdReads

AHEAD_BYTES = 32 << 20
"""Most bytes that are kept."""
READERS = 16
"""Most objects read at the same time."""


class NamedSize(NamedTuple):
    """An object, and about its size."""

    name: str
    size_bytes: int


class ReadAhead:
    """`ColdReads` that keeps what was read ahead, the newest of it; usable from any thread."""

    def __init__(self, objects: ColdReads, *, limit_bytes: int = AHEAD_BYTES) -> None:
        """Read from these objects."""
        self._objects = objects
        self._limit_bytes = limit_bytes
        self._lock = threading.Lock()
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._size_bytes = 0

    def read(self, objects: Iterable[NamedSize]) -> None:
        """Read objects ahead, as many of the first ones as may be kept; a failure is left to the reader."""
        chosen: list[str] = []
        size_bytes = 0
        with self._lock:
            known = set(self._kept)
        for name, each_bytes in objects:
            size_bytes += each_bytes
            if size_bytes > self._limit_bytes:
                break
            if name not in known:
                chosen.append(name)
        if len(chosen) < 2:  # nothing to be gained
            return
        with ThreadPoolExecutor(min(READERS, len(chosen)), "cairn-ahead") as pool:
            for _ in pool.map(self._keep, chosen):
                pass

    def get(self, name: str) -> bytes | None:
        """An object's bytes; None: there is no such object.

        Raises:
            AwayError: the store does not answer.
        """
        with self._lock:
            data = self._kept.get(name)
        return self._objects.get(name) if data is None else data

    def part(self, name: str, *, start: int, size_bytes: int) -> bytes | None:
        """Bytes of an object from `start` on; None: there is no such object, or it is shorter.

        Raises:
            AwayError: the store does not answer.
        """
        return self._objects.part(name, start=start, size_bytes=size_bytes)

    def _keep(self, name: str) -> None:
        with suppress(AwayError):
            data = self._objects.get(name)
            if data is None:
                return
            with self._lock:
                self._size_bytes += len(data) - len(self._kept.pop(name, b""))
                self._kept[name] = data
                while self._size_bytes > self._limit_bytes:
                    self._size_bytes -= len(self._kept.popitem(last=False)[1])
