"""Parts of a map as files that leave: made cell by cell while they are sent, of one state of the map.

Nothing is read from the store while a link is slow: the chosen cells, a few bytes a voxel, are first laid aside in a
temporary file, and their points counted, because point clouds begin with their number. The file is gone as soon as
the answer is, however it ends. So an export needs the memory of one cell, whatever its size.
"""

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO

from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.export_request import ExportRequest
from cairn_map.grid import CellKey
from cairn_map.map_points import cell_may_have, count_of_cell, point_file, points_of_cell, size_of_file
from cairn_server.cells_at_rest import DamagedCellError, decode_stored, sound_cell, stored_evidence
from cairn_server.damaged_cells import DamagedCells
from cairn_server.healing import keep_healed
from cairn_server.store import Snapshot, Store
from cairn_server.store_rows import CellRow, Head, MapRow

VOXELS_EXPORTED_MAX = 1 << 28
"""Known voxels of the cells that are looked at."""
COUNT_S = 60.0
COUNTS_AT_ONCE = 2
WAIT_S = 5.0
"""For one that is being counted to end."""


@dataclass(frozen=True, slots=True)
class Export:
    """A file on its way: the state that it is of, its size (None: not known yet), and its bytes."""

    head: Head
    count: int
    size_bytes: int | None
    parts: Iterator[bytes]


class MapExports:
    """Exports of a store; thread-safe."""

    def __init__(self, store: Store, damaged: DamagedCells) -> None:
        self._store = store
        self._damaged = damaged
        self._room = threading.BoundedSemaphore(COUNTS_AT_ONCE)

    def asked(self, row: MapRow, asked: ExportRequest) -> Export:
        """What is asked for, of the map as it is now.

        Raises:
            BadInputError: kind `bad_box`, `bad_style`; `too_large`: the cells have too many voxels; `too_costly`.
            UnreachableError: kind `busy`: others are being counted.
            DamagedCellError: kind `damaged_store`: a chosen cell is damaged.
        """
        asked.depth_in(row.geometry)
        asked.bounds_m()
        healed: list[CellRow] = []
        with self._turn(), self._store.snapshot(row) as snapshot:
            head = snapshot.head
            aside = tempfile.TemporaryFile()  # noqa: SIM115 - goes with its last reader
            try:
                sizes, count = _laid_aside(aside, snapshot, row, asked, healed)
            except BaseException as exc:
                aside.close()
                if isinstance(exc, DamagedCellError):
                    self._damaged.note(row.name, [exc.key])
                raise
        keep_healed(self._store, row, healed)
        about = _about(row, asked)
        tables = (
            points_of_cell(key, decode_stored(key, body).evidence, row.geometry, row.sensor_model, asked)
            for key, body in _bodies(aside, sizes)
        )
        size_bytes = size_of_file(asked.format, count, about)
        return Export(head, count, size_bytes, point_file(asked.format, count, tables, about))

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._room.acquire(timeout=WAIT_S):
            raise UnreachableError("busy", "other exports are being counted", retry_after_s=1.0)
        try:
            yield
        finally:
            self._room.release()


def _laid_aside(
    aside: IO[bytes], snapshot: Snapshot, row: MapRow, asked: ExportRequest, healed: list[CellRow]
) -> tuple[list[tuple[CellKey, int]], int]:
    """Cells that have what is asked for, with the sizes of their bytes; and how many points."""
    until_s = time.monotonic() + COUNT_S
    voxels, count, sizes = 0, 0, list[tuple[CellKey, int]]()
    for listed in snapshot.cells():
        if not listed.voxels or not cell_may_have(listed.key, row.geometry, asked):
            continue
        voxels += listed.voxels
        if voxels > VOXELS_EXPORTED_MAX:
            raise BadInputError(
                "too_large", f"more than {VOXELS_EXPORTED_MAX} voxels are in these cells; ask for a box"
            )
        if time.monotonic() > until_s:
            raise BadInputError("too_costly", f"counting the points takes more than {COUNT_S:g} s; ask for a box")
        stored = sound_cell(snapshot, listed.key, row.geometry, healed)
        if stored is None:
            raise DamagedCellError(listed.key, "a cell is listed, but is not there")
        found = count_of_cell(stored.key, stored_evidence(stored), row.geometry, row.sensor_model, asked)
        if found:
            aside.write(stored.body)
            sizes.append((stored.key, len(stored.body)))
            count += found
    return sizes, count


def _bodies(aside: IO[bytes], sizes: list[tuple[CellKey, int]]) -> Iterator[tuple[CellKey, bytes]]:
    with aside:
        aside.seek(0)
        for key, size_bytes in sizes:
            yield key, aside.read(size_bytes)


def _about(row: MapRow, asked: ExportRequest) -> str:
    edge_m = row.geometry.voxel_edge_m * 2 ** (row.geometry.depth - asked.depth_in(row.geometry))
    return f"map {row.name}, nodes of {edge_m:g} m; metres, map frame; kelvin"
