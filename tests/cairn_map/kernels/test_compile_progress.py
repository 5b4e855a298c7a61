"""Messages while kernels are compiled: one line on a terminal, few in a log, nothing when all are kept."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from cairn_map.kernels.numba_runtime import CompileProgress
from cairn_map.progress import CLEAR_LINE

FIRST_USE = """
from cairn_map.kernels.numba_runtime import show_compiling
from cairn_map.evidence.evidence import empty_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry

import sys
sys.stderr.isatty = lambda: True
show_compiling()
show_compiling()
fingerprint(empty_evidence(Geometry()), CellKey(0))
"""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_one_line_and_clears_it() -> None:
    terminal = Terminal()
    progress = CompileProgress(terminal)
    progress.begin("carve", ready=2, total=9)
    assert terminal.getvalue() == f"{CLEAR_LINE}compiling kernels, only this once: carve, 3 of 9, 0 s"
    progress.end(4.2)
    assert terminal.getvalue().endswith(f"0 s{CLEAR_LINE}")
    progress.begin("cast", ready=3, total=9)
    assert terminal.getvalue().endswith(f"{CLEAR_LINE}compiling kernels, only this once: cast, 4 of 9, 4 s")


@pytest.mark.parametrize(
    ("seconds", "said"),
    [([0.3, 0.3, 0.3], []), ([1.2, 1.0, 1.0], ["k1"]), ([2.0, 4.0, 0.9, 0.2], ["k1"]), ([2.0, 6.0, 9.0], ["k1", "k2"])],
)
def test_a_log_gets_a_line_now_and_then(seconds: list[float], said: list[str]) -> None:
    log = io.StringIO()
    progress = CompileProgress(log)
    for n, taken_s in enumerate(seconds):
        progress.begin(f"k{n}", ready=n, total=20)
        progress.end(taken_s)
    assert [line.split(": ")[1].split(",")[0] for line in log.getvalue().splitlines()] == said


@pytest.mark.processes
def test_kernels_are_spoken_of_once_and_not_when_they_are_kept(tmp_path: Path) -> None:
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = os.environ | {"PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path)}
    said = [
        subprocess.run([sys.executable, "-c", FIRST_USE], env=environment, capture_output=True, check=True)
        for _ in range(2)
    ]
    first = said[0].stderr.decode()
    assert first.startswith(f"{CLEAR_LINE}compiling kernels, only this once: cell_seeds, 1 of ")
    assert first.count(CLEAR_LINE) == 2 * 2  # of each of two kernels, before and after it is compiled
    assert said[1].stderr == said[0].stdout == b""
