"""A map with epochs in memory: a map of sums for each epoch, of which the newest is open and the others rest as bytes.

    map.merge(diff, epoch=e)     add a measurement      map.unmerge(diff, epoch=e)     take it out again, exactly
    map.history(key)             rows of a cell         map.evidence(key)              their sum
    snapshot_of(map, model)      as it reads now        snapshot_of(MapReading(map, at=e), model)    as it was

A map without epochs has the base alone, and is held as an `EvidenceMap` is.
"""

import hashlib
from collections.abc import Iterator, Mapping

from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.map_reading import MapReading
from cairn_map.evidence.brick_cell import BrickCell, difference
from cairn_map.evidence.compact_cell import CellCoding, CompactCell, HeldCell, VoxelTimes
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import NO_BODIES, Bodies, Diff, EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

NO_ROWS: Mapping[Epoch, bytes] = {}


class HistoryMap:
    """Sums of evidence over any number of cells, by epoch; not thread-safe."""

    def __init__(self, layer: MapLayer, *, coding: CellCoding | None = None) -> None:
        """Make an empty map; without a `coding` every row is held as sums."""
        self.layer = layer
        self._coding = coding
        self._rows: dict[Epoch, EvidenceMap] = {BASE: EvidenceMap(layer.geometry, coding=coding)}
        self._shown: dict[CellKey, HeldCell] = {}
        """Readings of cells whose rows are still to come, by number."""
        self._reading: MapReading | None = None
        self._touched: set[CellKey] = set()
        """Cells that changed since the last `rest`."""

    def __iter__(self) -> Iterator[CellKey]:
        return iter(sorted(set().union(*self._rows.values())))

    def __len__(self) -> int:
        return len(set().union(*self._rows.values()))

    def __repr__(self) -> str:
        return f"HistoryMap({len(self)} cells, {len(self.epochs)} epochs, {self.size_bytes} bytes, {self.geometry})"

    def __contains__(self, key: CellKey) -> bool:
        return any(key in row for row in self._rows.values())

    def __eq__(self, other: object) -> bool:
        """True for the same evidence in the same rows of the same layer, however it came together."""
        if not isinstance(other, HistoryMap | EvidenceMap):
            return NotImplemented
        return self.geometry == other.geometry and self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def geometry(self) -> Geometry:
        """Voxel edge, cells and channels."""
        return self.layer.geometry

    @property
    def epochs(self) -> tuple[Epoch, ...]:
        """Epochs of which some cell has a row, rising."""
        return tuple(epoch for epoch in sorted(self._rows) if len(self._rows[epoch]))

    @property
    def size_bytes(self) -> int:
        """Memory held by the rows' arrays and bytes."""
        return sum(row.size_bytes for row in self._rows.values())

    @property
    def reading_bytes(self) -> int:
        """Memory held by the readings that were made for snapshots, besides the rows."""
        return self._reading.size_bytes if self._reading else 0

    @property
    def base(self) -> EvidenceMap:
        """Evidence without a time; of a map without epochs, all of it."""
        return self._rows[BASE]

    def digest(self) -> str:
        """SHA-256, in hex, of all evidence: equal maps have equal digests, on any machine.

        Of a map without epochs it is `EvidenceMap.digest`. Else it is over the layer's digest, and for each epoch that
        has a row, rising, over its number as an int64, little-endian, and the `EvidenceMap.digest` of its rows.
        """
        if not self.layer.has_epochs:
            return self.base.digest()
        found = hashlib.sha256(self.layer.digest())
        for epoch in self.epochs:
            if (row := self._rows[epoch]).packed():
                found.update(epoch.to_bytes(8, "little", signed=True) + bytes.fromhex(row.digest()))
        return found.hexdigest()

    def merge(self, diff: Diff, *, epoch: Epoch = BASE, bodies: Bodies = NO_BODIES) -> None:
        """Add a diff to the rows of an epoch.

        Args:
            diff: packed evidence by cell.
            epoch: that of the evidence.
            bodies: bytes of the diff's cells, as far as the caller has them: they need not be encoded again.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._of(epoch).merge(diff, bodies=bodies)
        self._touched |= diff.keys()
        if self._reading is not None:
            self._reading.note(diff, epoch=epoch, sign=1)

    def unmerge(self, diff: Diff, *, epoch: Epoch = BASE) -> None:
        """Take a diff out again; it must have been merged before, else sums become negative.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._of(epoch).unmerge(diff)
        self._touched |= diff.keys()
        if self._reading is not None:
            self._reading.note(diff, epoch=epoch, sign=-1)

    def replace(
        self, key: CellKey, history: CellHistory, *, bodies: Mapping[Epoch, bytes] = NO_ROWS, came_bytes: int = 0
    ) -> None:
        """Make one cell hold exactly these rows; one that holds none takes no memory.

        Args:
            key: the cell's number.
            history: its rows from here on.
            bodies: bytes of these very rows, each as a cell file of version 1, as far as the caller has them.
            came_bytes: bytes that came for the cell.
        """
        newest = max(history, default=BASE)
        self._of(newest)  # before the others are looked at, which are bytes from then on
        gone = [epoch for epoch in self._rows.keys() - history.rows.keys() if key in self._rows[epoch]]
        changed = [epoch for epoch in history if not _is_held_as(self._of(epoch).held(key), bodies.get(epoch))]
        if self._reading is not None:
            if gone or changed not in ([], [newest]):
                self._reading.forget((key,))
            elif changed:
                # What a robot follows grows at its newest row: the reading need not be made of all rows again.
                diff = difference(history.rows[newest], self._of(newest).evidence(key), self.geometry)
                self._reading.note({key: diff}, epoch=newest, sign=1)
        for epoch in gone:
            self._rows[epoch].drop(key)
        for epoch in changed:
            row, body = history.rows[epoch], bodies.get(epoch)
            self._of(epoch).replace(key, row, body=body, came_bytes=came_bytes)
        self._shown.pop(key, None)
        self._touched.add(key)

    def show(self, key: CellKey, reading: HeldCell) -> None:
        """Show a cell as this reading, made by the server, until rows of it come (rule S6)."""
        if key not in self:
            self._shown[key] = reading

    def rest(self) -> None:
        """Hold what did not change since the last call in little memory until it changes again; once a minute, say.

        A map without epochs stays as it is.
        """
        newest = self._rows[max(self._rows)]
        if self.layer.has_epochs:
            newest.rest_cells([key for key in newest if key not in self._touched])
            if self._reading is not None:
                self._reading.rest(except_of=self._touched)
        self._touched.clear()

    def copy(self) -> "HistoryMap":
        """The same rows, unaffected by later merges; cells share their arrays until one of the two is changed."""
        copied = HistoryMap(self.layer, coding=self._coding)
        copied._rows = {epoch: row.copy() for epoch, row in self._rows.items()}
        copied._shown = dict(self._shown)
        return copied

    def frozen_cells(self, model: SensorModel) -> dict[CellKey, HeldCell]:
        """All cells as they read now, rising in number, unaffected by later changes; sums in a map without epochs."""
        if not self.layer.has_epochs:
            return self.base.frozen_cells(model)
        # Made here and not with the map: a copy needs none, and would be freed late with one, which refers to it.
        if self._reading is None:
            self._reading = MapReading(self)
        cells = self._reading.frozen_cells(model)
        # A reading cannot be made again under another model.
        shown = {key: cell for key, cell in self._shown.items() if key not in cells and is_of_model(cell, model)}
        return dict(sorted((cells | shown).items())) if shown else cells

    def frozen_times(self) -> VoxelTimes | None:
        """Times of voxels and of their samples; None in a map without epochs."""
        return MapReading(self).frozen_times()

    def rows(self, key: CellKey) -> dict[Epoch, HeldCell]:
        """Rows of one cell as they are held, to be read."""
        held = {epoch: row.held(key) for epoch, row in self._rows.items()}
        return {epoch: row for epoch, row in held.items() if row is not None}

    def history(self, key: CellKey) -> CellHistory:
        """Rows of one cell."""
        return cell_history({epoch: row.evidence(key) for epoch, row in self._rows.items() if key in row})

    def evidence(self, key: CellKey) -> Evidence:
        """Packed sum of all rows of one cell: what a map without epochs would hold (rule T5)."""
        if not self.layer.has_epochs:
            return self.base.evidence(key)
        return self.history(key).total(self.geometry)

    def packed(self) -> dict[CellKey, Evidence]:
        """`evidence` of all cells that hold any, rising in number."""
        everything = ((key, self.evidence(key)) for key in self)
        return {key: evidence for key, evidence in everything if len(evidence)}

    def cell_bytes(self, key: CellKey) -> int:
        """Memory held by one cell; 0 if there is none."""
        return sum(row.cell_bytes(key) for row in self._rows.values())

    def clear(self) -> None:
        """Drop all cells."""
        self._rows = {BASE: EvidenceMap(self.geometry, coding=self._coding)}
        self._shown.clear()
        self._touched.clear()
        self._reading = None

    def _of(self, epoch: Epoch) -> EvidenceMap:
        """Map of an epoch's rows; once a newer one begins, the others are held as bytes (rule R5)."""
        if epoch not in self._rows:
            newest = max(self._rows)
            self._rows[epoch] = EvidenceMap(self.geometry, coding=self._coding)
            self._rows[min(newest, epoch)].rest()
        return self._rows[epoch]


def _is_held_as(held: HeldCell | None, body: bytes | None) -> bool:
    """True if a row is held as these very bytes."""
    return isinstance(held, CompactCell) and held.data == body


def is_of_model(cell: HeldCell, model: SensorModel) -> bool:
    """True if a cell may be read under a sensor model: sums under any, a reading under its own."""
    return not isinstance(cell, BrickCell) or cell.odds is None or cell.odds.model == model
