"""What checking a commit will cost, by what the heads of its cells claim: nothing is decoded yet.

    cell:  100 us  +  50 ns a leaf  +  30 ns a raw byte  +  800 ns a modelled number
                   +  50 ns a voxel, of a cell that only coding anew shows to be canonical (modelled, or large)

Whatever the bytes turn out to be, a reader does no more than the heads claim, so this is a bound and not a guess. Each
rate is twice what was measured (docs/decisions/007-where-commits-are-checked.md).
"""

from collections.abc import Iterable
from dataclasses import dataclass

from cairn_map.codec.cell_reading import CellReader
from cairn_map.codec.octree.cell_content import CHILD_MASKS, HITS, LEAF_MASKS
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.codec.octree.streams import MODELLED
from cairn_map.errors import BadInputError

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
