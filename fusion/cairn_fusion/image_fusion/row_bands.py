"""Bands of an image's rows, worked on by all cores: kernels release the interpreter's lock, and bands share nothing."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

BANDS_PER_CORE = 2
"""Bands take different times, so there are more of them than cores."""


def run_in_bands(work: Callable[[int, int], None], rows: int) -> None:
    """Call `work(first, last)` for bands that make up all rows, in parallel; its errors are raised here."""
    cores = os.cpu_count() or 1
    count = max(1, min(BANDS_PER_CORE * cores, rows)) if cores > 1 else 1
    edges = [rows * n // count for n in range(count + 1)]
    if count == 1:
        work(0, rows)
        return
    list(_pool(cores).map(work, edges[:-1], edges[1:]))


@cache
def _pool(cores: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores, thread_name_prefix="bands")
