"""Cells as they were read last, decoded: the same few are asked for by every robot of a team."""

import threading
from collections import OrderedDict

from cairn_map.errors import DamagedDataError
from cairn_map.evidence import Evidence
from cairn_map.grid import Geometry, cell_of_key
from cairn_server.cells_at_rest import stored_evidence, stored_stamps
from cairn_server.stamps import Stamps
from cairn_server.store import Snapshot
from cairn_server.store_rows import CellRow

CACHE_BYTES = 256 << 20
"""Memory for the decoded cells of all maps."""

Read = tuple[Evidence, Stamps]


class ReadCache:
    """Decoded cells by what they hold, the oldest forgotten; thread-safe. Nobody changes what it hands out."""

    def __init__(self, *, limit_bytes: int = CACHE_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._lock = threading.Lock()
        self._cells: OrderedDict[tuple[bytes, bytes, int], Read] = OrderedDict()
        self._size_bytes = 0

    def read(self, snapshot: Snapshot, listed: CellRow, geometry: Geometry) -> Read:
        """A listed cell's evidence and stamps.

        Raises:
            DamagedDataError: kind `damaged_store`: the cell at rest is not sound.
        """
        name = (snapshot.head.cursor.log_id, listed.digest, listed.lm)
        with self._lock:
            if name in self._cells:
                self._cells.move_to_end(name)
                return self._cells[name]
        stored = snapshot.cell(listed.key)
        if stored is None:
            raise DamagedDataError("damaged_store", f"cell {cell_of_key(listed.key)} is listed, but is not there")
        found = stored_evidence(stored), stored_stamps(stored, geometry)
        with self._lock:
            if name not in self._cells:
                self._cells[name] = found
                self._size_bytes += _size_bytes(found)
            while self._size_bytes > self._limit_bytes and self._cells:
                self._size_bytes -= _size_bytes(self._cells.popitem(last=False)[1])
        return found


def _size_bytes(read: Read) -> int:
    return read[0].size_bytes + read[1].nbytes
