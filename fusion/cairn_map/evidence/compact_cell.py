"""Cells held as their bytes: what a map keeps of a cell whose sums would take far more memory than came for it.

A few bytes can stand for much: 86 of them for a cell of 2^24 equal voxels, 170 for one voxel in each of 2^15 bricks.
As sums both take 67 MB. An honest cell's sums take 10 to 190 times the bytes that came for it. Where a lidar's far
beams cross a cell once, it is up to 740 times; such cells are small.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from cairn_map.arrays import Floats, Words32
from cairn_map.evidence.brick_cell import BrickCell, brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

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


class ClosedCell(Protocol):
    """A cell that is immutable and made into bricks wherever it is read: `CompactCell`, or a reading of such."""

    def opened(self) -> BrickCell:
        """The cell's bricks, in arrays of the caller's own."""
        ...

    def packed(self) -> Evidence:
        """The canonical packed evidence."""
        ...

    @property
    def size_bytes(self) -> int:
        """Memory held."""
        ...


HeldCell = BrickCell | ClosedCell
"""A cell of a map in memory: its sums or a reading of them, or that of which these are made."""


@dataclass(frozen=True, slots=True)
class VoxelTimes:
    """Times of N voxels of a cell, Morton codes inside it: UTC seconds since 1970, NaN where there is none."""

    seen: Callable[[CellKey, Words32], Floats]
    """(N,) when they were hit or seen through last."""
    measured: Callable[[CellKey, Words32, SensorModel], Floats]
    """(N, C) when the samples of each channel were measured last that are shown under a sensor model."""


def opened(cell: HeldCell) -> BrickCell:
    """The bricks of a cell, to be read: its own, or made of its bytes."""
    return cell if isinstance(cell, BrickCell) else cell.opened()


def has_sums(cell: HeldCell, sums: tuple[object, ...]) -> bool:
    """True if a frozen cell's sums are still those of which `sums_of` gave these objects."""
    return all(mine is its for mine, its in zip(sums_of(cell), sums, strict=False))


def sums_of(cell: HeldCell) -> tuple[object, ...]:
    """Objects that stay the same as long as a frozen cell's sums do."""
    return (cell.counts, cell.samples, cell.odds) if isinstance(cell, BrickCell) else (cell,)
