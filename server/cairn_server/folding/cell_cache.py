"""Cells under change, within a memory bound: sums, which add fast, the oldest cells encoded when the bound is met.

A changed cell that no longer fits waits as a draft of its row, and is decoded from there when it is needed again. So
one fold may touch any number of cells. Each is decoded, changed and encoded within the room that all lanes share.
Between two folds no cell stays that takes more than `HELD_PER_BYTE` times its bytes at rest.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple, Protocol

from cairn_map.codec.cell_code import DecodedCell
from cairn_map.codec.layer_code import write_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.evidence.blocks import Blocks, blocks_of
from cairn_map.evidence.compact_cell import HELD_PER_BYTE
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_server.cell_room import changed_bytes
from cairn_server.folding.cells_at_rest import stamps_to_change
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.store.row_spool import RowSpool
from cairn_server.store.stamps import CellStamps
from cairn_server.store.store_rows import CellRow

Step = Callable[[HistoryCell, Epoch, Evidence], None]


class StoredCells(Protocol):
    """Cells of the map as they are stored."""

    def row(self, key: CellKey) -> CellRow | None:
        """Row of a cell, unchecked; None: never seen."""
        ...

    def opened(self, key: CellKey, row: CellRow | None) -> tuple[HistoryCell, CellStamps]:
        """Cell of a row, to be changed."""
        ...


class Changed(NamedTuple):
    """Diff that was added to a cell, or taken out."""

    blocks: Blocks
    digest: bytes


class CellCache:
    """Most recently changed cells of one map, in the state of one cursor; not thread-safe."""

    def __init__(
        self,
        geometry: Geometry,
        memory: FoldMemory | None = None,
        *,
        limit_bytes: int | None = None,
        more: Callable[[], int] = int,
    ) -> None:
        """A cache of a map, which keeps as much as there is memory for cells, or less.

        `more` is asked when that is full: bytes that it may have from now on, for which another map's cells were
        dropped; 0: none.
        """
        self._memory = memory or FoldMemory()
        self._more = more
        self._limit_bytes = self._memory.cells_bytes if limit_bytes is None else limit_bytes
        self.size_bytes = 0
        self._geometry = geometry
        self._cursor: Cursor | None = None
        self._cells: OrderedDict[CellKey, tuple[HistoryCell, CellStamps]] = OrderedDict()
        self._sizes: dict[CellKey, int] = {}
        self._changed: set[CellKey] = set()
        self._drafts = self._memory.spool()
        self._costly: list[CellKey] = []
        """Cells that take too much memory for their bytes: they do not stay once they are written."""

    def begin(self, cursor: Cursor) -> None:
        """Begin to work on the map's state at a cursor; cells of any other state are dropped."""
        if cursor != self._cursor:
            self.clear()
            self._cursor = cursor

    def change(
        self,
        key: CellKey,
        voxels: int,
        read: Callable[[], DecodedCell],
        step: Step,
        stored: StoredCells,
        *,
        epoch: Epoch = BASE,
    ) -> Changed:
        """Merge or unmerge (`step`) a diff of so many voxels, which `read` decodes, into a cell's row of an epoch.

        Raises:
            BadInputError: a sum would leave its range; nothing was changed.
        """
        row = self._row(key, stored)
        known = row.voxels if row is not None else 0
        with self._memory.room.of(changed_bytes(self._geometry, voxels + known)):
            diff = read()
            cell, stamps = self._cells.get(key) or stored.opened(key, row)
            step(cell, epoch, diff.evidence)
            changed = Changed(blocks_of(diff.evidence), diff.digest)
            del diff
        self._keep(key, cell, stamps)
        return changed

    def stamp(self, key: CellKey, blocks: Blocks, seq: int, stored: StoredCells) -> None:
        """Stamp these blocks of a cell with the log entry that changed them."""
        draft = self._drafts.get(key)
        if draft is not None and key not in self._cells:
            # Of a commit of more cells than fit, the first ones wait as drafts already: their sums are as they were.
            self._drafts.put(_stamped(draft, blocks, seq, self._geometry))
            return
        # A cell whose diff was just merged is cached and marked: stamping alone neither moves nor measures it again.
        is_here = key in self._cells and key in self._changed
        row = self._row(key, stored)
        with self._memory.room.of(changed_bytes(self._geometry, row.voxels if row is not None else 0)):
            cell, stamps = self._cells.get(key) or stored.opened(key, row)
        stamps.put(blocks, seq)
        if not is_here:
            self._keep(key, cell, stamps)

    def rows(self, last_change: Mapping[CellKey, int]) -> RowSpool:
        """Encoded rows of the changed cells, each with the log entry that last changed it; until `finish`."""
        for key, lm in last_change.items():
            row = replace(self._drafts.get(key) or self._encoded(key), lm=lm)
            self._drafts.put(row)
            if self._sizes.get(key, 0) > HELD_PER_BYTE * row.size_bytes:
                self._costly.append(key)
        # A cell that was changed and changed back is as it was.
        for key in self._changed - last_change.keys():
            self._drafts.drop(key)
        return self._drafts

    def finish(self, cursor: Cursor) -> None:
        """Note that the changes are written: the cached cells are those of this cursor now."""
        self._cursor = cursor
        self._changed.clear()
        self._drafts = self._memory.spool()
        for key in self._costly:
            self._drop(key)
        self._costly.clear()
        # A cell that is too large by itself stayed for the fold alone.
        if self.size_bytes > self._limit_bytes and len(self._cells) == 1:
            self._drop(next(iter(self._cells)))

    def moved(self, base: Cursor, cursor: Cursor, keys: Iterable[CellKey]) -> None:
        """Note that another plan changed these cells, from the state of `base` to that of a cursor."""
        if self._cursor != base:
            return  # `begin` drops them all
        self._cursor = cursor
        for key in keys:
            if key in self._cells:
                self._drop(key)

    def __contains__(self, key: object) -> bool:
        return key in self._cells

    def clear(self) -> None:
        """Drop all cells."""
        self._cursor = None
        self.size_bytes = 0
        self._drafts = self._memory.spool()
        for kept in (self._cells, self._sizes, self._changed, self._costly):
            kept.clear()

    def limit(self, limit_bytes: int) -> None:
        """Set the memory bound, and keep to it."""
        self._limit_bytes = limit_bytes
        self.trim()

    def trim(self) -> None:
        """Drop the cells changed longest ago until the bound holds, all but the newest cell if need be."""
        while self.size_bytes > self._limit_bytes and len(self._cells) > 1 and (more_bytes := self._more()):
            self._limit_bytes += more_bytes
        while self.size_bytes > self._limit_bytes and len(self._cells) > 1:
            # The first one was changed longest ago; what is not written yet stays as a draft of its row.
            key = next(iter(self._cells))
            if key in self._changed:
                self._drafts.put(self._encoded(key))
            self._drop(key)

    def _drop(self, key: CellKey) -> None:
        del self._cells[key]
        self.size_bytes -= self._sizes.pop(key)

    def _row(self, key: CellKey, stored: StoredCells) -> CellRow | None:
        """Row of which a cell is made that is not cached: drafted and dropped since, else in the store."""
        return None if key in self._cells else self._drafts.get(key) or stored.row(key)

    def _keep(self, key: CellKey, cell: HistoryCell, stamps: CellStamps) -> None:
        # A draft is out of date with the first change after it.
        self._drafts.drop(key)
        self._changed.add(key)
        self._cells[key] = cell, stamps
        self._cells.move_to_end(key)
        self._measure(key)
        self.trim()

    def _measure(self, key: CellKey) -> None:
        cell, stamps = self._cells[key]
        size_bytes = cell.size_bytes + stamps.nbytes
        self.size_bytes += size_bytes - self._sizes.get(key, 0)
        self._sizes[key] = size_bytes

    def _encoded(self, key: CellKey) -> CellRow:
        cell, stamps = self._cells[key]
        # One row at a time is packed and encoded, of no more voxels than it has bricks for.
        with self._memory.room.of(changed_bytes(self._geometry, cell.voxels_max)):
            written = write_cell(cell)
        # Rows that commits hardly ever come to rest as the bytes that were just made of them.
        cell.rest()
        self._measure(key)
        return CellRow(
            key=key,
            lm=stamps.newest(),
            digest=written.digest,
            fingerprint=written.fingerprint,
            voxels=written.voxels,
            body=written.data,
            size_bytes=len(written.data),
            stamps=stamps.encoded(),
            hottest_k=written.hottest_k,
            history_bytes=written.history_bytes,
        )


def _stamped(draft: CellRow, blocks: Blocks, seq: int, geometry: Geometry) -> CellRow:
    stamps = stamps_to_change(draft, geometry)
    stamps.put(blocks, seq)
    return replace(draft, lm=stamps.newest(), stamps=stamps.encoded())
