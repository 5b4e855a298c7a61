"""The last that was heard of each robot of one map, in the order of hearing; bounded by the number of branches."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from cairn_map.wire.live_events import RobotSign

Signs = OrderedDict[str, tuple[int, RobotSign]]
"""By branch, with the tick at which it was heard, rising."""

GONE_MAX = 256
"""Robots that left and are still told of to those who listen."""


class LiveRobots:
    """Signs of the robots of one map; thread-safe."""

    def __init__(self, load: Callable[[], list[RobotSign]]) -> None:
        """`load` brings what the store knows, when it is first asked for."""
        self._load = load
        self._lock = threading.Lock()
        self._signs: Signs | None = None
        self._tick = 0

    def present(self) -> tuple[int, list[RobotSign]]:
        """The newest tick, and all robots that are there, by name."""
        with self._lock:
            signs = self._loaded()
            found = [sign for _, sign in signs.values() if not sign.gone]
            return self._tick, sorted(found, key=lambda sign: sign.branch)

    def of(self, branch: str) -> RobotSign | None:
        """The last sign of one robot, if it is there."""
        with self._lock:
            return self._there(self._loaded(), branch)

    def since(self, tick: int) -> list[tuple[int, RobotSign]]:
        """What was heard after a tick, oldest first, of each robot the last only."""
        found: list[tuple[int, RobotSign]] = []
        with self._lock:
            for heard, sign in reversed(self._signs.values() if self._signs else ()):
                if heard <= tick:
                    break
                found.append((heard, sign))
        return found[::-1]

    def came(self, sign: RobotSign) -> None:
        """A robot was registered, perhaps again; what it told before stays."""
        with self._lock:
            if self._signs is not None:
                old = self._there(self._signs, sign.branch) or sign
                self._hear(old.model_copy(update={"mode": sign.mode, "time_s": sign.time_s}))

    def heard(self, branch: str, **news: object) -> bool:
        """Something was heard of a robot; False if none of that name is known to be there."""
        with self._lock:
            sign = self._there(self._signs, branch)
            if sign is None:
                return False
            self._hear(sign.model_copy(update={"time_s": time.time(), **news}))
            return True

    def left(self, branch: str) -> None:
        """A robot was deregistered."""
        with self._lock:
            sign = self._there(self._signs, branch)
            if self._signs is None or sign is None:
                return
            self._hear(RobotSign(branch=branch, mode=sign.mode, time_s=time.time(), gone=True))
            gone = [name for name, (_, known) in self._signs.items() if known.gone]
            for name in gone[: max(0, len(gone) - GONE_MAX)]:
                del self._signs[name]

    def _there(self, signs: Signs | None, branch: str) -> RobotSign | None:
        _, sign = signs.get(branch, (0, None)) if signs else (0, None)
        return None if sign is None or sign.gone else sign

    def _loaded(self) -> Signs:
        if self._signs is None:
            self._signs = OrderedDict()
            for sign in sorted(self._load(), key=lambda sign: sign.time_s):
                self._hear(sign)
        return self._signs

    def _hear(self, sign: RobotSign) -> None:
        assert self._signs is not None  # noqa: S101 - by its callers
        # Microseconds since 1970, so that ticks rise over a restart, too.
        self._tick = max(self._tick + 1, time.time_ns() // 1000)
        self._signs[sign.branch] = (self._tick, sign)
        self._signs.move_to_end(sign.branch)
