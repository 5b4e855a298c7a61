"""Rate limits: a token bucket, and the bound of a token's lines in the audit log."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

NOTED_PER_HOUR = 60
"""Refusals of one token that are written to the audit log in an hour: more could push other lines out."""
HOUR_S = 3600


@dataclass(slots=True)
class Allowance:
    """Token bucket: so many events at once, and some more with every second; not thread-safe."""

    most: float
    """Size of the bucket."""
    per_s: float
    left: float
    seen_s: float

    def take(self, now_s: float) -> float:
        """Take one event at a time that never falls; 0, or the seconds to wait, with nothing taken."""
        self.left = min(self.most, self.left + (now_s - self.seen_s) * self.per_s)
        self.seen_s = now_s
        if self.left < 1:
            return (1 - self.left) / self.per_s
        self.left -= 1
        return 0.0


def allowance(most: float, per_s: float, *, now_s: float) -> Allowance:
    """Full token bucket."""
    return Allowance(most, per_s, most, now_s)


class AuditLimit:
    """Counts the refusals of each token within the hour; called from many threads."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._hour = -1
        self._noted: dict[str, int] = {}

    def is_worth_a_line(self, token: str) -> bool:
        """Count a refusal of a token; True if it is still one to write to the audit log."""
        with self._lock:
            hour = int(self._steady_s() // HOUR_S)
            if hour != self._hour:
                self._hour, self._noted = hour, {}
            self._noted[token] = self._noted.get(token, 0) + 1
            return self._noted[token] <= NOTED_PER_HOUR
