"""Compile the kernels ahead, so that the first start is not slow.

    $ cairn compile
    fusion: ready after 3.6 s
    map: ready after 1.8 s
    sim: ready after 6.9 s

Numba compiles a kernel when it is first called, and keeps the result in __pycache__ beside the source, or in
the folder that NUMBA_CACHE_DIR names. A second call only reads what the first one kept.
"""

import sys
import time
from collections.abc import Callable
from importlib.metadata import entry_points

from cairn_client.arguments import parser

GROUP = "cairn.warm_up"


def main(argv: list[str]) -> int:
    """Call every installed package's warm-up function."""
    parser("cairn compile", __doc__).parse_args(argv)
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        start_s = time.monotonic()
        try:
            warm_up: Callable[[], None] = point.load()
        except ModuleNotFoundError as exc:
            if not point.extras:
                raise
            sys.stdout.write(f"{point.name}: left out, it needs {exc.name}: pip install cairn-robotics{point.extras}\n")
            continue
        warm_up()
        sys.stdout.write(f"{point.name}: ready after {time.monotonic() - start_s:.1f} s\n")
    return 0
