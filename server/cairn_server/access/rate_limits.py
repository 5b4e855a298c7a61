"""How often something may happen: so many times at once, and every moment some more."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

NOTED_PER_HOUR = 60
HOUR_S = 3600


@dataclass(slots=True)
class Allowance:
    """What is left of one; not thread-safe."""

    most: float
    """At once."""
    per_s: float
    left: float
    seen_s: float

    def take(self, now_s: float) -> float:
        """Once, at a time that does not fall; 0, or the seconds to wait, and nothing is taken."""
        self.left = min(self.most, self.left + (now_s - self.seen_s) * self.per_s)
        self.seen_s = now_s
        if self.left < 1:
            return (1 - self.left) / self.per_s
        self.left -= 1
        return 0.0


def allowance(most: float, per_s: float, *, now_s: float) -> Allowance:
    """A whole one."""
    return Allowance(most, per_s, most, now_s)


class Refusals:
    """Counts refusals by token, the hour's; may be called from any thread."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._hour = -1
        self._noted: dict[str, int] = {}

    def is_worth_a_line(self, who: str) -> bool:
        """Whether this refusal of a token is still one to note."""
        with self._lock:
            hour = int(self._steady_s() // HOUR_S)
            if hour != self._hour:
                self._hour, self._noted = hour, {}
            self._noted[who] = self._noted.get(who, 0) + 1
            return self._noted[who] <= NOTED_PER_HOUR
