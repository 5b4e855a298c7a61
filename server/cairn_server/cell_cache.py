"""Cells under change, within a bound of memory: `BrickCell`s that add fast, the oldest encoded when they are too many.

A cell that was changed and does not fit any more waits as a draft of its row; asked for again it is decoded from
there. So one fold may touch any number of cells.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace

from cairn_map.brick_cell import BrickCell
from cairn_map.cell_code import encode_cell
from cairn_map.cursor import Cursor
from cairn_map.evidence import Evidence
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import CellKey, Geometry
from cairn_server.cells_at_rest import stored_evidence
from cairn_server.store_rows import CellRow

CACHE_BYTES = 512 << 20
"""Memory for the cells under change of all maps."""

Step = Callable[[BrickCell, Evidence], None]
Load = Callable[[CellKey], BrickCell]


class CellCache:
    """The cells of one map that were changed last, as they are at one cursor; not thread-safe."""

    def __init__(self, geometry: Geometry, *, limit_bytes: int = CACHE_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.size_bytes = 0
        self._geometry = geometry
        self._cursor: Cursor | None = None
        self._cells: OrderedDict[CellKey, BrickCell] = OrderedDict()
        self._sizes: dict[CellKey, int] = {}
        self._changed: set[CellKey] = set()
        self._drafts: dict[CellKey, CellRow] = {}

    def begin(self, cursor: Cursor) -> None:
        """Work on the map as it is at this cursor; cells of any other state are forgotten."""
        if cursor != self._cursor:
            self.clear()
            self._cursor = cursor

    def change(self, key: CellKey, diff: Evidence, step: Step, load: Load) -> None:
        """Merge or unmerge (`step`) a diff into a cell, which `load` brings if it is not here.

        Raises:
            BadInputError: a sum would leave its range; nothing was changed.
        """
        cell = self._cells.get(key)
        if cell is None:
            draft = self._drafts.get(key)
            cell = self._from_draft(draft) if draft else load(key)
        step(cell, diff)
        self._drafts.pop(key, None)
        self._changed.add(key)
        self._cells[key] = cell
        self._cells.move_to_end(key)
        self.size_bytes += cell.size_bytes - self._sizes.get(key, 0)
        self._sizes[key] = cell.size_bytes
        self.trim()

    def rows(self, last_change: Mapping[CellKey, int]) -> tuple[CellRow, ...]:
        """The changed cells encoded, rising in number, each with the log entry that last changed it."""
        return tuple(
            replace(self._drafts.get(key) or self._encoded(key), lm=last_change[key]) for key in sorted(last_change)
        )

    def finish(self, cursor: Cursor) -> None:
        """What was changed is written: the cells here are those of this cursor now."""
        self._cursor = cursor
        self._changed.clear()
        self._drafts.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._cursor = None
        self.size_bytes = 0
        for kept in (self._cells, self._sizes, self._changed, self._drafts):
            kept.clear()

    def trim(self) -> None:
        """Put away the cells that were not changed for longest, all but the newest if need be."""
        while self.size_bytes > self.limit_bytes and len(self._cells) > 1:
            key = next(iter(self._cells))
            if key in self._changed:
                self._drafts[key] = self._encoded(key)
            del self._cells[key]
            self.size_bytes -= self._sizes.pop(key)

    def _from_draft(self, draft: CellRow) -> BrickCell:
        cell = BrickCell(self._geometry)
        cell.merge(stored_evidence(draft))
        return cell

    def _encoded(self, key: CellKey) -> CellRow:
        evidence = self._cells[key].packed()
        encoded = encode_cell(key, evidence, self._geometry)
        return CellRow(
            key=key,
            lm=0,
            digest=encoded.digest,
            fingerprint=fingerprint(evidence, key),
            voxels=len(evidence),
            body=encoded.data,
            size_bytes=len(encoded.data),
        )
