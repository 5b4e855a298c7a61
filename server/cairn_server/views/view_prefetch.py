"""Coarse views of all cells, and their hot spots, made before a page asks: its first picture and list are ready.

    start   -->  the views of all cells, the first of them without pauses
    folded  -->  a moment later, cell by cell with pauses between, what changed

One thread. The first views after a start are made without pauses, since a page that looks then would wait for them.
After that it takes a quarter of a core at most for the maps that pages looked at of late, which go first, and a
thirtieth for all others: of a thousand maps whose robots push, views that no page asks for took half of what their
servers did. A cell that changes all the time is made once in some seconds.
"""

import logging
import threading
import time
from collections.abc import Callable

from cairn_map.commits.cursor import Cursor
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key
from cairn_server.cell_room import DECODING
from cairn_server.live.fold_news import FoldNews
from cairn_server.store.history import is_proven
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.cell_views import ViewCache, first_depth, shown_reading, view_name, view_of_reading

log = logging.getLogger(__name__)

LOOK_EVERY_S = 3.0
PAUSE_SHARE, UNSEEN_PAUSE_SHARE = 3.0, 30.0
"""Pause after each view, as a multiple of the time that it took: of a map that pages look at, and of any other."""
AT_ONCE = 100
"""Views made without a pause after a start: some two seconds."""


class ViewPrefetch:
    """Thread that makes and keeps views of a store's maps until closed."""

    def __init__(
        self,
        store: Store,
        views: ViewCache,
        news: FoldNews,
        *,
        look_every_s: float = LOOK_EVERY_S,
        on_read: Callable[[MapRow, CellRow, Evidence], None] = lambda *_: None,
    ) -> None:
        """Begin; `news` has the maps that were folded, and `on_read` gets what was read of each cell."""
        self._on_read = on_read
        self._store = store
        self._views = views
        self._news = news
        self._look_every_s = look_every_s
        self._seen: dict[int, Cursor] = {}
        """By map: state up to which all cells' views were made."""
        self._at_once = AT_ONCE
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-views", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        # Numba takes half a second to load the first kernel, for which the first page would wait.
        cell_of_key(cell_key((0, 0, 0)))
        while not self._closing.is_set():
            self._make_of(self._news.take())
            self._closing.wait(self._look_every_s)

    def _make_of(self, news: frozenset[int] | None) -> None:
        """Make the views of these maps, those that pages look at first."""
        found = self._heads(news)
        for row, cursor in sorted(found, key=lambda each: not self._views.is_looked_at(each[0].number)):
            if self._seen.get(row.number) != cursor:
                self._make_all(row)

    def _heads(self, news: frozenset[int] | None) -> list[tuple[MapRow, Cursor]]:
        """Maps of these numbers, with their present states."""
        if news is not None and not news:
            return []
        try:
            return self._store.heads(news)
        except CairnError as exc:
            log.info("views cannot be made ahead now: %s", exc.message)
        except Exception:
            log.exception("views cannot be made ahead now")
        self._news.put_back(news)
        return []

    def _make_all(self, row: MapRow) -> None:
        """Make the views of one map; an error leaves the other maps alone."""
        try:
            self._make(row)
            return
        except CairnError as exc:
            log.info("views of map %s cannot be made ahead now: %s", row.name, exc.message)
        except Exception:
            log.exception("views of map %s cannot be made ahead now", row.name)
        self._news.note(row.number)

    def _make(self, row: MapRow) -> None:
        """Make the views of the cells that changed since the last look."""
        depth = first_depth(row.geometry.depth)
        with self._store.snapshot(row) as snapshot:
            cursor = snapshot.head
            seen = self._seen.get(row.number)
            if seen == cursor:
                return
            changed = snapshot.cells(after_seq=seen.seq if seen and is_proven(seen, snapshot) else -1)
            keys = [cell.key for cell in changed if cell.voxels and not self._views.has(view_name(row, cell, depth))]
        for key in keys:
            if self._closing.is_set():
                return
            start_s = time.monotonic()
            self._make_one(row, key, depth)
            self._at_once -= 1
            if self._at_once < 0:
                self._pause(row, time.monotonic() - start_s)
        self._seen[row.number] = cursor

    def _pause(self, row: MapRow, took_s: float) -> None:
        """Rest after a view of a map, and meanwhile make those that pages wait for more."""
        end_s = time.monotonic() + UNSEEN_PAUSE_SHARE * took_s
        self._closing.wait(PAUSE_SHARE * took_s)
        while not (self._closing.is_set() or self._views.is_looked_at(row.number)) and time.monotonic() < end_s:
            self._make_of(self._news.take_of(self._views.looked_at()))
            self._closing.wait(min(self._look_every_s, max(0.0, end_s - time.monotonic())))

    def _make_one(self, row: MapRow, key: CellKey, depth: int) -> None:
        try:
            with self._store.snapshot(row) as snapshot:
                stored = snapshot.cell(key)
            if stored is not None:
                self._views.view(view_name(row, stored, depth), lambda: self._view(row, stored, depth))
        except (DamagedDataError, AwayError) as exc:
            log.info("no view of cell %s before a client asks for it: %s", cell_of_key(key), exc.message)

    def _view(self, row: MapRow, stored: CellRow, depth: int) -> bytes:
        with DECODING.of_cell(row.geometry, stored.voxels):
            evidence = shown_reading(row, stored)
            self._on_read(row, stored, evidence)
            return view_of_reading(row, stored, evidence, depth)
