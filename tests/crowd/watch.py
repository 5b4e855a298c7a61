"""Servers' processes from outside: memory and processor time, their children's included.

Of memory that processes share, each one's share is counted (PSS): children are forks of one another.
"""

import os
import re
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self


@dataclass(frozen=True, slots=True)
class Sample:
    """One look."""

    time_s: float
    resident_bytes: int
    cpu_s: float


class Watch:
    """Looks every so often, in a thread."""

    def __init__(self, pids: Sequence[int], *, every_s: float) -> None:
        self.samples = [sample_of(pids)]
        self._pids = pids
        self._every_s = every_s
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join()
        self.samples.append(sample_of(self._pids))

    def _run(self) -> None:
        while not self._ending.wait(self._every_s):
            self.samples.append(sample_of(self._pids))


def sample_of(pids: Sequence[int]) -> Sample:
    """Memory and processor time of processes and their children now."""
    now_s = time.perf_counter()
    found = [_of_process(number) for pid in pids for number in (pid, *_children(pid))]
    return Sample(now_s, sum(resident for resident, _ in found), sum(cpu_s for _, cpu_s in found))


def _of_process(pid: int) -> tuple[int, float]:
    folder = Path(f"/proc/{pid}")
    try:
        resident = re.search(r"Pss:\s+(\d+)", (folder / "smaps_rollup").read_text())
        fields = (folder / "stat").read_text().rpartition(")")[2].split()
    except OSError:  # it ended meanwhile
        return 0, 0.0
    return int(resident[1]) * 1024 if resident else 0, (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += map(int, path.read_text().split())
        except OSError:  # a thread that ended meanwhile
            continue
    return found + [grandchild for child in found for grandchild in _children(child)]
