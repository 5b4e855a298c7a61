"""Turns of robots in folding: the robot whose commits took the least time of late goes first.

In order of arrival, thirty commits that take a second each would hold up everybody's for half a minute. Each robot's
own commits keep their order. A group ends after `GROUP_S`, and after a commit that took far more than its bytes let
expect, so that what arrives meanwhile gets its turn.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from cairn_server.store.store_rows import StoredCommit

GROUP_S = 1.0
"""Time after which a group takes no further commit; encoding its cells comes on top. With 0.25 s, 216 scans of the
building took 1.8 times as long to fold, as their cells were encoded seven times."""
COSTLY_S, COSTLY_S_PER_BYTE = 0.1, 1e-6
"""A commit that takes longer than both, for its bytes, ends its group. Honest ones take 0.1 us a byte."""
HALF_LIFE_S = 60.0
"""Time in which half of what a robot's commits took is forgotten."""


@dataclass(slots=True)
class _Spent:
    """Time that folding a robot's commits took, as it counted at an instant."""

    seconds: float
    at_s: float


class FoldTurns:
    """Turns of the robots of one map; for one thread."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._spent: dict[str, _Spent] = {}
        self._group: dict[str, float] = {}
        """Seconds that the group under way took, by robot."""

    def in_turn(self, commits: Sequence[StoredCommit]) -> Iterator[StoredCommit]:
        """Commits of one group, in the order of the turns; the caller folds each before it takes the next."""
        start_s = self._steady_s()
        self._group = {}
        waiting: dict[str, deque[StoredCommit]] = {}
        for commit in commits:
            waiting.setdefault(commit.id.author.robot, deque()).append(commit)
        while waiting:
            robot = min(waiting, key=lambda robot: (self.spent_s(robot), waiting[robot][0].number))
            began_s = self._steady_s()
            commit = waiting[robot].popleft()
            size_bytes = sum(map(len, commit.diff.values()))
            yield commit
            if not waiting[robot]:
                del waiting[robot]
            now_s = self._steady_s()
            self._spend(robot, now_s - began_s)
            is_costly = now_s - began_s > max(COSTLY_S, COSTLY_S_PER_BYTE * size_bytes)
            if is_costly or now_s - start_s > GROUP_S:
                return

    def end_group(self, took_s: float) -> None:
        """Count the whole time of the group: what encoding its cells took is shared as its commits' time was."""
        counted_s = sum(self._group.values())
        if counted_s > 0:
            for robot, seconds in list(self._group.items()):
                self._spend(robot, seconds * (took_s / counted_s - 1))
        self._group = {}
        # What has become nothing need not be remembered.
        self._spent = {robot: spent for robot, spent in self._spent.items() if self.spent_s(robot) > 1e-3}

    def charge(self, robot: str, seconds: float) -> None:
        """Count time that a robot's commits took outside of a group."""
        self._spent[robot] = _Spent(self.spent_s(robot) + seconds, self._steady_s())

    def spent_s(self, robot: str) -> float:
        """Seconds that a robot's commits took of late."""
        spent = self._spent.get(robot)
        if spent is None:
            return 0.0
        return float(spent.seconds * 0.5 ** ((self._steady_s() - spent.at_s) / HALF_LIFE_S))

    def _spend(self, robot: str, seconds: float) -> None:
        self._group[robot] = self._group.get(robot, 0.0) + seconds
        self.charge(robot, seconds)
