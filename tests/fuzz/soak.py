"""Targets fuzzed for a while, each in a process of its own, and what came of it."""

import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.each_target import FOUND_IN, GROWN, SAID
from tests.fuzz.one_target import BROKEN, START_OF_ERROR

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "fuzz"
FINDINGS = Path(__file__).parent / "findings"
KERNELS = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(BUILD / "kernels")}
"""Array bounds are checked; in a folder of their own, since Numba would take one kind of kernel for the other."""
REASON_LINES, LINE_LENGTH_MAX = 12, 300


@dataclass(frozen=True, slots=True, kw_only=True)
class SoakReport:
    """How much was tried, and the first thing that was wrong."""

    target: str
    inputs: int
    inputs_per_s: int
    slowest_s: int
    memory_mb: int
    failure: str
    """What went wrong, in a few lines; empty if nothing did."""
    finding: Path | None
    """The input that did it."""

    @property
    def how_to_repeat(self) -> str:
        """A command line for the finding."""
        if self.finding is None:
            return "no input was kept: the process itself failed"
        settings = " ".join(f"{name}={value}" for name, value in KERNELS.items())
        return f"to repeat: {settings} python -m tests.fuzz.one_target {self.target} {self.finding}"


def soak(targets: Sequence[str], *, seconds: int, jobs: int, findings: Path) -> Iterator[SoakReport]:
    """Fuzz targets, a few at a time, and report each as it ends; a finding ends it early."""
    paths = os.pathsep.join(path for path in sys.path if path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for target in targets:
            (folder / target / FOUND_IN).mkdir(parents=True)
            (BUILD / "corpus" / target).mkdir(parents=True, exist_ok=True)
            (folder / target / GROWN).symlink_to(BUILD / "corpus" / target)
        command = [sys.executable, "-m", "tests.fuzz.each_target", *targets, f"--seconds={seconds}", f"--jobs={jobs}"]
        with (
            (folder / SAID).open("wb") as said,
            subprocess.Popen(
                [*command, f"--folder={folder}"],
                cwd=ROOT,
                env=os.environ | KERNELS | {"PYTHONPATH": paths},
                stdout=subprocess.PIPE,
                stderr=said,
                text=True,
            ) as process,
        ):
            assert process.stdout is not None
            left = set(targets)
            for line in process.stdout:
                target, code = line.split()
                left.remove(target)
                yield _report(target, int(code), folder / target, findings)
        for target in sorted(left):
            (folder / target / SAID).write_bytes((folder / SAID).read_bytes())
            yield _report(target, process.returncode or BROKEN, folder / target, findings)


def _report(target: str, code: int, folder: Path, findings: Path) -> SoakReport:
    said = (folder / SAID).read_text(errors="replace")
    kept = [_kept(path, target, findings) for path in sorted((folder / FOUND_IN).iterdir())]
    return SoakReport(
        target=target,
        inputs=_figure(said, "number_of_executed_units"),
        inputs_per_s=_figure(said, "average_exec_per_sec"),
        slowest_s=_figure(said, "slowest_unit_time_sec"),
        memory_mb=_figure(said, "peak_rss_mb"),
        failure=_reason(said, code) if code or kept else "",
        finding=kept[0] if kept else None,
    )


def _kept(path: Path, target: str, findings: Path) -> Path:
    """A finding, named by its content."""
    data = path.read_bytes()
    findings.mkdir(exist_ok=True)
    kept = findings / f"{target}-{hashlib.sha256(data).hexdigest()[:12]}.input"
    kept.write_bytes(data)
    return kept


def _figure(said: str, name: str) -> int:
    found = re.search(rf"stat::{name}:\s*(\d+)", said)
    return int(found.group(1)) if found else 0


def _reason(said: str, code: int) -> str:
    """The exception's traceback or libFuzzer's own complaint; else the last lines."""
    lines = [line for line in said.splitlines() if not line.startswith(("INFO", "stat::", "#", "\t", "Base64"))]
    starts = [n for n, line in enumerate(lines) if START_OF_ERROR in line or "ERROR: libFuzzer" in line]
    return f"exit code {code}\n" + "\n".join(
        line[:LINE_LENGTH_MAX] for line in lines[(starts or [0])[0] :][-REASON_LINES:]
    )
