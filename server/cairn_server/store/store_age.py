"""Age of a store: the seconds that servers were seen to run on it, counted by a steady clock.

    wall clock      the time of day; may be set ahead or back by years at any moment
    steady clock    seconds since some moment; never jumps, and begins again with each start
    age             steady seconds of all runs, added up; kept in the store

Whatever ends something after a time (evidence is forgotten, a commit becomes stable, a token's life is over) compares
ages. Time in which no server ran does not count, and a minute at most is lost by a kill: things are then kept longer,
never shorter. The wall clock is for what people read, and a jump of it is reported.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from cairn_map.machine_clocks import MACHINE_CLOCKS

JUMP_S = 60.0
"""Difference between the two clocks from one look to the next above which the wall clock jumped: NTP moves a clock that
it does not set by 5 s a minute at most."""


@dataclass(frozen=True, slots=True)
class AgeMark:
    """Age of a store as it was last kept, and the time of day then."""

    age_s: float = 0.0
    wall_s: float = 0.0
    """UTC seconds since 1970; 0 in a store whose age was never kept."""


@dataclass(frozen=True, slots=True)
class Clocks:
    """The machine's clocks, each a function that returns seconds."""

    wall_s: Callable[[], float] = time.time
    steady_s: Callable[[], float] = time.monotonic
    """Steady clock of ages; it stands still while the machine sleeps."""
    sleepless_s: Callable[[], float] | None = None
    """Steady clock of trust in the time of day, which counts on while the machine sleeps; None: that of ages does."""
    boot: str = ""
    """Boot of the machine with which the sleepless clock began; empty: unknown."""

    def since_boot_s(self) -> float:
        """The sleepless clock."""
        return (self.sleepless_s or self.steady_s)()


CLOCKS = Clocks(sleepless_s=MACHINE_CLOCKS.steady_s, boot=MACHINE_CLOCKS.boot)


class StoreAge:
    """Age of one store while a server runs on it; thread-safe."""

    def __init__(self, last: AgeMark, clocks: Clocks) -> None:
        """Go on from the age that was kept last."""
        self._clocks = clocks
        self._lock = threading.Lock()
        self._start_s = clocks.steady_s() - last.age_s
        # No time off is negative: a wall clock behind the last one seen was set back, or is not set yet.
        self._offset_s = max(clocks.wall_s(), last.wall_s) - clocks.steady_s()

    def now_s(self) -> float:
        """Age now, seconds; it never falls."""
        return self._clocks.steady_s() - self._start_s

    def follow(self, age_s: float) -> None:
        """Go on from an age that another server of the store came to, if that is later."""
        with self._lock:
            self._start_s = min(self._start_s, self._clocks.steady_s() - age_s)

    def mark(self) -> AgeMark:
        """Age and time of day now, to be kept."""
        return AgeMark(self.now_s(), self._clocks.wall_s())

    def jump_s(self) -> float:
        """Seconds by which the wall clock jumped since the last look, ahead or (negative) back; 0 if it did not."""
        with self._lock:
            offset_s = self._clocks.wall_s() - self._clocks.steady_s()
            jump_s, self._offset_s = offset_s - self._offset_s, offset_s
        return jump_s if abs(jump_s) > JUMP_S else 0.0
