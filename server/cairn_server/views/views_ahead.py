"""Coarse views of all cells, made before a page asks: the first picture of a map is there at once.

    start   -->  what the file beside the store has
    folded  -->  a moment later, cell by cell with pauses between, what changed
    as soon as there are any, now and then, and at the end  -->  the file, if the disk has room

One thread. The first views of a new start are made at once: who looks then would wait for them. From then on it takes a
quarter of a core at the most, and less than that from who pushes: a cell that changes all the time is made once in some
seconds.
"""

import logging
import math
import threading
import time
from pathlib import Path

from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.views.cell_view import view_of_stored
from cairn_server.views.view_cache import ViewCache, view_name
from cairn_server.views.view_file import read_views, write_views

log = logging.getLogger(__name__)

DEPTHS_ABOVE_VOXELS = 3
"""Of the views that pages ask for first: COARSE in console/src/scene/detail.ts."""
LOOK_EVERY_S = 3.0
PAUSE_SHARE = 3.0
"""After each view, of the time that it took."""
AT_ONCE = 100
"""Views without a pause, with every start: some two seconds."""
FILE_BYTES_MAX = 1 << 24
WRITE_EVERY_S = 300.0


def first_depth(depth: int) -> int:
    """Depth at which a page asks first for a cell of so many."""
    return max(depth - DEPTHS_ABOVE_VOXELS, 1)


class ViewsAhead:
    """Makes and keeps views of a store's maps until closed."""

    def __init__(
        self,
        store: Store,
        views: ViewCache,
        folder: Path,
        *,
        look_every_s: float = LOOK_EVERY_S,
        free_bytes_min: int = 0,
    ) -> None:
        """`free_bytes_min` of the folder's disk are left for pushes, and the file is not written."""
        self._store = store
        self._views = views
        self._folder = folder
        self._look_every_s = look_every_s
        self._seen: dict[int, tuple[bytes, int]] = {}
        """By map: log and entry up to which all cells' views were made."""
        self._free_bytes_min = free_bytes_min
        self._at_once = AT_ONCE
        self._written, self._write_s = 0, -math.inf
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-views", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop, and write the file."""
        self._closing.set()
        self._thread.join()
        self._write()

    def _run(self) -> None:
        self._views.put(read_views(self._folder))
        self._written = self._views.made
        cell_of_key(
            cell_key((0, 0, 0))
        )  # Numba takes half a second to load the first kernel, which else the first page waits for
        while not self._closing.is_set():
            for row in self._rows():
                self._make_all(row)
            if time.monotonic() - self._write_s > WRITE_EVERY_S:
                self._write()
            self._closing.wait(self._look_every_s)

    def _rows(self) -> list[MapRow]:
        try:
            return self._store.maps()
        except CairnError as exc:
            log.info("views cannot be made ahead now: %s", exc.message)
        except Exception:
            log.exception("views cannot be made ahead now")
        return []

    def _make_all(self, row: MapRow) -> None:
        """A map that cannot be read leaves the others theirs."""
        try:
            self._make(row)
        except CairnError as exc:
            log.info("views of map %s cannot be made ahead now: %s", row.name, exc.message)
        except Exception:
            log.exception("views of map %s cannot be made ahead now", row.name)

    def _make(self, row: MapRow) -> None:
        """The views of the cells that changed since the last look."""
        depth = first_depth(row.geometry.depth)
        with self._store.snapshot(row) as snapshot:
            cursor = snapshot.head.cursor
            log_id, seq = self._seen.get(row.number, (cursor.log_id, -1))
            if (log_id, seq) == (cursor.log_id, cursor.seq):
                return
            changed = snapshot.cells(after_seq=seq if log_id == cursor.log_id else -1)
            keys = [cell.key for cell in changed if cell.voxels and not self._views.has(view_name(row, cell, depth))]
        for key in keys:
            if self._closing.is_set():
                return
            start_s = time.monotonic()
            self._make_one(row, key, depth)
            self._at_once -= 1
            if self._at_once < 0:
                self._closing.wait(PAUSE_SHARE * (time.monotonic() - start_s))
        self._seen[row.number] = (cursor.log_id, cursor.seq)

    def _make_one(self, row: MapRow, key: CellKey, depth: int) -> None:
        try:
            with self._store.snapshot(row) as snapshot:
                stored = snapshot.cell(key)
            if stored is not None:
                self._views.view(view_name(row, stored, depth), lambda: view_of_stored(row, stored, depth))
        except DamagedDataError as exc:
            log.info("%s; who asks for it may heal it", exc.message)

    def _write(self) -> None:
        """The file, if there is anything new to keep, and room for it."""
        made = self._views.made
        if made == self._written:
            return
        self._write_s = time.monotonic()
        views = self._views.newest(FILE_BYTES_MAX)
        try:
            self._store.health.check_space(self._free_bytes_min + sum(map(len, views.values())))
            write_views(self._folder, views)
            self._written = made
        except (OSError, CairnError) as exc:
            log.warning("views of cells are not kept over a restart: %s", exc)
