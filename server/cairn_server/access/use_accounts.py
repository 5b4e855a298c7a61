"""Use of quotas counted by one process: the accounts of a store that no other server works on.

They are `store.replica_notes.UseAccounts`, which a store of several servers keeps itself.
"""

import threading
from collections.abc import Callable

from cairn_server.access.rate_limits import TurnBuckets
from cairn_server.store.replica_notes import UseAccounts, UseAnswer, UseBounds
from cairn_server.store.store import Uses
from cairn_server.store.store_rows import Robot, Use

DAY_S = 86_400


class OwnUseAccounts:
    """Accounts of every robot; after a start, a day's use is read from the stored commits. Thread-safe."""

    def __init__(self, uses: Uses, *, wall_s: Callable[[], float], steady_s: Callable[[], float]) -> None:
        self._uses = uses
        self._wall_s = wall_s
        self._lock = threading.Lock()
        self._buckets = TurnBuckets(steady_s=steady_s)
        self._day = -1
        self._used: dict[Robot, Use] = {}

    def take(self, robot: Robot, use: Use, bounds: UseBounds, *, commits: int) -> UseAnswer:
        """Take use of the day and commits of the minute, or nothing."""
        with self._lock:
            day = int(self._wall_s() // DAY_S)
            if self._day != day:
                self._used = dict(self._uses.since(day * DAY_S))
                self._day = day
            used = self._used.get(robot, Use()) + use
            if not bounds.hold(used):
                return UseAnswer(day, used)
            most = bounds.commits_per_minute
            if commits and most is not None:
                wait_s = self._buckets.take_turn(_commits_of(robot), most=most, per_s=most / 60)
                if wait_s:
                    return UseAnswer(day, used, wait_s)
            self._used[robot] = used
            return UseAnswer(day, used)

    def give_back(self, robot: Robot, use: Use, *, day: int, commits: int) -> None:
        """Give back what was taken on a day."""
        with self._lock:
            if day == self._day:
                self._used[robot] -= use
            for _ in range(commits):
                self._buckets.give_turn(_commits_of(robot))

    def take_turn(self, bucket: str, *, most: float, per_s: float) -> float:
        """Take one from a token bucket; 0, or the seconds to wait."""
        return self._buckets.take_turn(bucket, most=most, per_s=per_s)

    def give_turn(self, bucket: str) -> None:
        """Put one back."""
        self._buckets.give_turn(bucket)


def _commits_of(robot: Robot) -> str:
    return f"commits {robot[0]} {robot[1]}"


_ARE_ACCOUNTS: type[UseAccounts] = OwnUseAccounts
"""Check of the protocol by the type checker."""
