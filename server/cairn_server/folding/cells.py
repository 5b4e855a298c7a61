"""Cells of a store, read for one request: sound, or as they lie in the store.

A damaged cell is rebuilt from the log (`cells_at_rest.sound_cell`), healed by bytes that a client still has, or noted
as damaged, so that robots are asked for it.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from cairn_map.evidence.grid import CellKey
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.folding.damaged_cells import DamagedCells, heal_cell, keep_healed
from cairn_server.store.history import head_of
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, Head, MapRow


@dataclass(slots=True)
class CellFaults:
    """Cells met while one answer was read that are damaged, or away."""

    healed: list[CellRow] = field(default_factory=list)
    """Sound rows of the cells that were rebuilt from the log, to be written back."""
    damaged: set[CellKey] = field(default_factory=set)
    """Cells that could not be rebuilt."""
    away: int = 0
    """Count of the cells that are in an object store, which does not answer."""


class Cells:
    """Cells of all maps of one store; called from many threads."""

    def __init__(self, store: Store, damaged: DamagedCells, *, on_heal: Callable[[], None]) -> None:
        """`on_heal` is called after a client healed a cell: commits may wait to be folded into it."""
        self._store = store
        self._damaged = damaged
        self._on_heal = on_heal
        self._healing = threading.Lock()

    @contextmanager
    def reading(self, row: MapRow) -> Iterator[CellFaults]:
        """Collector of damaged cells for the length of a `with`, around a snapshot of the same map.

        At the end, when the snapshot is closed, rebuilt cells are written back and the others are noted as damaged.
        """
        faults = CellFaults()
        try:
            yield faults
        except DamagedCellError as exc:
            self._damaged.note(row.name, [exc.key])
            raise
        keep_healed(self._store, row, faults.healed)
        self._damaged.note(row.name, faults.damaged)

    def sound(self, row: MapRow, key: CellKey) -> tuple[CellRow | None, Head]:
        """One cell (None: never seen), found sound, and the state that it was read from.

        Raises:
            DamagedCellError: kind `damaged_store`: it is damaged and cannot be rebuilt from the log.
        """
        with self.reading(row) as faults, self._store.snapshot(row) as snapshot:
            return sound_cell(snapshot, key, row.layer, faults.healed), head_of(snapshot)

    def unchecked(self, row: MapRow, key: CellKey) -> tuple[CellRow | None, Head]:
        """One cell whose bytes may be damaged: for callers that decode them, or need the digest only.

        Raises:
            DamagedDataError: kind `damaged_store`: it cannot be read at all.
        """
        with self._store.snapshot(row) as snapshot:
            return snapshot.cell(key), head_of(snapshot)

    def damaged(self, row: MapRow) -> frozenset[CellKey]:
        """Cells of a map known to be damaged."""
        return self._damaged.of(row.name)

    def heal(self, row: MapRow, key: CellKey, data: bytes, *, by: str, client: str = "") -> bool:
        """Replace a damaged cell by bytes that a client still has; False if the cell is sound.

        Raises:
            CairnError: as `damaged_cells.heal_cell`.
        """
        with self._healing:
            is_healed = heal_cell(self._store, row, key, data, by=by, client=client)
        self._damaged.forget(row.name, key)
        self._on_heal()
        return is_healed
