"""How long it takes to import what a robot needs, and to be told what `cairn` can do: each in a process of its own.

Medians of the wall time of whole processes, beside `python -c pass` and `import numpy` on the same machine. No kernel
is compiled. Byte code is kept, in a folder of its own: that of the environment may be switched off.
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping

Row = tuple[str, str, str]

PROGRAMS: Mapping[str, tuple[str, ...]] = {
    "python -c pass": ("-c", "pass"),
    "  import numpy": ("-c", "import numpy"),
    "  import numba": ("-c", "import numba"),
    "  import cairn_client.robot.robot": ("-c", "import cairn_client.robot.robot"),
    "  the same, and httpx": ("-c", "import cairn_client.robot.robot, httpx"),
    "  cairn --help": ("-c", "import sys; from cairn_client.main import main; sys.exit(main(['--help']))"),
}


def import_rows(smoke: bool) -> Iterator[Row]:
    """Wall time of each program, and its processor time, which says more on a busy machine."""
    repeats = 3 if smoke else 15
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in PROGRAMS}
    with tempfile.TemporaryDirectory() as folder:
        for n in range(repeats + 1):  # in turns, so that a busy minute is everybody's
            for name, program in PROGRAMS.items():
                took = _run(program, folder)
                if n:  # the first one writes the byte code
                    taken[name].append(took)
    for name, pairs in taken.items():
        wall_s, cpu_s = (statistics.median(column) for column in zip(*pairs, strict=True))
        yield name, f"{wall_s:.3f}", f"s, {cpu_s:.3f} s of processor time"


def _run(program: tuple[str, ...], folder: str) -> tuple[float, float]:
    """Wall and processor time of one process, seconds."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = folder
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, *program], check=True, env=environment, stdout=subprocess.DEVNULL)
    end_s, after = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    return end_s - start_s, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
