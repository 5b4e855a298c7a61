"""Memory for bodies of requests on their way, shared by all callers.

A caller may hold as much as it would leave free: alone half of all, with another one a third each, and so on (the
dynamic threshold by which switches share their buffers, Choudhury and Hahne 1998). So no caller takes the last byte,
however many links it has, and none has room set aside that it does not use. Only bytes that came count, not announced
ones.
"""

import threading
from collections import Counter
from collections.abc import Hashable

from cairn_map.errors import UnreachableError


class BodyBudget:
    """Bytes of bodies that are in memory, by caller; thread-safe."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit_bytes = limit_bytes
        self._lock = threading.Lock()
        self._held: Counter[Hashable] = Counter()

    @property
    def held_bytes(self) -> int:
        """Bytes of all callers."""
        with self._lock:
            return self._held.total()

    def take(self, caller: Hashable, size_bytes: int) -> None:
        """Take room for more bytes, which `give_back` ends.

        Raises:
            UnreachableError: kind `busy`: there is none now.
        """
        with self._lock:
            self._check(caller, size_bytes)
            self._held[caller] += size_bytes

    def check(self, caller: Hashable, size_bytes: int) -> None:
        """Refuse a body for its announced size, before it comes.

        Raises:
            UnreachableError: kind `busy`, as `take`.
        """
        with self._lock:
            self._check(caller, size_bytes)

    def give_back(self, caller: Hashable, size_bytes: int) -> None:
        """Bytes are gone from memory."""
        with self._lock:
            self._held[caller] -= size_bytes
            if not self._held[caller]:
                del self._held[caller]

    def _check(self, caller: Hashable, size_bytes: int) -> None:
        free_bytes = self._limit_bytes - self._held.total() - size_bytes
        if size_bytes and self._held[caller] + size_bytes > free_bytes:
            raise UnreachableError(
                "busy", f"no room for {size_bytes} bytes more: too many bodies are on their way", retry_after_s=2.0
            )
