"""Division of the server's memory limit among its parts: one sum, for all of its processes.

    limit = programs + decoding + folding + bodies + checks + caches

Programs, decoding and folding are what one cell of 256^3 voxels takes, however small the machine; bodies, checks and
caches grow with the limit. What would not fit is refused at the door, or waits: caches forget, a request waits for
room to decode or is answered 503, a commit whose check needs more than its share is refused as `too_costly`.
"""

from dataclasses import dataclass, replace

from cairn_map.errors import BadInputError
from cairn_map.machine_memory import memory_bytes, standard_limit_bytes

MIB = 1 << 20
PROGRAMS_BYTES = 512 * MIB
"""Memory of the programs themselves, kernels and libraries included: four processes, 170 MB at rest and 330 to 450 MB
under load (PSS; docs/decisions/022-memory-as-one-sum.md)."""
DECODING_BYTES = 256 * MIB
"""Memory for cells that requests decode at the same time (`folding.decoding_room`)."""
FOLDING_BYTES = 384 * MIB
"""Memory for the diffs that are folded at the same time, one in each lane: two of 2^24 voxels, the largest."""
BODIES_MIN_BYTES, BODIES_MAX_BYTES = 128 * MIB, 256 * MIB
"""Memory for bodies on their way: one token may fill half, and a commit has 2^26 bytes."""
CHECKS_MIN_BYTES, CHECK_MAX_BYTES = 384 * MIB, 1536 * MIB
"""Least memory of all checks of expensive commits together, and most of one."""
TWO_WORKERS_BYTES = 1024 * MIB
"""Memory of all checks from which on two are made at the same time."""
CACHES_MIN_BYTES = 64 * MIB
CACHES_BYTES = 1200 * MIB
"""Sum of the standard sizes of all caches: cells under change, cells read, their changes, pictures' cells and lists."""
GROWING_PART = 16
"""Bodies get one part in so many of the limit."""
LIMIT_MIN_BYTES = (
    PROGRAMS_BYTES + DECODING_BYTES + FOLDING_BYTES + BODIES_MIN_BYTES + CHECKS_MIN_BYTES + CACHES_MIN_BYTES
)
"""Smallest limit: 1.81 GB."""


@dataclass(frozen=True, slots=True)
class MemoryShares:
    """Memory of each part, bytes; together at most the limit."""

    limit_bytes: int
    bodies_bytes: int
    check_workers: int
    check_bytes: int
    """Memory of one check."""
    caches_bytes: int

    @property
    def sum_bytes(self) -> int:
        """Memory of all parts together."""
        checks_bytes = self.check_workers * self.check_bytes
        fixed_bytes = PROGRAMS_BYTES + DECODING_BYTES + FOLDING_BYTES
        return fixed_bytes + self.bodies_bytes + checks_bytes + self.caches_bytes

    @property
    def cache_share(self) -> float:
        """Part of its standard size that each cache takes."""
        return self.caches_bytes / CACHES_BYTES

    def with_parts(
        self, *, bodies_bytes: int | None, check_workers: int | None, check_bytes: int | None
    ) -> "MemoryShares":
        """Shares with other parts, where they are given; what they take more is taken from the caches.

        Raises:
            BadInputError: kind `bad_setting`: hardly any caches would be left.
        """
        given = replace(
            self,
            bodies_bytes=bodies_bytes or self.bodies_bytes,
            check_workers=check_workers or self.check_workers,
            check_bytes=check_bytes or self.check_bytes,
        )
        excess_bytes = max(0, given.sum_bytes - self.limit_bytes)
        if self.caches_bytes - excess_bytes < CACHES_MIN_BYTES:
            raise BadInputError(
                "bad_setting",
                f"the parts that are set leave no memory: {given.sum_bytes} bytes of {self.limit_bytes}; raise "
                "memory_bytes, or lower body_memory_bytes, check_workers or check_memory_bytes",
            )
        return replace(given, caches_bytes=self.caches_bytes - excess_bytes)

    def text(self) -> str:
        """One line for people."""
        least = " (the least that it needs)" if self.limit_bytes == LIMIT_MIN_BYTES else ""
        return (
            f"memory: at most {self.limit_bytes / 1e6:.0f} MB in all{least}: caches {self.caches_bytes / 1e6:.0f}, "
            f"checks {self.check_workers} x {self.check_bytes / 1e6:.0f}, folding {FOLDING_BYTES / 1e6:.0f}, decoding "
            f"{DECODING_BYTES / 1e6:.0f}, bodies {self.bodies_bytes / 1e6:.0f}, programs {PROGRAMS_BYTES / 1e6:.0f}"
        )


def memory_shares(limit_bytes: int | None = None) -> MemoryShares:
    """Shares of a limit; without one, of a quarter of the machine's memory, or of its container's.

    Raises:
        BadInputError: kind `bad_setting`: the limit is below `LIMIT_MIN_BYTES`, which the standard one never is, or
            above the memory there is.
    """
    if limit_bytes is None:
        limit_bytes = max(standard_limit_bytes(), LIMIT_MIN_BYTES)
    elif limit_bytes > memory_bytes():
        raise BadInputError(
            "bad_setting",
            f"memory_bytes is {limit_bytes}, more than the {memory_bytes()} bytes of this machine or its container: "
            "the kernel would end the server before it keeps to its limit",
        )
    if limit_bytes < LIMIT_MIN_BYTES:
        raise BadInputError(
            "bad_setting",
            f"memory_bytes is {limit_bytes}; the server's processes need {LIMIT_MIN_BYTES} at least: one cell of 256^3 "
            "voxels is decoded, folded and checked at the same time",
        )
    bodies_bytes = min(max(limit_bytes // GROWING_PART, BODIES_MIN_BYTES), BODIES_MAX_BYTES)
    # Caches and checks share the rest; what checks cannot use, caches may.
    rest_bytes = limit_bytes - PROGRAMS_BYTES - DECODING_BYTES - FOLDING_BYTES - bodies_bytes
    checks_bytes = max(rest_bytes // 2, CHECKS_MIN_BYTES)
    workers = 2 if checks_bytes >= TWO_WORKERS_BYTES else 1
    check_bytes = min(checks_bytes // workers, CHECK_MAX_BYTES)
    caches_bytes = min(rest_bytes - workers * check_bytes, CACHES_BYTES)
    return MemoryShares(limit_bytes, bodies_bytes, workers, check_bytes, caches_bytes)
