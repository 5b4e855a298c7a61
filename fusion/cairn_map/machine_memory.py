"""Memory of this machine, or of the container in which the process runs: from it follow the standard memory limits."""

import os
from collections.abc import Iterator
from pathlib import Path

SHARE = 4
"""A standard limit is one part in so many of the memory."""


def standard_limit_bytes() -> int:
    """Standard memory limit of one process's maps: a quarter of the memory there is."""
    return memory_bytes() // SHARE


def memory_bytes(root: Path = Path("/")) -> int:
    """Memory of this machine, or the lowest limit of the control groups (cgroups) of this process.

    Args:
        root: where `proc` and `sys` are.
    """
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min([whole, *_group_limits(root)])


def _group_limits(root: Path) -> Iterator[int]:
    """Limits of all groups that hold the process, of both versions of cgroups; a container may show just its own."""
    groups = root / "sys/fs/cgroup"
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        # hierarchy:controllers:path; version 2 is hierarchy 0, and names no controllers.
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        top, name = (groups / "memory", "memory.limit_in_bytes") if controllers else (groups, "memory.max")
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(top):
                yield from _number_in(folder / name)


def _number_in(file: Path) -> Iterator[int]:
    try:
        text = file.read_text().strip()
    except OSError:
        return
    if text.isdecimal() and int(text) > 0:  # "max": no limit
        yield int(text)
