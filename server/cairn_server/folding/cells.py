"""Cells of a store, read for one request: sound, or as they lie there."""

from cairn_map.evidence.grid import CellKey
from cairn_server.folding.cells_at_rest import DamagedCellError, sound_cell
from cairn_server.folding.damaged_cells import DamagedCells, keep_healed
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, Head, MapRow


class Cells:
    """Cells of all maps of one store; a damaged one is healed from the log, or noted as damaged."""

    def __init__(self, store: Store, damaged: DamagedCells) -> None:
        self._store = store
        self._damaged = damaged

    def sound(self, row: MapRow, key: CellKey) -> tuple[CellRow | None, Head]:
        """One cell (None: never seen) and the state that it was read from.

        Raises:
            DamagedCellError: kind `damaged_store`: it is damaged, and nothing here says what it was.
        """
        healed: list[CellRow] = []
        try:
            with self._store.snapshot(row) as snapshot:
                found, head = sound_cell(snapshot, key, row.geometry, healed), snapshot.head
        except DamagedCellError:
            self._damaged.note(row.name, [key])
            raise
        keep_healed(self._store, row, healed)
        return found, head

    def unchecked(self, row: MapRow, key: CellKey) -> tuple[CellRow | None, Head]:
        """One cell whose bytes may be damaged: for callers that decode them, or want no more than the digest.

        Raises:
            DamagedDataError: kind `damaged_store`: it cannot be read at all.
        """
        with self._store.snapshot(row) as snapshot:
            return snapshot.cell(key), snapshot.head
