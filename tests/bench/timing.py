"""Medians of what work takes, after one run that does not count."""

import statistics
import time
from collections.abc import Callable


def cpu_s(work: Callable[[], object], repeats: int) -> float:
    """Process CPU time, seconds."""
    return _median_s(work, repeats, time.process_time)


def wall_s(work: Callable[[], object], repeats: int) -> float:
    """Wall time, seconds."""
    return _median_s(work, repeats, time.perf_counter)


def _median_s(work: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        start = clock()
        work()
        seconds.append(clock() - start)
    return statistics.median(seconds)
