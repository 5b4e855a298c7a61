"""Rate limits: token buckets, and the bound of a token's lines in the audit log."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from cairn_map.errors import UnreachableError

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


class Buckets(Protocol):
    """Token buckets by name: those of one process, or what several servers share (`store.replica_notes`)."""

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one; 0, or the seconds to wait, with nothing taken."""
        ...

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        ...


class TurnBuckets:
    """Token buckets of one process; called from many threads."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._left: dict[str, Allowance] = {}

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one; 0, or the seconds to wait, with nothing taken."""
        now_s = self._steady_s()
        with self._lock:
            return self._left.setdefault(bucket, allowance(most, per_s, now_s=now_s)).take(now_s)

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        with self._lock:
            if bucket in self._left:
                self._left[bucket].left += 1


class ActLimit:
    """Bounds what each token does in an hour that the audit log tells; admins have no bound. Called from many threads.

    An operator's token that somebody stole must not be able to push the lines about itself out of the log.
    """

    def __init__(
        self, per_hour: int | None, *, shared: Buckets | None = None, steady_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`shared`: buckets of several servers over one store."""
        self._per_hour = per_hour
        self._turns: Buckets = shared or TurnBuckets(steady_s=steady_s)

    def take(self, token: str, *, is_admin: bool) -> None:
        """Count an act.

        Raises:
            UnreachableError: kind `quota`: too many for now.
        """
        if is_admin or self._per_hour is None:
            return
        wait_s = self._turns.take_turn(f"acts {token}", most=self._per_hour, per_s=self._per_hour / HOUR_S)
        if wait_s:
            message = f"the token {token} may admit keys, retract and mark {self._per_hour} times an hour"
            raise UnreachableError("quota", message, retry_after_s=math.ceil(wait_s))


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
