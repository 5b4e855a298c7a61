"""A map in memory: cells by number, each a sum of evidence. Robots and servers use the same one.

map.merge(diff)      add a measurement         map.unmerge(diff)      take it out again, exactly
map.copy()           an unchanging copy, at the cost of a list of its cells

A map that is given a `coding` holds no cell in more than `HELD_PER_BYTE` times the bytes that came for it: beyond that
it keeps the cell's bytes, and decodes them where they are read or changed, one cell at a time.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.compact_cell import HELD_PER_BYTE, CellCoding, CompactCell, HeldCell, VoxelTimes, opened
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

Diff = Mapping[CellKey, Evidence]
Bodies = Mapping[CellKey, bytes]
Step = Callable[[BrickCell, Evidence], None]
NO_BODIES: Bodies = MappingProxyType({})


class _Entry(NamedTuple):
    """One cell of a map."""

    cell: HeldCell
    came_bytes: int
    """Bytes that came for it, at least."""
    size_bytes: int


class EvidenceMap:
    """Sums of evidence over any number of cells; not thread-safe."""

    def __init__(self, geometry: Geometry, *, coding: CellCoding | None = None) -> None:
        """Make an empty map; without a `coding` every cell is held as sums, however few bytes came for it."""
        self.geometry = geometry
        self._coding = coding
        self._cells: dict[CellKey, _Entry] = {}
        self._size_bytes = 0
        self._rests = False
        """True if every cell is held as its bytes."""

    def __iter__(self) -> Iterator[CellKey]:
        return iter(sorted(self._cells))

    def __len__(self) -> int:
        return len(self._cells)

    def __repr__(self) -> str:
        return f"EvidenceMap({len(self)} cells, {self._size_bytes} bytes, {self.geometry})"

    def __contains__(self, key: CellKey) -> bool:
        return key in self._cells

    def __eq__(self, other: object) -> bool:
        """True for the same evidence in the same grid, however it came together."""
        if not isinstance(other, EvidenceMap):
            return NotImplemented
        return self.geometry == other.geometry and self.digest() == other.digest()

    __hash__ = None  # type: ignore[assignment]  # it changes

    def digest(self) -> str:
        """SHA-256, in hex, of all evidence: equal maps have equal digests, on any machine.

        It is over the geometry's digest, and for each cell that holds evidence, rising in number, over its number and
        its packed arrays (`Evidence`): their lengths and numbers as little-endian int64.
        """
        found = hashlib.sha256(self.geometry.digest())
        for key in sorted(self._cells):
            evidence = self._cells[key].cell.packed()
            if len(evidence):
                found.update(np.array([key, len(evidence), len(evidence.sampled)], "<i8").tobytes())
                for array in (evidence.voxels, evidence.counts, evidence.sampled, evidence.samples):
                    found.update(np.ascontiguousarray(array, "<i8").data)
        return found.hexdigest()

    def merge(self, diff: Diff, *, bodies: Bodies = NO_BODIES) -> None:
        """Add a diff.

        Args:
            diff: packed evidence by cell.
            bodies: bytes of the same cells, as far as the caller has them: they need not be encoded again.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._apply(diff, BrickCell.merge, BrickCell.unmerge, bodies)

    def unmerge(self, diff: Diff) -> None:
        """Take a diff out again; it must have been merged before, else sums become negative.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._apply(diff, BrickCell.unmerge, BrickCell.merge, NO_BODIES)

    def replace(self, key: CellKey, evidence: Evidence, *, body: bytes | None = None, came_bytes: int = 0) -> None:
        """Make one cell hold exactly this evidence; one that holds none takes no memory.

        Args:
            key: the cell's number.
            evidence: its evidence from here on.
            body: bytes of this very evidence, if the caller has them.
            came_bytes: bytes that came for the evidence, if it is a sum.
        """
        self._forget(key)
        if len(evidence):
            cell = BrickCell(self.geometry)
            cell.merge(evidence)
            self._hold(key, cell, body=body, came_bytes=came_bytes)

    def drop(self, key: CellKey) -> None:
        """Hold nothing of a cell."""
        self._forget(key)

    def rest(self) -> None:
        """Hold every cell as its bytes from here on: little memory, and each change decodes and encodes one.

        Without a coding the map stays as it is.
        """
        self._rests = self._coding is not None
        self.rest_cells(list(self._cells))

    def rest_cells(self, keys: Iterable[CellKey]) -> None:
        """Hold some cells as their bytes until they change."""
        for key in keys:
            entry = self._cells[key]
            if self._coding is not None and isinstance(entry.cell, BrickCell):
                body = self._coding.encode(key, entry.cell.packed())
                came_bytes = max(entry.came_bytes, len(body))
                self._put(key, CompactCell(body, self.geometry, self._coding), came_bytes)

    def copy(self) -> "EvidenceMap":
        """The same sums, unaffected by later merges; cells share their arrays until one of the two is changed."""
        copied = EvidenceMap(self.geometry, coding=self._coding)
        for key, entry in self._cells.items():
            cell = entry.cell.copy() if isinstance(entry.cell, BrickCell) else entry.cell
            copied._cells[key] = entry._replace(cell=cell)
        copied._size_bytes, copied._rests = self._size_bytes, self._rests
        return copied

    def frozen_cells(self, model: SensorModel) -> dict[CellKey, HeldCell]:
        """All cells, rising in number, unaffected by later merges: sums, which any sensor model may read."""
        copied = self.copy()
        return {key: copied._cells[key].cell for key in copied}

    def frozen_times(self) -> VoxelTimes | None:
        """Times at which voxels were seen: None, because sums have none."""
        return None

    def held(self, key: CellKey) -> HeldCell | None:
        """One cell as it is held, to be read; None if there is none."""
        entry = self._cells.get(key)
        return entry.cell if entry else None

    def cell(self, key: CellKey) -> BrickCell | None:
        """One cell's sums, to be read; None if there is none."""
        entry = self._cells.get(key)
        return opened(entry.cell) if entry else None

    def cell_bytes(self, key: CellKey) -> int:
        """Memory held by one cell; 0 if there is none."""
        entry = self._cells.get(key)
        return entry.size_bytes if entry else 0

    def evidence(self, key: CellKey) -> Evidence:
        """Packed evidence of one cell; empty if the map does not hold the cell."""
        entry = self._cells.get(key)
        return entry.cell.packed() if entry else empty_evidence(self.geometry)

    def packed(self) -> dict[CellKey, Evidence]:
        """Packed evidence of all cells that hold any, rising in number."""
        everything = ((key, self._cells[key].cell.packed()) for key in sorted(self._cells))
        return {key: evidence for key, evidence in everything if len(evidence)}

    def clear(self) -> None:
        """Drop all cells."""
        self._cells.clear()
        self._size_bytes = 0

    @property
    def size_bytes(self) -> int:
        """Memory held by the cells' arrays and bytes."""
        return self._size_bytes

    def _apply(self, diff: Diff, step: Step, undo: Step, bodies: Bodies) -> None:
        # Cell by cell, so that of the cells held as bytes no more than one is open.
        before: dict[CellKey, _Entry | None] = {}
        try:
            for key, evidence in diff.items():
                entry = self._cells.get(key)
                sums = opened(entry.cell) if entry else BrickCell(self.geometry)
                step(sums, evidence)
                before[key] = entry
                body = bodies.get(key)
                came_bytes = (entry.came_bytes if entry else 0) + len(body or b"")
                is_all = entry is None and step is BrickCell.merge
                self._hold(key, sums, body=body if is_all else None, came_bytes=came_bytes)
        except BadInputError:
            for key, entry in before.items():
                self._take_back(key, entry, diff[key], undo)
            raise

    def _take_back(self, key: CellKey, before: _Entry | None, evidence: Evidence, undo: Step) -> None:
        """Make a changed cell what it was."""
        self._forget(key)
        if before is not None:
            if isinstance(before.cell, BrickCell):
                undo(before.cell, evidence)
            self._put(key, before.cell, before.came_bytes)

    def _hold(self, key: CellKey, sums: BrickCell, *, body: bytes | None, came_bytes: int) -> None:
        """Hold a cell's sums, or its bytes if too few came for them; `body` are those of just these sums."""
        came_bytes = max(came_bytes, len(body or b""))
        cell: HeldCell = sums
        if self._coding is not None and (self._rests or sums.size_bytes > HELD_PER_BYTE * came_bytes):
            body = self._coding.encode(key, sums.packed()) if body is None else body
            came_bytes = max(came_bytes, len(body))
            if self._rests or sums.size_bytes > HELD_PER_BYTE * came_bytes:
                cell = CompactCell(body, self.geometry, self._coding)
        self._put(key, cell, came_bytes)

    def _put(self, key: CellKey, cell: HeldCell, came_bytes: int) -> None:
        before = self._cells.get(key)
        self._cells[key] = _Entry(cell, came_bytes, cell.size_bytes)
        self._size_bytes += cell.size_bytes - (before.size_bytes if before else 0)

    def _forget(self, key: CellKey) -> None:
        entry = self._cells.pop(key, None)
        self._size_bytes -= entry.size_bytes if entry else 0
