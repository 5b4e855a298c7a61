"""Cells under change, within a memory bound: `BrickCell`s, which add fast, the oldest encoded when the bound is met.

A changed cell that no longer fits waits as a draft of its row, and is decoded from there when it is needed again. So
one fold may touch any number of cells. Between two folds no cell stays that takes more than `HELD_PER_BYTE` times its
bytes at rest.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.cursor import Cursor
from cairn_map.evidence.blocks import Blocks
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.cell_order import hottest_k
from cairn_map.evidence.compact_cell import HELD_PER_BYTE
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_server.folding.cells_at_rest import stamps_to_change, stored_evidence
from cairn_server.store.stamps import CellStamps
from cairn_server.store.store_rows import CellRow

CACHE_BYTES = 512 << 20
"""Memory for the cells under change of all maps."""

Step = Callable[[BrickCell, Evidence], None]
Load = Callable[[CellKey], tuple[BrickCell, CellStamps]]


class CellCache:
    """Most recently changed cells of one map, in the state of one cursor; not thread-safe."""

    def __init__(self, geometry: Geometry, *, limit_bytes: int = CACHE_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self.size_bytes = 0
        self._geometry = geometry
        self._cursor: Cursor | None = None
        self._cells: OrderedDict[CellKey, tuple[BrickCell, CellStamps]] = OrderedDict()
        self._sizes: dict[CellKey, int] = {}
        self._changed: set[CellKey] = set()
        self._drafts: dict[CellKey, CellRow] = {}
        self._costly: list[CellKey] = []
        """Cells that take too much memory for their bytes: they do not stay once they are written."""

    def begin(self, cursor: Cursor) -> None:
        """Begin to work on the map's state at a cursor; cells of any other state are dropped."""
        if cursor != self._cursor:
            self.clear()
            self._cursor = cursor

    def change(self, key: CellKey, diff: Evidence, step: Step, load: Load) -> None:
        """Merge or unmerge (`step`) a diff into a cell, which `load` reads if it is not cached.

        Raises:
            BadInputError: a sum would leave its range; nothing was changed.
        """
        cell, stamps = self._taken(key, load)
        step(cell, diff)
        self._keep(key, cell, stamps)

    def stamp(self, key: CellKey, blocks: Blocks, seq: int, load: Load) -> None:
        """Stamp these blocks of a cell with the log entry that changed them."""
        draft = self._drafts.get(key)
        if draft is not None and key not in self._cells:
            # Of a commit of more cells than fit, the first ones wait as drafts already: their sums are as they were.
            self._drafts[key] = _stamped(draft, blocks, seq, self._geometry)
            return
        # A cell whose diff was just merged is cached and marked: stamping alone neither moves nor measures it again.
        is_here = key in self._cells and key in self._changed
        cell, stamps = self._taken(key, load)
        stamps.put(blocks, seq)
        if not is_here:
            self._keep(key, cell, stamps)

    def rows(self, last_change: Mapping[CellKey, int]) -> tuple[CellRow, ...]:
        """Encoded rows of the changed cells, by rising number, each with the log entry that last changed it."""
        rows = tuple(
            replace(self._drafts.get(key) or self._encoded(key), lm=last_change[key]) for key in sorted(last_change)
        )
        self._costly = [row.key for row in rows if self._sizes.get(row.key, 0) > HELD_PER_BYTE * row.size_bytes]
        return rows

    def finish(self, cursor: Cursor) -> None:
        """Note that the changes are written: the cached cells are those of this cursor now."""
        self._cursor = cursor
        self._changed.clear()
        self._drafts.clear()
        for key in self._costly:
            self._drop(key)
        self._costly.clear()

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
        for kept in (self._cells, self._sizes, self._changed, self._drafts, self._costly):
            kept.clear()

    def limit(self, limit_bytes: int) -> None:
        """Set the memory bound, and keep to it."""
        self._limit_bytes = limit_bytes
        self.trim()

    def trim(self) -> None:
        """Drop the cells changed longest ago until the bound holds, all but the newest cell if need be."""
        while self.size_bytes > self._limit_bytes and len(self._cells) > 1:
            # The first one was changed longest ago; what is not written yet stays as a draft of its row.
            key = next(iter(self._cells))
            if key in self._changed:
                self._drafts[key] = self._encoded(key)
            self._drop(key)

    def _drop(self, key: CellKey) -> None:
        del self._cells[key]
        self.size_bytes -= self._sizes.pop(key)

    def _taken(self, key: CellKey, load: Load) -> tuple[BrickCell, CellStamps]:
        kept, draft = self._cells.get(key), self._drafts.get(key)
        # Cached, else drafted and dropped since, else in the store.
        if kept is None and draft is not None:
            cell = BrickCell(self._geometry)
            cell.merge(stored_evidence(draft))
            return cell, stamps_to_change(draft, self._geometry)
        return load(key) if kept is None else kept

    def _keep(self, key: CellKey, cell: BrickCell, stamps: CellStamps) -> None:
        # A draft is out of date with the first change after it.
        self._drafts.pop(key, None)
        self._changed.add(key)
        self._cells[key] = cell, stamps
        self._cells.move_to_end(key)
        size_bytes = cell.size_bytes + stamps.nbytes
        self.size_bytes += size_bytes - self._sizes.get(key, 0)
        self._sizes[key] = size_bytes
        self.trim()

    def _encoded(self, key: CellKey) -> CellRow:
        cell, stamps = self._cells[key]
        evidence = cell.packed()
        encoded = encode_cell(key, evidence, self._geometry)
        return CellRow(
            key=key,
            lm=stamps.newest(),
            digest=encoded.digest,
            fingerprint=fingerprint(evidence, key),
            voxels=len(evidence),
            body=encoded.data,
            size_bytes=len(encoded.data),
            stamps=stamps.encoded(),
            hottest_k=hottest_k(evidence, self._geometry),
        )


def _stamped(draft: CellRow, blocks: Blocks, seq: int, geometry: Geometry) -> CellRow:
    stamps = stamps_to_change(draft, geometry)
    stamps.put(blocks, seq)
    return replace(draft, lm=stamps.newest(), stamps=stamps.encoded())
