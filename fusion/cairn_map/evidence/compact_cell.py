"""Cells held as their bytes: what a map keeps of a cell whose sums would take far more memory than came for it.

A few bytes can stand for much: 86 of them for a cell of 2^24 equal voxels, 170 for one voxel in each of 2^15 bricks.
As sums both take 67 MB. An honest cell's sums take 10 to 190 times the bytes that came for it. Where a lidar's far
beams cross a cell once, it is up to 740 times; such cells are small.
"""

from collections.abc import Callable
from dataclasses import dataclass

from cairn_map.evidence.brick_cell import BrickCell, brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry

HELD_PER_BYTE = 190
"""Most bytes of sums that are held for each byte that came. With the rest of what a robot keeps of a cell it stays
below 200."""


@dataclass(frozen=True, slots=True)
class CellCoding:
    """Code of cells as bytes, exact; `codec.cell_code.coding_of` is the one of the map format."""

    encode: Callable[[CellKey, Evidence], bytes]
    decode: Callable[[bytes], Evidence]


@dataclass(frozen=True, slots=True, eq=False)
class CompactCell:
    """A cell as its bytes; immutable. Each reading decodes them."""

    data: bytes
    geometry: Geometry
    coding: CellCoding

    def opened(self) -> BrickCell:
        """The cell's sums, in arrays of the caller's own."""
        return brick_cell(self.geometry, [self.packed()])

    def packed(self) -> Evidence:
        """The canonical packed evidence."""
        return self.coding.decode(self.data)

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        return len(self.data)


HeldCell = BrickCell | CompactCell
"""A cell of a map in memory: its sums, or the bytes that stand for them."""


def opened(cell: HeldCell) -> BrickCell:
    """The sums of a cell, to be read: its own, or made of its bytes."""
    return cell if isinstance(cell, BrickCell) else cell.opened()


def has_sums(cell: HeldCell, sums: tuple[object, ...]) -> bool:
    """True if a frozen cell's sums are still those of which `sums_of` gave these objects."""
    return all(mine is its for mine, its in zip(sums_of(cell), sums, strict=False))


def sums_of(cell: HeldCell) -> tuple[object, ...]:
    """Objects that stay the same as long as a frozen cell's sums do."""
    return (cell.counts, cell.samples) if isinstance(cell, BrickCell) else (cell,)
