"""Compile the kernels in advance, so that the first start is not slow.

    $ cairn compile
    compiling kernels, only this once: pull_samples, 9 of 43, 12 s
    fusion: ready after 3.6 s
    map: ready after 1.8 s
    sim: ready after 6.9 s
    $ cairn compile map     # those of one package: on several cores, run one command for each

The first line is on standard error, and is taken away when the kernel is ready. Kernels are compiled when they are
first called, and kept in __pycache__ next to the source, or in the folder that NUMBA_CACHE_DIR names. A second run
reads what the first one kept; kernels of another version of cairn are removed. A server needs those of `map`, and
compiles them at its start unless they are there (docs/administrator.md).
"""

import sys
import time
from collections.abc import Callable, Collection, Iterator
from importlib.metadata import entry_points

from cairn_client.cli.arguments import parser
from cairn_map.kernels.kernel_cache import forget_kernels, mark_warm
from cairn_map.kernels.numba_runtime import show_compiling

GROUP = "cairn.warm_up"


def main(argv: list[str]) -> int:
    """Call every installed package's warm-up function, or those of the named ones."""
    options = parser("cairn compile", __doc__)
    known = [point.name for point in entry_points(group=GROUP)]
    options.add_argument(
        "packages", nargs="*", metavar="PACKAGE", help=f"one or more of {', '.join(sorted(known))} (all)"
    )
    wanted = options.parse_args(argv).packages or known
    if unknown := set(wanted) - set(known):
        options.error(f"no package {', '.join(sorted(unknown))} has kernels; these have: {', '.join(sorted(known))}")
    show_compiling()
    for name, warm_up in list(_warm_ups(wanted)):  # all loaded first, so that all kernels are counted from the start
        start_s = time.monotonic()
        package = warm_up.__module__.partition(".")[0]
        forget_kernels(package)
        warm_up()
        mark_warm(package)
        sys.stdout.write(f"{name}: ready after {time.monotonic() - start_s:.1f} s\n")
        sys.stdout.flush()
    return 0


def _warm_ups(wanted: Collection[str]) -> Iterator[tuple[str, Callable[[], None]]]:
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        if point.name not in wanted:
            continue
        try:
            yield point.name, point.load()
        except ModuleNotFoundError as exc:
            if not point.extras:
                raise
            sys.stdout.write(f"{point.name}: left out, it needs {exc.name}: pip install cairn-robotics{point.extras}\n")
