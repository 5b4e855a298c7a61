"""Start of a program of ours, of one module, that keeps its kernels where the program that starts it does.

    $ python -m cairn_map.kernels.program cairn-data/kernels cairn_map.warm_up render

A cache has to be set before the first kernel is imported, and a module imports its kernels first of all.
"""

import runpy
import sys
from collections.abc import Iterable
from pathlib import Path

from cairn_map.kernels.kernel_cache import keep_kernels, spare_folder


def command_of(module: str, arguments: Iterable[str]) -> list[str]:
    """Command line of a module's program, with this program's spare folder; -P: no module of the working folder."""
    return [sys.executable, "-P", "-m", __name__, str(spare_folder() or ""), module, *arguments]


if __name__ == "__main__":
    SPARE, MODULE = sys.argv[1:3]
    sys.argv[:] = [MODULE, *sys.argv[3:]]
    keep_kernels(Path(SPARE) if SPARE else None)
    runpy.run_module(MODULE, run_name="__main__", alter_sys=True)
