"""Clock of a store in memory."""

import threading

from cairn_server.store.store_age import Clocks
from cairn_server.store.store_clock import ClockMark


class MemoryClock:
    """`store_clock.StoreClock`; of several servers, each with its own steady clock in truth, they share one."""

    def __init__(self, clocks: Clocks, *, is_shared: bool) -> None:
        self._clocks = clocks
        self._lock = threading.Lock()
        self._kept = ClockMark()
        self.boot = "" if is_shared else clocks.boot

    def steady_s(self) -> float:
        """The steady clock."""
        return self._clocks.since_boot_s()

    def wall_s(self) -> float:
        """The time of day."""
        return self._clocks.wall_s()

    def kept(self) -> ClockMark:
        """State that was kept last."""
        return self._kept

    def keep(self, mark: ClockMark, *, before: ClockMark) -> None:
        """Keep a state, unless another one was kept since."""
        with self._lock:
            if self._kept == before:
                self._kept = mark
