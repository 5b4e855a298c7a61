"""What folding needs of a store and of the server: little enough to be had from another process."""

from collections.abc import Collection, Iterable
from contextlib import AbstractContextManager
from typing import Protocol

from cairn_map.commits.ids import CommitId
from cairn_map.evidence.grid import CellKey
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import Fold, MapRow, StoredCommit


class FoldStore(Protocol):
    """The part of `store.Store` that folds are planned with, and written to."""

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """As `Store.pending`."""
        ...

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """As `Store.folded`."""
        ...

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """As `Store.is_retracted`."""
        ...

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        """As `Store.snapshot`."""
        ...

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """As `Store.fold`."""
        ...

    def audit(self, what: str, detail: str) -> None:
        """As `Store.audit`."""
        ...


class Damage(Protocol):
    """The part of `damaged_cells.DamagedCells` that folding speaks to."""

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        """These cells could not be read, nor made anew."""
        ...

    def forget(self, map_name: str, key: CellKey) -> None:
        """The cell is sound."""
        ...

    def healed(self, map_name: str) -> int:
        """How often a cell of a map was said to be sound."""
        ...
