"""Limits of what a robot keeps on the disk and in memory, and the order in which it is dropped when they are reached.

    1. commits that the server has for good          (their bytes; they are in its map; the oldest first)
    2. cells of the server, the farthest first       (they are a cache, and come again when the robot is near)
    3. nothing more: `commit` refuses, and the measurement stays open

What the server does not have for good is never dropped, nor is it left out of the robot's map. A dropped cell is one
that is not held: the robot asks for it whole when it comes near, and until then shows of it only what it made itself.

The robot's folder remembers the limits that were given last (`replica_state`), for a robot that opens it without any.
"""

import math
from dataclasses import dataclass

from cairn_map.errors import BadInputError
from cairn_map.machine_memory import standard_limit_bytes

LEAST_BYTES = 1 << 16
"""Smallest limit that leaves room for anything."""
KEEP_ACKED_S = 86_400.0
"""Standard least time for which acknowledged bytes are kept: within a day somebody sees a server that lies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of one robot, bytes each but the last; None: as much as there is, but for the memory."""

    disk_bytes_max: int | None = None
    """Largest size of the pages in use in the robot's file: commits, cells, and some 200 bytes of each commit ever
    made. Its write-ahead log, up to 64 MB, and attachments of marks, up to 256 MB, come on top, and the file does not
    become smaller by itself: its free pages are used again."""
    outbox_bytes_max: int | None = None
    """Largest size of the commits whose bytes are kept: those that wait, and those that a restore of the server could
    lose."""
    memory_bytes_max: int | None = None
    """Largest size of the map in memory (`robot.map.size_bytes`) and of its last `snapshot()`; None: a quarter of the
    memory of the machine, or of its container; 0: as much as there is. The measurement under way and the cell that is
    being decoded come on top, and of older snapshots what changed since, for as long as a caller holds them."""

    keep_acked_s: float = KEEP_ACKED_S
    """Least seconds of running for which a commit keeps its bytes after the server acknowledged it, whatever the server
    says of it, unless another limit would refuse the next commit."""

    def __post_init__(self) -> None:
        """Raises: BadInputError: a limit that leaves no room for anything, or a time that is none."""
        if not 0 <= self.keep_acked_s < math.inf:
            raise BadInputError("bad_option", f"keep_acked_s is 0 s or more, got {self.keep_acked_s}")
        for limit in (self.disk_bytes_max, self.outbox_bytes_max, self.memory_bytes_max or None):
            if limit is not None and limit < LEAST_BYTES:
                raise BadInputError("bad_option", f"a limit is at least {LEAST_BYTES} bytes, got {limit}")

    @property
    def map_bytes_max(self) -> int | None:
        """Largest size of the map in memory, bytes; None: as much as there is."""
        return standard_limit_bytes() if self.memory_bytes_max is None else self.memory_bytes_max or None

    @property
    def keeps_commits(self) -> bool:
        """True if commits that the server has for good need not go: nothing bounds the disk."""
        return self.disk_bytes_max is None and self.outbox_bytes_max is None


STANDARD_LIMITS = Limits()
"""Limits of a robot that is given none."""
NO_LIMITS = Limits(memory_bytes_max=0)
