"""Virtual time: what happens next is what was planned for the earliest moment."""

import heapq
from collections.abc import Callable

Event = Callable[[], None]


class Events:
    """Planned events, and the time."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._planned: list[tuple[float, int, Event]] = []
        self._count = 0

    def after(self, delay_s: float, event: Event) -> None:
        """Plan an event."""
        self._count += 1  # of two at the same moment, the one planned first
        heapq.heappush(self._planned, (self.now_s + delay_s, self._count, event))

    def run(self, *, until_s: float) -> None:
        """Let happen what is planned until then."""
        while self._planned and self._planned[0][0] <= until_s:
            self.now_s, _, event = heapq.heappop(self._planned)
            event()
        self.now_s = until_s

    def run_while(self, is_busy: Callable[[], bool]) -> None:
        """Let things happen as long as something is under way."""
        while is_busy():
            self.now_s, _, event = heapq.heappop(self._planned)
            event()
