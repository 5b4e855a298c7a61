"""What can be wrong with an installation, one check a function: what was found, and what to do about it."""

import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from pathlib import Path

from cairn_client.cli.arguments import shown_bytes
from cairn_client.cli.compile import GROUP as WARM_UPS
from cairn_map.kernels.numba_runtime import is_compiled, known_kernels

PACKAGE = "cairn-robotics"
PYTHON_MIN = (3, 11)
EXTRAS: Mapping[str, tuple[str, str]] = {
    "cv2": ("robot", "images of recordings cannot be read"),
    "rosbags": ("robot", "bags of ROS 1 cannot be read"),
    "mcap": ("robot", "MCAP files cannot be read"),
    "fastapi": ("server", "`cairn serve` does not start"),
    "uvicorn": ("server", "`cairn serve` does not start"),
}
"""Modules, the extra that brings each, and what is missed without."""
DISK_WARN_BYTES, DISK_FAIL_BYTES = 2 << 30, 64 << 20


class Verdict(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    """It works, but not well, or not all of it."""
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the doctor's report."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""
    """The next step, where one is needed."""

    def as_json(self) -> dict[str, str]:
        """Its fields, for JSON."""
        return {"what": self.what, "verdict": self.verdict, "found": self.found, "advice": self.advice}


def installation_checks() -> Iterator[Check]:
    """Python, cairn, what optional commands need, and kernels."""
    yield _python()
    yield _cairn()
    yield from _extras()
    yield _kernels()


def disk_check(folder: Path) -> Check:
    """Room where a folder is, or will be."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    found = f"{shown_bytes(free)} free at {place}"
    if free < DISK_FAIL_BYTES:
        return Check("disk", Verdict.FAIL, found, "make room: a robot that cannot write cannot keep its commits")
    if free < DISK_WARN_BYTES:
        return Check("disk", Verdict.WARN, found, "make room soon; a day's commits may take gigabytes")
    return Check("disk", Verdict.OK, found)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.machine()}"
    if sys.version_info < PYTHON_MIN:
        return Check("python", Verdict.FAIL, found, f"cairn needs Python {'.'.join(map(str, PYTHON_MIN))} or later")
    return Check("python", Verdict.OK, found)


def _cairn() -> Check:
    try:
        return Check("cairn", Verdict.OK, version(PACKAGE))
    except PackageNotFoundError:
        return Check("cairn", Verdict.WARN, "runs from its sources", f"pip install {PACKAGE}, to have `cairn` itself")


def _extras() -> Iterator[Check]:
    for extra in sorted({extra for extra, _ in EXTRAS.values()}):
        missing = {name: what for name, (of, what) in EXTRAS.items() if of == extra and find_spec(name) is None}
        if not missing:
            yield Check(f"extra {extra}", Verdict.OK, "all there")
            continue
        lacks = "; ".join(sorted(set(missing.values())))
        found = f"{', '.join(missing)} missing: {lacks}"
        yield Check(f"extra {extra}", Verdict.WARN, found, f'pip install "{PACKAGE}[{extra}]" if you need it')


def _kernels() -> Check:
    """How many of a robot's kernels are compiled and kept: those with an index file where Numba looks for one."""
    for point in entry_points(group=WARM_UPS):
        if not point.extras:
            point.load()
    kernels = [kernel for kernel in known_kernels() if not kernel.py_func.__name__.startswith("_")]
    ready = sum(is_compiled(kernel) for kernel in kernels)
    found = f"{ready} of {len(kernels)} compiled"
    if ready < len(kernels):
        advice = "`cairn compile` compiles them now, half a minute; else the first scans wait for it"
        return Check("kernels", Verdict.WARN, found, advice)
    return Check("kernels", Verdict.OK, found)
