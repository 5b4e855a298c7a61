"""A map in memory: cells by number, each a sum of evidence. Robots and servers use the same one.

map.merge(diff)      add a measurement         map.unmerge(diff)      take it out again, exactly
map.copy()           an unchanging copy, at the cost of a list of its cells
"""

from collections.abc import Callable, Iterator, Mapping

from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import CellKey, Geometry

Diff = Mapping[CellKey, Evidence]
Step = Callable[[BrickCell, Evidence], None]


class EvidenceMap:
    """Sums of evidence over any number of cells; not thread-safe."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self._cells: dict[CellKey, BrickCell] = {}

    def __iter__(self) -> Iterator[CellKey]:
        return iter(sorted(self._cells))

    def __len__(self) -> int:
        return len(self._cells)

    def __contains__(self, key: CellKey) -> bool:
        return key in self._cells

    def merge(self, diff: Diff) -> None:
        """Add a diff.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._apply(diff, BrickCell.merge, BrickCell.unmerge)

    def unmerge(self, diff: Diff) -> None:
        """Take a diff out again; it must have been merged before, else sums become negative.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        self._apply(diff, BrickCell.unmerge, BrickCell.merge)

    def replace(self, key: CellKey, evidence: Evidence) -> None:
        """Make one cell hold exactly this evidence; one that holds none takes no memory."""
        if not len(evidence):
            self._cells.pop(key, None)
            return
        cell = BrickCell(self.geometry)
        cell.merge(evidence)
        self._cells[key] = cell

    def copy(self) -> "EvidenceMap":
        """The same sums, unaffected by later merges; cells share their arrays until one of the two is changed."""
        copied = EvidenceMap(self.geometry)
        copied._cells = {key: cell.copy() for key, cell in self._cells.items()}
        return copied

    def cell(self, key: CellKey) -> BrickCell | None:
        """One cell's sums, to be read; None if there is none."""
        return self._cells.get(key)

    def evidence(self, key: CellKey) -> Evidence:
        """Packed evidence of one cell; empty if the map does not hold the cell."""
        cell = self._cells.get(key)
        return cell.packed() if cell else empty_evidence(self.geometry)

    def packed(self) -> dict[CellKey, Evidence]:
        """Packed evidence of all cells that hold any, rising in number."""
        everything = ((key, self._cells[key].packed()) for key in sorted(self._cells))
        return {key: evidence for key, evidence in everything if len(evidence)}

    def clear(self) -> None:
        """Drop all cells."""
        self._cells.clear()

    @property
    def size_bytes(self) -> int:
        """Memory held by the cells' arrays."""
        return sum(cell.size_bytes for cell in list(self._cells.values()))

    def _apply(self, diff: Diff, step: Step, undo: Step) -> None:
        cells = {key: self._cells.get(key) or BrickCell(self.geometry) for key in diff}
        done: list[CellKey] = []
        try:
            for key, evidence in diff.items():
                step(cells[key], evidence)
                done.append(key)
        except BadInputError:
            for key in done:
                undo(cells[key], diff[key])
            raise
        self._cells.update(cells)
