"""Counters and histograms with labels, and their text for Prometheus (exposition format 0.0.4).

Counting is one dictionary under a lock, about a microsecond, so that it may stand on the path of a push.
"""

import threading
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
SERIES_MAX = 2000
"""Of one counter or histogram; what comes beyond is counted under the label values `other`."""
SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper ends of the buckets of a duration."""
ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n"})

Labels = tuple[str, ...]


class Counter:
    """A sum for each combination of label values, that only grows."""

    def __init__(self, name: str, help_text: str, labels: Labels = ()) -> None:
        self.name = name
        self.labels = labels
        self._help = help_text
        self._lock = threading.Lock()
        self._sums: dict[Labels, float] = {} if labels else {(): 0}

    def add(self, amount: float, *values: str) -> None:
        """Count something, under these label values."""
        with self._lock:
            values = _bounded(self._sums, values)
            self._sums[values] = self._sums.get(values, 0) + amount

    def lines(self) -> Iterator[str]:
        """Its text."""
        with self._lock:
            found = sorted(self._sums.items())
        yield from _head(self.name, "counter", self._help)
        for values, total in found:
            yield _sample(self.name, zip(self.labels, values, strict=True), total)


class Histogram:
    """How often something took how long, for each combination of label values."""

    def __init__(self, name: str, help_text: str, labels: Labels = (), *, ends: Sequence[float] = SECONDS) -> None:
        self.name = name
        self.labels = labels
        self._help = help_text
        self._ends = ends
        self._lock = threading.Lock()
        self._counts: dict[Labels, list[int]] = {}
        self._sums: dict[Labels, float] = {}

    def observe(self, value: float, *values: str) -> None:
        """Count one that took so long."""
        bucket = bisect_left(self._ends, value)
        with self._lock:
            values = _bounded(self._sums, values)
            counts = self._counts.setdefault(values, [0] * (len(self._ends) + 1))
            counts[bucket] += 1
            self._sums[values] = self._sums.get(values, 0.0) + value

    def lines(self) -> Iterator[str]:
        """Its text: buckets hold all that is at most their end."""
        with self._lock:
            found = [(values, list(counts), self._sums[values]) for values, counts in sorted(self._counts.items())]
        yield from _head(self.name, "histogram", self._help)
        for values, counts, total in found:
            labels = list(zip(self.labels, values, strict=True))
            count = 0
            for end, here in zip([*map(str, self._ends), "+Inf"], counts, strict=True):
                count += here
                yield _sample(f"{self.name}_bucket", [*labels, ("le", end)], count)
            yield _sample(f"{self.name}_sum", labels, total)
            yield _sample(f"{self.name}_count", labels, count)


def gauge_lines(
    name: str, help_text: str, values: float | Mapping[str, float], *, label: str = "", kind: str = "gauge"
) -> Iterator[str]:
    """The text of something that is looked up when it is asked for: one value, or one for each value of a label."""
    yield from _head(name, kind, help_text)
    if isinstance(values, Mapping):
        for key, value in values.items():
            yield _sample(name, [(label, key)], value)
    else:
        yield _sample(name, [], values)


def _bounded(known: Mapping[Labels, object], values: Labels) -> Labels:
    return values if values in known or len(known) < SERIES_MAX else ("other",) * len(values)


def _head(name: str, kind: str, help_text: str) -> Iterator[str]:
    yield f"# HELP {name} {help_text}"
    yield f"# TYPE {name} {kind}"


def _sample(name: str, labels: Iterable[tuple[str, str]], value: float) -> str:
    inner = ",".join(f'{label}="{text.translate(ESCAPES)}"' for label, text in labels)
    return f"{name}{{{inner}}} {value}" if inner else f"{name} {value}"
