"""What a crowd saw of a server: how long each answer took, and what went wrong."""

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from cairn_map.wire.frames import FrameKind


@dataclass(slots=True)
class Times:
    """Latencies of one kind of request, seconds."""

    seconds: list[float] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.seconds)

    def after(self, count: int) -> "Times":
        """Without the first ones."""
        return Times(self.seconds[count:])

    def ms(self, share: float) -> float:
        """So many of them took at most so many milliseconds."""
        ordered = sorted(self.seconds)
        return 1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0

    def __str__(self) -> str:
        figures = (f"{name} {self.ms(share):.0f}" for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0)))
        return f"{', '.join(figures)} ms of {len(self)}"


@dataclass(slots=True)
class Seen:
    """All that the robots noted."""

    joins: Times = field(default_factory=Times)
    """First fetches: the whole map."""
    fetches: Times = field(default_factory=Times)
    pushes: Times = field(default_factory=Times)
    reports: Times = field(default_factory=Times)
    """Of status."""
    frames: Counter[FrameKind] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    """Live ones, by type."""
    errors: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    """Rounds that did not take place, because the one before took longer than the time between two."""
    sent_bytes: int = 0
    received_bytes: int = 0


def rise_of(times_s: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """How much the straight line through the values rises from the first to the last, and how far they lie from it."""
    slope, start = statistics.linear_regression(times_s, values)
    rest = [value - start - slope * time_s for time_s, value in zip(times_s, values, strict=True)]
    return slope * (times_s[-1] - times_s[0]), statistics.pstdev(rest)
