"""A robot's clock as its server counts: a steady clock, and the lead of the server's time over it (rule T2).

    server time = steady clock + offset       learnt from `Cairn-Time` of answers, in the middle of question and answer

    steady  ----|-----------------|------------------>      never jumps; begins again with each boot
    wall    ----+----   +---------+----   (jump)  ---->     what programs stamp their scans with

Scans bear the robot's own time of day, which may be wrong and may jump. So each look at both clocks adds to a list of
spans in which they went together; a scan's time lies in a span, is a steady time then, and so one of the server's. What
fits no span is a recording's own time: old news, never news from the future. Without an offset there is no time.
"""

import logging
import threading
from dataclasses import dataclass
from typing import Literal

from cairn_client.replica.replica_state import LearntOffset, ReplicaState
from cairn_client.sync.responses import TimeSample
from cairn_map.epochs.epoch import Epoch, epoch_of
from cairn_map.errors import CairnError
from cairn_map.machine_clocks import MACHINE_CLOCKS, MachineClocks

log = logging.getLogger(__name__)

JUMP_S = 1.0
"""Change of the lead of the time of day from which on another span begins: the bound of its error within one."""
SLACK_S = 2.0
"""Lead of a scan's time over the time of day that is taken for none: drivers stamp the end of an exposure."""
SPANS_MAX = 64
"""Spans that are remembered: the newest."""
ERROR_MAX_S = 15.0
"""Half of the time between question and answer from which on nothing is learnt: requests last 30 s at most."""
KEEP_FROM_S = 0.5
"""Change of the offset from which on it is written again: each write costs the flash a page."""


Times = Literal["own", "recorded"]
"""Times of scans: this machine's time of day, which the server's corrects; or a recording's, which are kept."""


@dataclass(slots=True)
class _Span:
    """Span of steady time in which the time of day led by one offset."""

    begin_s: float
    end_s: float
    lead_s: float


class ServerClock:
    """A robot's clock as its server counts; thread-safe."""

    def __init__(self, state: ReplicaState, clocks: MachineClocks = MACHINE_CLOCKS, *, times: Times = "own") -> None:
        """Go on with the offset that the folder holds, if it was learnt since the machine was booted.

        `times` says what scans are stamped with.
        """
        self._state = state
        self._times: Times = times
        self._clocks = clocks
        self._lock = threading.Lock()
        # Since the boot: a time of day from before a jump that no program saw fits no span.
        self._spans = [_Span(float("-inf") if clocks.boot == "" else 0.0, *self._both())]
        kept = state.server_clock
        is_of_boot = kept is not None and clocks.boot != "" and kept.boot == clocks.boot
        self._known: LearntOffset | None = kept if is_of_boot else None
        self._written = self._known

    def look(self) -> None:
        """Compare the two clocks: to be called with each scan, so that a jump between two of them is noticed."""
        with self._lock:
            self._look()

    def learn(self, sample: TimeSample | None) -> None:
        """Learn the offset from an answer of the server, if it says its time."""
        if sample is None or sample.error_s > ERROR_MAX_S:
            return
        with self._lock:
            self._look()
            found = LearntOffset(
                boot=self._clocks.boot,
                offset_s=sample.server_s - sample.steady_s,
                error_s=sample.error_s,
                steady_s=sample.steady_s,
            )
            known = self._known
            if known is not None:
                error_s = known.error_at(found.steady_s)
                moved_s = abs(found.offset_s - known.offset_s)
                # A slower answer says less than what is known, unless they contradict each other.
                if found.error_s > error_s and moved_s <= found.error_s + error_s:
                    return
                if moved_s > JUMP_S + found.error_s + error_s:
                    log.warning("the server's time moved by %.1f s; new commits go by it", moved_s)
            self._known = found
        self._keep(found)

    def now_s(self) -> float | None:
        """The server's time now; None if it was never learnt since the boot."""
        with self._lock:
            return None if self._known is None else self._known.offset_s + self._clocks.steady_s()

    def best_s(self) -> float:
        """The server's time now, or this machine's time of day where that is unknown."""
        now_s = self.now_s()
        return self._clocks.wall_s() if now_s is None else now_s

    def server_time(self, time_s: float) -> float | None:
        """The server's time of a scan that was stamped with this machine's time of day; None: unknown.

        Never later than now. Where the time of day was set back, so that it went by twice, the earlier one.
        """
        with self._lock:
            self._look()
            if self._known is None:
                return None
            now_s = self._clocks.steady_s()
            fitting = [
                min(time_s - span.lead_s, now_s)
                for span in self._spans
                if span.begin_s <= time_s - span.lead_s <= span.end_s + SLACK_S
            ]
            if fitting:
                return min(fitting) + self._known.offset_s
            return _past(time_s, now_s + self._known.offset_s)

    def recorded_time(self, time_s: float) -> float | None:
        """The server's time of a scan of a recording: its own time, unless that is still to come; None: unknown."""
        now_s = self.now_s()
        return None if now_s is None else _past(time_s, now_s)

    def epoch_of(self, captured_s: tuple[float, float] | None, epoch_s: int | None) -> Epoch | None:
        """Epoch of a commit that is closed now, by the time of its last scan; None: it has none, and goes to the base.

        Args:
            captured_s: times of the first and the last scan, as they were stamped; None: there are none.
            epoch_s: length of the map's epochs, seconds; None: it has none.
        """
        if captured_s is None or epoch_s is None:
            return None
        last_s = captured_s[1]
        time_s = self.server_time(last_s) if self._times == "own" else self.recorded_time(last_s)
        return None if time_s is None else epoch_of(time_s, epoch_s)

    def parts(self, earlier_s: float, later_s: float, epoch_s: int | None) -> bool:
        """True if a border between two epochs lies between two scans' times, as they were stamped."""
        epochs = (self.epoch_of((time_s, time_s), epoch_s) for time_s in (earlier_s, later_s))
        return len(set(epochs)) > 1

    def _both(self) -> tuple[float, float]:
        """Steady time, and the lead of the time of day over it."""
        steady_s = self._clocks.steady_s()
        return steady_s, self._clocks.wall_s() - steady_s

    def _look(self) -> None:
        steady_s, lead_s = self._both()
        last = self._spans[-1]
        if abs(lead_s - last.lead_s) <= JUMP_S:
            last.end_s = steady_s
            return
        log.info("this machine's time of day moved by %.1f s; scans go by the server's", lead_s - last.lead_s)
        # When between the two looks it moved is unknown: both spans reach over that time.
        self._spans = [*self._spans, _Span(last.end_s, steady_s, lead_s)][-SPANS_MAX:]
        last.end_s = steady_s

    def _keep(self, found: LearntOffset) -> None:
        """Write an offset, if it says more than the one that was written."""
        written = self._written
        is_known = written is not None and abs(written.offset_s - found.offset_s) < KEEP_FROM_S
        if is_known and written is not None and found.error_s > written.error_s - KEEP_FROM_S:
            return
        try:
            self._state.server_clock = found
            self._written = found
        except CairnError as exc:  # the disk is full or broken: that is no failure of the round
            log.warning("the server's time cannot be remembered: %s", exc.message)


def _past(time_s: float, now_s: float) -> float | None:
    return time_s if time_s <= now_s else None
