"""Where a commit is checked: a quick one beside the event loop, an ordinary one in the thread that brought it, and a
dear one in a worker process.

What is ordinary is known beforehand, from the heads (`commit_cost`), and bounded: so no commit keeps the server's own
process busy for longer than a blink, or makes it grow.
"""

import logging
import threading
from collections.abc import Iterable
from dataclasses import dataclass

from cairn_map.codec.cell_reading import CellReader
from cairn_map.codec.octree.cell_content import CHILD_MASKS, HITS, LEAF_MASKS
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.codec.octree.streams import MODELLED
from cairn_map.commits.commit_reading import CommitReader
from cairn_map.errors import BadInputError
from cairn_server.settings import Settings
from cairn_server.sync.checks.check_pool import CheckPool
from cairn_server.sync.checks.check_process import CheckProcess, LostCheckError
from cairn_server.sync.checks.checking import Checked, check_commit

CELL_S = 1e-4
LEAF_S = VOXEL_S = 5e-8
RAW_BYTE_S = 3e-8
NUMBER_S = 8e-7
ALLOWANCE_BYTES = 1 << 22
ALLOWANCE_NUMBERS = 1 << 20
PER_BYTE = 64
"""Raw bytes, or modelled numbers, that each byte pushed may stand for, beyond the allowance. Those of one scan or of 36
are 3 to 13, whatever the voxel edge."""
RAW_BYTES_MAX = 1 << 28
NUMBERS_MAX = 1 << 25
"""Of a whole commit, whatever its size; 36 scans of five cameras at 2 cm have 24 MB raw and 30 million numbers."""

log = logging.getLogger(__name__)

ORDINARY_S = 0.05
"""Commits that may cost no more are checked in threads."""
THREADS_MAX = 4
"""Of them at once."""
QUICK_S = 0.01
"""Commits that may cost no more, as nearly all of one scan do, need no thread: one costs more than they do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommitCost:
    """Sums over a commit's cells."""

    cells: int = 0
    leaves: int = 0
    voxels: int = 0
    """Of cells that are coded anew."""
    raw_bytes: int = 0
    numbers: int = 0
    """Modelled ones, each of which a mixture of opinions has to be asked for."""

    @property
    def seconds(self) -> float:
        """Most processor time that checking takes."""
        sizes = self.leaves * LEAF_S + self.voxels * VOXEL_S + self.raw_bytes * RAW_BYTE_S
        return self.cells * CELL_S + sizes + self.numbers * NUMBER_S


def cost_of(readers: Iterable[CellReader]) -> CommitCost:
    """The cost of a commit's cells."""
    cells = leaves = voxels = raw_bytes = numbers = 0
    for reader in readers:
        cells += 1
        leaves += reader.head.leaves
        voxels += 0 if reader.is_plain else reader.head.voxels
        raw_bytes += sum(stream.raw_bytes for stream in reader.stored.values())
        numbers += 0 if reader.is_plain else _modelled_numbers(reader)
    return CommitCost(cells=cells, leaves=leaves, voxels=voxels, raw_bytes=raw_bytes, numbers=numbers)


def check_cost(cost: CommitCost, *, size_bytes: int) -> None:
    """Refuse few bytes that stand for much, and too much altogether.

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
    """Checks commits; called from many threads."""

    def __init__(self, settings: Settings, process: CheckProcess | None = None) -> None:
        self.ordinary_s = ORDINARY_S
        self._process = process
        self._threads = threading.BoundedSemaphore(THREADS_MAX)
        self._pool = CheckPool(
            workers=settings.check_workers, limit_s=settings.check_cpu_s, memory_bytes=settings.check_memory_bytes
        )

    def check(self, commit: CommitReader) -> Checked:
        """What a whole commit holds.

        Raises:
            BadInputError: kind `too_costly`; or as `check_commit`.
            DamagedDataError: as `check_commit`.
            UnreachableError: kind `busy`, `check_failed` or `shutting_down`: later.
        """
        cost = cost_of(commit.readers)
        check_cost(cost, size_bytes=len(commit.data))
        if cost.seconds > self.ordinary_s:
            return self._pool.check(commit.data)
        if cost.seconds <= QUICK_S:
            return check_commit(commit)
        with self._threads:
            return check_commit(commit)

    async def check_soon(self, commit: CommitReader) -> Checked:
        """`check` for a quick commit, while the event loop does other things.

        Raises:
            BadInputError, DamagedDataError: as `check`.
        """
        if self._process is not None:
            check_cost(cost_of(commit.readers), size_bytes=len(commit.data))
            try:
                return await self._process.check(commit.data)
            except LostCheckError:
                self._give_up_process()  # if it is gone
        return self.check(commit)

    def is_quick(self, commit: CommitReader) -> bool:
        """Whether `check` will be done in a moment, and wait for nobody."""
        return cost_of(commit.readers).seconds <= min(QUICK_S, self.ordinary_s)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()
        if self._process is not None:
            self._process.close()

    def _give_up_process(self) -> None:
        process = self._process
        if process is not None and process.is_lost:  # the first of those that waited for it
            self._process = None
            log.error("the process that checks small commits was killed; checking in the server's own from now on")
            process.close()
