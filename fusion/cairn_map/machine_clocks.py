"""The machine's clocks: the time of day, which may be set to anything at any moment, and one that never jumps.

The steady clock counts on while the machine sleeps, so that the time of day after a night is no jump. It begins again
with each boot: a reading that was kept means something only under the same boot id.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

BOOT_ID_FILE = Path("/proc/sys/kernel/random/boot_id")
BOOT_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""Number of the steady clock; off Linux it may be one that stands still while the machine sleeps."""


def steady_now_s() -> float:
    """Seconds since some moment, sleep included where the machine can tell."""
    return time.clock_gettime(BOOT_CLOCK)


def boot_id() -> str:
    """Id of this boot of the machine; empty where the machine has none."""
    try:
        return BOOT_ID_FILE.read_text().strip()[:64]
    except OSError:
        return ""


@dataclass(frozen=True, slots=True)
class MachineClocks:
    """Both clocks, each a function that returns seconds."""

    wall_s: Callable[[], float] = time.time
    """Time of day, UTC seconds since 1970."""
    steady_s: Callable[[], float] = steady_now_s
    boot: str = ""
    """Id of the boot with which the steady clock began; empty: readings of two programs cannot be compared."""


MACHINE_CLOCKS = MachineClocks(boot=boot_id())
