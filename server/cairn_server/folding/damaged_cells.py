"""Damaged cells: the record of those that the log cannot rebuild, and the ways to heal one.

A cell's digest is a SHA-256 that is stored apart from its bytes: bytes of that digest are the cell, whether or not the
client that sends them is trusted. The record is in memory only: after a start a cell is found damaged again as soon as
it is read or folded into.
"""

import logging
import threading
from collections.abc import Iterable
from itertools import islice

from cairn_map.codec.cell_code import decode_canonical_cell
from cairn_map.codec.cell_reading import VOXEL_BYTES
from cairn_map.codec.history_code import check_canonical_history
from cairn_map.codec.layer_code import WrittenCell, read_cell, write_cell
from cairn_map.errors import BadInputError, CairnError, ConflictError, DamagedDataError, NotFoundError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import DAMAGED_MAX
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells_at_rest import sound_cell, with_bytes
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow

log = logging.getLogger(__name__)

Damaged = list[tuple[tuple[int, int, int], str]]
"""Damaged cells as a reply's header names them: each cell, and the fingerprint of its lost content."""


class DamagedCells:
    """Record of the damaged cells of all maps; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[str, set[CellKey]] = {}
        self._healed: dict[str, int] = {}

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        """Record cells that can be neither read nor rebuilt."""
        with self._lock:
            self._found.setdefault(map_name, set()).update(keys)

    def forget(self, map_name: str, key: CellKey) -> None:
        """Record that a cell is sound."""
        with self._lock:
            self._found.get(map_name, set()).discard(key)
            self._healed[map_name] = self._healed.get(map_name, 0) + 1

    def healed(self, map_name: str) -> int:
        """Count of the times that a cell of a map became sound: when it grows, damaged cells are worth a new look."""
        with self._lock:
            return self._healed.get(map_name, 0)

    def of(self, map_name: str) -> frozenset[CellKey]:
        """Damaged cells of a map, as far as they were read or folded into."""
        with self._lock:
            return frozenset(self._found.get(map_name, ()))


def as_named(snapshot: Snapshot, keys: frozenset[CellKey]) -> Damaged:
    """Damaged cells for a reply's header, at most `DAMAGED_MAX`; fingerprints are stored apart from the bytes."""
    if not keys:
        return []
    found = ((cell_of_key(cell.key), cell.fingerprint.hex()) for cell in snapshot.cells_of(keys))
    return list(islice(found, DAMAGED_MAX))


def keep_healed(store: Store, row: MapRow, cells: Iterable[CellRow]) -> None:
    """Write cells that were rebuilt from the log over the damaged ones; a failure is logged only."""
    for cell in cells:
        try:
            if store.health.heal(row, cell):
                store.audit("healed_cell", f"map {row.name}: {cell_of_key(cell.key)} rebuilt from its commits")
        except CairnError as exc:
            log.error("cell %s was rebuilt, but cannot be written: %s", cell_of_key(cell.key), exc.message)


def heal_cell(store: Store, row: MapRow, key: CellKey, data: bytes, *, by: str, client: str = "") -> bool:
    """Replace a damaged cell by these bytes; False if the cell is sound and nothing is written.

    Raises:
        NotFoundError: kind `no_cell`: the cell was never seen.
        ConflictError: kind `other_cell`: the bytes are not those of the lost cell.
        DamagedDataError, BadInputError: the bytes are no cell of this map.
    """
    # Sound, or rebuilt from the log: nothing to do. Else its row, without its bytes.
    with store.snapshot(row) as snapshot:
        healed: list[CellRow] = []
        try:
            if sound_cell(snapshot, key, row.layer, healed) is None:
                raise NotFoundError("no_cell", f"no robot has seen cell {cell_of_key(key)} of map {row.name}")
            stored = None
        except DamagedDataError:
            stored = _row_of(snapshot, key)
    if stored is None:
        keep_healed(store, row, healed)
        return False
    written = _canonical(data, key, row, voxels=stored.voxels)
    if written.digest != stored.digest:
        raise ConflictError(
            "other_cell",
            f"cell {cell_of_key(key)} had digest {stored.digest.hex()} at entry {stored.lm}, the body has "
            f"{written.digest.hex()}",
        )
    # Write it, unless a fold changed the cell meanwhile.
    sound = with_bytes(stored, written)
    if not store.health.heal(row, sound):
        return False
    detail = f"map {row.name}: {cell_of_key(key)} from {len(data)} bytes that were sent"
    store.audit_log.add(by, "healed_cell", detail, client=client)
    return True


def _canonical(data: bytes, key: CellKey, row: MapRow, *, voxels: int) -> WrittenCell:
    """These bytes as a cell of a map that had so many voxels, and all that follows from them.

    Raises:
        BadInputError: kind `bad_cell`: they are another cell, or of another map; or as `decode_canonical_cell`.
        DamagedDataError: they are no canonical cell.
    """
    # Decode within the memory that a cell of as many voxels can need: what claims more is another cell.
    limit_bytes = voxels * (VOXEL_BYTES + 4 + 8 * row.geometry.plane_count)
    with DECODING.of_cell(row.geometry, voxels):
        if row.layer.has_epochs:
            check_canonical_history(data, evidence_bytes_max=limit_bytes)
        else:
            decode_canonical_cell(data, evidence_bytes_max=limit_bytes)
        try:
            return write_cell(read_cell(data, key, row.layer))
        except DamagedDataError as exc:  # sound, and so another cell
            raise BadInputError(
                "bad_cell", f"the body is no cell {cell_of_key(key)} of map {row.name}: {exc.message}"
            ) from exc


def _row_of(snapshot: Snapshot, key: CellKey) -> CellRow | None:
    """Row of a cell from the listing, without its bytes, which may be unreadable."""
    return next(iter(snapshot.cells_of([key])), None)
