"""Claims of maps in memory (`store.FoldLeases`)."""

import threading
import time
from collections.abc import Callable, Sequence

from cairn_server.store.store import LEASE_S
from cairn_server.store.store_rows import MapRow


class MemoryLeases:
    """Claims by processes that exist in one process only, as tests have them."""

    def __init__(self, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._held: dict[int, tuple[str, float]] = {}
        """Holder of each map, and the time at which its claim ends."""

    def claim(self, maps: Sequence[MapRow], *, holder: str, new_max: int) -> list[MapRow]:
        """Claim maps: those of this holder, and some that no other one has."""
        with self._lock:
            now_s = self._steady_s()
            held = {number: name for number, (name, until_s) in self._held.items() if until_s > now_s}
            own = [row for row in maps if held.get(row.number) == holder]
            free = [row for row in maps if row.number not in held][:new_max]
            claimed = {row.number for row in (*own, *free)}
            self._held |= dict.fromkeys(claimed, (holder, now_s + LEASE_S))
            return [row for row in maps if row.number in claimed]

    def release(self, *, holder: str) -> None:
        """End all claims of a holder."""
        with self._lock:
            self._held = {number: each for number, each in self._held.items() if each[0] != holder}
