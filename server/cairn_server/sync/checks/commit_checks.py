"""Checks of commits before they are acknowledged: most in the thread that brings them, expensive ones in a worker.

The cost of a check is bounded by the heads of the commit's cells, before anything is decoded:

    cell:  100 us  +  50 ns a leaf  +  30 ns a raw byte  +  800 ns a modelled number
                   +  50 ns a voxel, of a cell that is proven canonical only by coding it again (modelled, or large)

A reader never does more than the heads claim, so this is a bound and not a guess, and no commit keeps the server's own
process busy for long or makes it grow. Each rate is twice the measured one
(docs/decisions/007-where-commits-are-checked.md).
"""

import threading
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

from cairn_map.codec.cell_reading import CellReader
from cairn_map.codec.octree.cell_content import CHILD_MASKS, HITS, LEAF_MASKS
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.codec.octree.streams import MODELLED
from cairn_map.commits.commit_reading import CommitReader
from cairn_map.errors import BadInputError
from cairn_server.settings import Settings
from cairn_server.sync.checks.check_pool import CheckPool
from cairn_server.sync.checks.checking import Checked, check_commit

CELL_S = 1e-4
LEAF_S = VOXEL_S = 5e-8
RAW_BYTE_S = 3e-8
NUMBER_S = 8e-7
ALLOWANCE_BYTES = 1 << 22
ALLOWANCE_NUMBERS = 1 << 20
PER_BYTE = 64
"""Raw bytes, or modelled numbers, that each byte pushed may stand for, beyond the allowance. Commits of one scan, or of
36, have 3 to 13, at any voxel edge."""
RAW_BYTES_MAX = 1 << 28
NUMBERS_MAX = 1 << 25
"""Most modelled numbers of a commit of any size; 36 scans of five cameras at 2 cm have 24 MB raw and 30 million."""
ORDINARY_S = 0.05
"""Longest check that is made in the thread that brings the commit."""
THREADS_MAX = 4
"""Most threads that check at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommitCost:
    """Cost of checking a commit, as sums over its cells."""

    cells: int = 0
    leaves: int = 0
    voxels: int = 0
    """Voxels of the cells that are coded again."""
    raw_bytes: int = 0
    numbers: int = 0
    """Modelled numbers, each of which takes a mixture of predictions to decode."""

    @property
    def seconds(self) -> float:
        """Upper bound of the processor time that checking takes."""
        sizes = self.leaves * LEAF_S + self.voxels * VOXEL_S + self.raw_bytes * RAW_BYTE_S
        return self.cells * CELL_S + sizes + self.numbers * NUMBER_S


def cost_of(readers: Iterable[CellReader]) -> CommitCost:
    """Cost of a commit with these cells."""
    cells = leaves = voxels = raw_bytes = numbers = 0
    for reader in readers:
        cells += 1
        leaves += reader.head.leaves
        voxels += 0 if reader.is_plain else reader.head.voxels
        raw_bytes += sum(stream.raw_bytes for stream in reader.stored.values())
        numbers += 0 if reader.is_plain else _modelled_numbers(reader)
    return CommitCost(cells=cells, leaves=leaves, voxels=voxels, raw_bytes=raw_bytes, numbers=numbers)


def check_cost(cost: CommitCost, *, size_bytes: int) -> None:
    """Refuse a commit whose bytes claim too much content, for their count or altogether.

    Raises:
        BadInputError: kind `too_costly`.
    """
    raw_bytes_max = min(RAW_BYTES_MAX, ALLOWANCE_BYTES + PER_BYTE * size_bytes)
    numbers_max = min(NUMBERS_MAX, ALLOWANCE_NUMBERS + PER_BYTE * size_bytes)
    if cost.raw_bytes > raw_bytes_max or cost.numbers > numbers_max:
        raise BadInputError(
            "too_costly",
            f"{size_bytes} bytes may stand for {raw_bytes_max} raw bytes and {numbers_max} modelled numbers, "
            f"this commit claims {cost.raw_bytes} and {cost.numbers}; make several of it, or push it in profile fast",
        )


def _modelled_numbers(reader: CellReader) -> int:
    """Masks, and leaves once for each group of streams that is modelled."""
    head, stored = reader.head, reader.stored
    masks = sum(stored[number].raw_bytes for number in (CHILD_MASKS, LEAF_MASKS) if number in stored)
    firsts = [HITS, *(stream_of_channel(c) for c in range(len(head.geometry.channels)))]
    sizes = {CHILD_MASKS: masks, **dict.fromkeys(firsts, head.leaves)}
    return sum(size for first, size in sizes.items() if first in stored and stored[first].coding == MODELLED)


class CommitChecks:
    """Checks of commits; called from many threads."""

    def __init__(self, settings: Settings) -> None:
        self.ordinary_s = ORDINARY_S
        self._threads = threading.BoundedSemaphore(THREADS_MAX)
        shares = settings.memory
        self._pool = CheckPool(
            workers=shares.check_workers, limit_s=settings.check_cpu_s, memory_bytes=shares.check_bytes
        )

    def check(self, commit: CommitReader, holder: Hashable) -> Checked:
        """Decode a whole commit and find it sound; the holder of a token has a share of the expensive checks.

        Raises:
            BadInputError: kind `too_costly`; or as `check_commit`.
            DamagedDataError: as `check_commit`.
            UnreachableError: kind `busy`, `check_failed` or `shutting_down`: later.
        """
        cost = cost_of(commit.readers)
        check_cost(cost, size_bytes=len(commit.data))
        if cost.seconds > self.ordinary_s:
            return self._pool.check(commit.data, holder)
        with self._threads:
            return check_commit(commit)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()
