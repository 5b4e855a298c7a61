"""The reading of a map with epochs, now or at a time, as snapshots freeze it: one cached reading for each cell (R5).

    snapshot_of(whole, model)                           now; a `HistoryMap` keeps its reading up to date
    snapshot_of(MapReading(whole, at=epoch), model)     as what was captured up to an epoch shows it

A map that keeps one reports each merge by `note`, and any other change by `forget`. Another sensor model reads all
cells again. A cell whose rows have few bytes and whose reading would take much memory is read where it is asked for.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from cairn_map.arrays import Floats, Words32
from cairn_map.epochs.cell_history import cell_history
from cairn_map.epochs.cell_reading import CellReading, Rows, block_times_s, sample_times_s, voxel_times_s
from cairn_map.epochs.epoch import BASE, Epoch, begin_s
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import BrickCell, reading_cell
from cairn_map.evidence.compact_cell import HELD_PER_BYTE, HeldCell, VoxelTimes
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

READING_PER_SUMS = 2
"""Most memory of a reading, as a multiple of what its rows may take as sums: a voxel has 6 bytes in it instead of 4."""


class EpochMap(Protocol):
    """A map with epochs in memory."""

    @property
    def layer(self) -> MapLayer:
        """Grid, and length of the epochs."""
        ...

    def __iter__(self) -> Iterator[CellKey]:
        """Cells, rising in number."""
        ...

    def rows(self, key: CellKey) -> Rows:
        """Rows of a cell as they are held."""
        ...

    def copy(self) -> "EpochMap":
        """The same rows, unaffected by later changes."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class CompactReading:
    """The reading of a cell as its rows, most of them bytes; immutable. Each reading decodes them."""

    rows: Rows
    geometry: Geometry
    model: SensorModel

    def opened(self) -> BrickCell:
        """The cell's reading, in arrays of the caller's own."""
        return reading_cell(self.geometry, self.packed(), self.model)

    def packed(self) -> Evidence:
        """The reading as evidence."""
        history = cell_history({epoch: row.packed() for epoch, row in self.rows.items()})
        return present(history, self.geometry, self.model).evidence

    @property
    def size_bytes(self) -> int:
        """Memory held: that of the rows, which the map holds, too."""
        return sum(row.size_bytes for row in self.rows.values())


class MapReading:
    """Readings of a map's cells under one sensor model at a time; not thread-safe."""

    def __init__(self, whole: EpochMap, *, at: Epoch | None = None) -> None:
        """Make the reading of a map as it is now, or as what was captured up to an epoch shows it."""
        self._whole = whole
        self._at = at
        self._model: SensorModel | None = None
        self._cells: dict[CellKey, CellReading] = {}
        self._compact: dict[CellKey, CompactReading] = {}

    @property
    def geometry(self) -> Geometry:
        """Voxel edge, cells and channels."""
        return self._whole.layer.geometry

    @property
    def size_bytes(self) -> int:
        """Memory held besides the map's rows."""
        return sum(reading.size_bytes for reading in self._cells.values())

    def note(self, diff: Diff, *, epoch: Epoch, sign: int) -> None:
        """Note that sign * diff, 1 or -1, was added to the map's rows of an epoch."""
        for key, evidence in diff.items():
            self._compact.pop(key, None)
            if key in self._cells:
                self._cells[key].note(epoch, evidence, sign)

    def forget(self, keys: Iterable[CellKey]) -> None:
        """Have cells read from their rows when they are asked for next."""
        for key in keys:
            self._cells.pop(key, None)
            self._compact.pop(key, None)

    def rest(self, *, except_of: Collection[CellKey] = ()) -> None:
        """Drop what only helps rows to grow on, except of some cells."""
        for key, reading in self._cells.items():
            if key not in except_of:
                reading.rest()

    def frozen_cells(self, model: SensorModel) -> dict[CellKey, HeldCell]:
        """All cells, rising in number, unaffected by later changes of the map."""
        if model != self._model:
            self._cells, self._compact, self._model = {}, {}, model
        keys = list(self._whole)
        self.forget((self._cells.keys() | self._compact.keys()) - set(keys))
        return {key: self._frozen(key, model) for key in keys}

    def frozen_times(self) -> VoxelTimes | None:
        """Times of voxels and of their samples, read from the rows where they are asked for."""
        layer = self._whole.layer
        epoch_s = layer.epoch_s
        if epoch_s is None:
            return None
        whole, at = self._whole.copy(), self._at

        def seen(key: CellKey, voxels: Words32) -> Floats:
            return voxel_times_s(_until(whole.rows(key), at), voxels, epoch_s)

        def measured(key: CellKey, voxels: Words32, model: SensorModel) -> Floats:
            return sample_times_s(_until(whole.rows(key), at), voxels, layer, model)

        return VoxelTimes(seen, measured)

    def _frozen(self, key: CellKey, model: SensorModel) -> HeldCell:
        if key in self._compact:
            return self._compact[key]
        reading = self._cells.get(key)
        if reading is not None and reading.is_current:
            return reading.cell().copy()
        if reading is None:
            reading = self._cells[key] = CellReading(self.geometry, model, partial(self._whole.rows, key), at=self._at)
        cell = reading.cell()
        rows = _until(self._whole.rows(key), self._at)
        if cell.size_bytes <= READING_PER_SUMS * sum(map(_sums_bytes_max, rows.values())):
            return cell.copy()
        # The rows are copied: the map copies the arrays of one before it adds to it.
        del self._cells[key]
        frozen = {epoch: row.copy() if isinstance(row, BrickCell) else row for epoch, row in rows.items()}
        self._compact[key] = CompactReading(frozen, self.geometry, model)
        return self._compact[key]


class BlockTimes(Mapping[CellKey, Floats]):
    """First instant of the newest epoch of each block of 4^3 voxels of a map's cells, as `block_times_s` has them.

    Cells are read where they are asked for, each once.
    """

    def __init__(self, whole: EpochMap, *, at: Epoch | None = None) -> None:
        """Times of a map with epochs as it is now, or of what was captured up to an epoch."""
        self._whole = whole.copy()
        self._at = at
        self._kept: dict[CellKey, Floats] = {}

    def __getitem__(self, key: CellKey) -> Floats:
        if key not in self._kept:
            layer, rows = self._whole.layer, _until(self._whole.rows(key), self._at)
            dated = ((begin_s(epoch, layer.epoch_s or 0), row.packed()) for epoch, row in rows.items() if epoch != BASE)
            self._kept[key] = block_times_s(dated, layer.geometry.depth)
        return self._kept[key]

    def __iter__(self) -> Iterator[CellKey]:
        return iter(self._whole)

    def __len__(self) -> int:
        return sum(1 for _ in self._whole)


def _sums_bytes_max(row: HeldCell) -> int:
    """Most memory that a row may take as sums."""
    return row.size_bytes if isinstance(row, BrickCell) else HELD_PER_BYTE * row.size_bytes


def _until(rows: Rows, at: Epoch | None) -> Rows:
    return rows if at is None else {epoch: row for epoch, row in rows.items() if epoch <= at}
