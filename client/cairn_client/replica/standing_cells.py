"""Cells of the server that a robot holds, by number, without their bytes; most of them stand at one state.

    together   cells at the map's own state: one cursor, one coverage, one sum of fingerprints for all
    apart      cells with a state of their own: a frame brought them elsewhere, or nothing proves theirs

A round without news moves all cells from one state of the server to the next. It changes the state of the group, and
not one entry for each cell.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from cairn_client.replica.replica_store import BaseCell, GroupedCell, StoredBases
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey


@dataclass(frozen=True, slots=True)
class Group:
    """The cells that stand together at one moment, to be compared with those of another moment."""

    version: int
    """Number of times that the group had moved, or was forgotten."""
    count: int
    """Number of its cells: of the same version it only falls."""


class StandingCells(Mapping[CellKey, BaseCell]):
    """Cells that are held, each with its state."""

    def __init__(self, stored: StoredBases, cursor: Cursor | None, coverage: VersionVector) -> None:
        """Take over stored cells, and the state of the map as a whole."""
        self.cursor = cursor
        """Cursor of the cells that stand together, and of every cell that is not held."""
        self.coverage = coverage
        """Commits in the server's map at that cursor."""
        self._apart = dict(stored.apart)
        self._together = dict(stored.together)
        self._sum = sum((cell.fingerprint for cell in self._together.values()), ZERO)
        self._version = 0

    def __getitem__(self, key: CellKey) -> BaseCell:
        grouped = self._together.get(key)
        return self._apart[key] if grouped is None else self._based(grouped)

    def __iter__(self) -> Iterator[CellKey]:
        yield from self._together
        yield from self._apart

    def __len__(self) -> int:
        return len(self._together) + len(self._apart)

    def __contains__(self, key: object) -> bool:
        return key in self._together or key in self._apart

    @property
    def apart(self) -> Mapping[CellKey, BaseCell]:
        """Cells with a state of their own."""
        return self._apart

    @property
    def group(self) -> Group:
        """The cells that stand together now."""
        return Group(self._version, len(self._together))

    @property
    def sum_together(self) -> Fingerprint:
        """Sum of the fingerprints of the cells that stand together."""
        return self._sum

    def is_together(self, key: CellKey) -> bool:
        """True if a cell is held and stands with the others."""
        return key in self._together

    def put(self, key: CellKey, cell: BaseCell) -> None:
        """Hold a cell at a state of its own."""
        self._leave(key)
        self._apart[key] = cell

    def place(self, key: CellKey, *, cursor: Cursor | None, coverage: VersionVector | None) -> None:
        """Give a held cell a state of its own, with its coverage as it is if that is None."""
        cell = self[key]
        self.put(key, replace(cell, cursor=cursor, coverage=cell.coverage if coverage is None else coverage))

    def standing_at(self, cursor: Cursor, coverage: VersionVector) -> list[CellKey]:
        """Cells apart that stand at this state."""
        return [key for key, cell in self._apart.items() if cell.cursor == cursor and cell.coverage == coverage]

    def advance(
        self, cursor: Cursor, coverage: VersionVector, *, joining: Iterable[CellKey], staying: Iterable[CellKey]
    ) -> None:
        """Move the cells that stand together, and every cell that is not held, to another state.

        Args:
            cursor: the new state.
            coverage: commits in it.
            joining: cells apart that stand with the others from here on.
            staying: cells that stand with the others, and remain where they are.
        """
        for key in list(staying):
            self.put(key, self[key])
        self.cursor, self.coverage = cursor, coverage
        self._version += 1
        for key in joining:
            cell = self._apart.pop(key)
            self._together[key] = GroupedCell(cell.fingerprint, cell.etag)
            self._sum += cell.fingerprint

    def clear(self) -> None:
        """Hold no cell, at no state."""
        self._apart.clear()
        self._together.clear()
        self.cursor, self.coverage, self._sum = None, EMPTY, ZERO
        self._version += 1

    def _leave(self, key: CellKey) -> None:
        grouped = self._together.pop(key, None)
        if grouped is not None:
            self._sum -= grouped.fingerprint

    def _based(self, grouped: GroupedCell) -> BaseCell:
        return BaseCell(self.cursor, self.coverage, grouped.fingerprint, grouped.etag)
