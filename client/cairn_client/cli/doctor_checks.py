"""Checks of an installation, a function each: Python, cairn, extras, kernels, and room on the disk."""

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
"""Optional modules: the extra that brings each, and the functions that fail without it."""
DISK_WARN_BYTES, DISK_FAIL_BYTES = 2 << 30, 64 << 20


class CheckResult(StrEnum):
    """Result of a check."""

    OK = "ok"
    WARN = "warn"
    """It works, but badly or in part."""
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the doctor's report."""

    what: str
    verdict: CheckResult
    found: str
    advice: str = ""
    """The next step, where one is needed."""

    def as_json(self) -> dict[str, str]:
        """Its fields, for JSON."""
        return {"what": self.what, "verdict": self.verdict, "found": self.found, "advice": self.advice}


def installation_checks() -> Iterator[Check]:
    """Checks of Python, cairn, the libraries of optional commands, and kernels."""
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
        return Check("disk", CheckResult.FAIL, found, "make room: a robot that cannot write cannot keep its commits")
    if free < DISK_WARN_BYTES:
        return Check("disk", CheckResult.WARN, found, "make room soon; a day's commits may take gigabytes")
    return Check("disk", CheckResult.OK, found)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.machine()}"
    if sys.version_info < PYTHON_MIN:
        return Check("python", CheckResult.FAIL, found, f"cairn needs Python {'.'.join(map(str, PYTHON_MIN))} or later")
    return Check("python", CheckResult.OK, found)


def _cairn() -> Check:
    try:
        return Check("cairn", CheckResult.OK, version(PACKAGE))
    except PackageNotFoundError:
        return Check(
            "cairn", CheckResult.WARN, "runs from its sources", f"pip install {PACKAGE}, to have `cairn` itself"
        )


def _extras() -> Iterator[Check]:
    for extra in sorted({extra for extra, _ in EXTRAS.values()}):
        missing = {name: what for name, (of, what) in EXTRAS.items() if of == extra and find_spec(name) is None}
        if not missing:
            yield Check(f"extra {extra}", CheckResult.OK, "all there")
            continue
        lacks = "; ".join(sorted(set(missing.values())))
        found = f"{', '.join(missing)} missing: {lacks}"
        yield Check(f"extra {extra}", CheckResult.WARN, found, f'pip install "{PACKAGE}[{extra}]" if you need it')


def _kernels() -> Check:
    """Count of a robot's kernels that are compiled and kept: those with an index file where Numba looks for one."""
    for point in entry_points(group=WARM_UPS):
        if not point.extras:
            point.load()
    kernels = [kernel for kernel in known_kernels() if not kernel.py_func.__name__.startswith("_")]
    ready = sum(is_compiled(kernel) for kernel in kernels)
    found = f"{ready} of {len(kernels)} compiled"
    if ready < len(kernels):
        advice = "`cairn compile` compiles them now, half a minute; else the first scans wait for it"
        return Check("kernels", CheckResult.WARN, found, advice)
    return Check("kernels", CheckResult.OK, found)
