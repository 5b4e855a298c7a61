"""Compile the kernels ahead, so that the first start is not slow.

    $ cairn compile
    compiling kernels, only this once: pull_samples, 9 of 43, 12 s
    fusion: ready after 3.6 s
    map: ready after 1.8 s
    sim: ready after 6.9 s

The first line is on standard error, and goes when the kernel is ready. Numba compiles a kernel when it is first
called, and keeps the result in __pycache__ beside the source, or in the folder that NUMBA_CACHE_DIR names. A second
call only reads what the first one kept.
"""

import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points

from cairn_client.arguments import parser
from cairn_map.compile_progress import show_compiling

GROUP = "cairn.warm_up"


def main(argv: list[str]) -> int:
    """Call every installed package's warm-up function."""
    parser("cairn compile", __doc__).parse_args(argv)
    show_compiling()
    for name, warm_up in list(_warm_ups()):  # all loaded first, so that all kernels are counted from the start
        start_s = time.monotonic()
        warm_up()
        sys.stdout.write(f"{name}: ready after {time.monotonic() - start_s:.1f} s\n")
        sys.stdout.flush()
    return 0


def _warm_ups() -> Iterator[tuple[str, Callable[[], None]]]:
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            yield point.name, point.load()
        except ModuleNotFoundError as exc:
            if not point.extras:
                raise
            sys.stdout.write(f"{point.name}: left out, it needs {exc.name}: pip install cairn-robotics{point.extras}\n")
