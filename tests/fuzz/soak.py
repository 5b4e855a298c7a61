"""One target fuzzed for a while in a process of its own, and what came of it."""

import hashlib
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.one_target import START_OF_ERROR

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "fuzz"
FINDINGS = Path(__file__).parent / "findings"
KERNELS = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(BUILD / "kernels")}
"""Array bounds are checked; in a folder of their own, since Numba would take one kind of kernel for the other."""
STARTING_S = 300
"""Of wall time, for imports and for compiling kernels the first time."""
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


def soak(target: str, *, seconds: int, findings: Path) -> SoakReport:
    """Fuzz one target; a finding ends it early."""
    grown = BUILD / "corpus" / target
    grown.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join(path for path in sys.path if path)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.fuzz.one_target", target, f"--seconds={seconds}"]
        try:
            done = subprocess.run(
                [*command, f"--grown={grown}", f"--findings={folder}"],
                cwd=ROOT,
                env=os.environ | KERNELS | {"PYTHONPATH": paths},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                timeout=seconds + STARTING_S,
                check=False,
            )
            code, said = done.returncode, done.stdout.decode(errors="replace")
        except subprocess.TimeoutExpired as exc:
            code, said = 1, f"did not end in time\n{(exc.stdout or b'').decode(errors='replace')}"
        kept = [_kept(path, target, findings) for path in sorted(Path(folder).iterdir())]
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
