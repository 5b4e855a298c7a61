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
    pushed_s: list[float] = field(default_factory=list)
    """When pushes were answered, `perf_counter`."""
    heads: list[tuple[float, int]] = field(default_factory=list)
    """When a listener was told of a head, and log entries up to it."""
    folded_before: int = 0
    """Log entries before the first of these pushes."""
    errors: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    """Rounds that did not take place, because the one before took longer than the time between two."""
    sent_bytes: int = 0
    received_bytes: int = 0


def fold_lags(pushed_s: Sequence[float], heads: Sequence[tuple[float, int]], before: int) -> Times:
    """Time from the answer to the n-th push until a head had n entries more than `before`, as listeners heard of it.

    Folding does not keep the order of arrival, so a single time may be another push's; their mean is the pushes' own.
    """
    found, heads = [], sorted(heads)
    at = 0
    for n, answered_s in enumerate(sorted(pushed_s), start=before + 1):
        while at < len(heads) and heads[at][1] < n:
            at += 1
        if at == len(heads):
            break
        found.append(max(0.0, heads[at][0] - answered_s))
    return Times(found)


def rise_of(times_s: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """How much the straight line through the values rises from the first to the last, and how far they lie from it."""
    slope, start = statistics.linear_regression(times_s, values)
    rest = [value - start - slope * time_s for time_s, value in zip(times_s, values, strict=True)]
    return slope * (times_s[-1] - times_s[0]), statistics.pstdev(rest)
