"""Division of the server's memory limit among its parts: one sum, for all of its processes.

    limit = programs + decoding + folding + bodies + checks + caches

Decoding and folding have what one full cell of the standard geometry takes, however small the machine, and three
tenths of a larger limit; bodies, checks and caches grow with the limit, too. What would not fit is refused at the door,
or waits: a map of larger cells is not made (`cell_too_large`), caches forget, a request waits for room to decode or is
answered 503, folding waits, a commit whose check needs more than its share is refused as `too_costly`.
"""

import math
from dataclasses import dataclass, replace

from cairn_map.errors import BadInputError
from cairn_map.machine_memory import memory_bytes, standard_limit_bytes

MIB = 1 << 20
PROGRAMS_BYTES = 512 * MIB
"""Memory of the programs themselves, kernels and libraries included: four processes, 170 MB at rest and 330 to 450 MB
under load (PSS; docs/decisions/022-memory-as-one-sum.md)."""
DECODING_MIN_BYTES = 588 * MIB
"""Least memory for cells that requests decode at the same time (`cell_room`)."""
FOLDING_MIN_BYTES = 832 * MIB
"""Least memory for cells that are folded at the same time, and for encoded ones on their way to the store."""
SPOOL_BYTES = 8 * MIB
"""Memory for the encoded cells of one fold (`store.row_spool`)."""
CELLS_MIN_BYTES = DECODING_MIN_BYTES + FOLDING_MIN_BYTES
CELLS_TENTHS = 3
"""Tenths of the limit that decoding and folding have together, if that is more."""
BODIES_MIN_BYTES, BODIES_MAX_BYTES = 128 * MIB, 256 * MIB
"""Memory for bodies on their way: one token may fill half, and a commit has 2^26 bytes."""
CHECKS_MIN_BYTES, CHECK_MAX_BYTES = 384 * MIB, 1536 * MIB
"""Least memory of all checks of expensive commits together, and most of one."""
TWO_WORKERS_BYTES = 1024 * MIB
"""Memory of all checks from which on two are made at the same time."""
CACHES_MIN_BYTES = 64 * MIB
CACHES_BYTES = 1248 * MIB
"""Sum of the standard sizes of all caches: cells under change, cells read, their changes, pictures' cells and lists,
hot spots."""
GROWING_PART = 20
"""Bodies get one part in so many of the limit."""
LIMIT_MIN_BYTES = PROGRAMS_BYTES + CELLS_MIN_BYTES + BODIES_MIN_BYTES + CHECKS_MIN_BYTES + CACHES_MIN_BYTES
"""Smallest limit: 2.63 GB."""


@dataclass(frozen=True, slots=True)
class MemoryShares:
    """Memory of each part, bytes; together at most the limit."""

    limit_bytes: int
    decoding_bytes: int
    folding_bytes: int
    bodies_bytes: int
    check_workers: int
    check_bytes: int
    """Memory of one check."""
    caches_bytes: int

    @property
    def sum_bytes(self) -> int:
        """Memory of all parts together."""
        checks_bytes = self.check_workers * self.check_bytes
        cells_bytes = self.decoding_bytes + self.folding_bytes
        return PROGRAMS_BYTES + cells_bytes + self.bodies_bytes + checks_bytes + self.caches_bytes

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
            f"checks {self.check_workers} x {self.check_bytes / 1e6:.0f}, folding {self.folding_bytes / 1e6:.0f}, "
            f"decoding {self.decoding_bytes / 1e6:.0f}, bodies {self.bodies_bytes / 1e6:.0f}, "
            f"programs {PROGRAMS_BYTES / 1e6:.0f}"
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
            f"memory_bytes is {limit_bytes}; the server's processes need {LIMIT_MIN_BYTES} at least: one full "
            "cell is decoded, folded and checked at the same time",
        )
    bodies_bytes = min(max(limit_bytes // GROWING_PART, BODIES_MIN_BYTES), BODIES_MAX_BYTES)
    cells_bytes = max(CELLS_MIN_BYTES, limit_bytes * CELLS_TENTHS // 10)
    decoding_bytes = cells_bytes * DECODING_MIN_BYTES // CELLS_MIN_BYTES
    # Caches and checks share the rest; what checks cannot use, caches may.
    rest_bytes = limit_bytes - PROGRAMS_BYTES - cells_bytes - bodies_bytes
    checks_bytes = max(rest_bytes // 2, CHECKS_MIN_BYTES)
    workers = 2 if checks_bytes >= TWO_WORKERS_BYTES else 1
    check_bytes = min(checks_bytes // workers, CHECK_MAX_BYTES)
    caches_bytes = min(rest_bytes - workers * check_bytes, CACHES_BYTES)
    return MemoryShares(
        limit_bytes,
        decoding_bytes,
        cells_bytes - decoding_bytes,
        bodies_bytes,
        workers,
        check_bytes,
        caches_bytes,
    )


def limit_for_cells(decoding_bytes: int, folding_bytes: int) -> int:
    """Least limit above the smallest one of which decoding and folding have at least so much."""
    cells_bytes = max(
        decoding_bytes * CELLS_MIN_BYTES / DECODING_MIN_BYTES, folding_bytes * CELLS_MIN_BYTES / FOLDING_MIN_BYTES
    )
    return math.ceil(cells_bytes * 10 / CELLS_TENTHS) + 10
