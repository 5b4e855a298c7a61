"""The thread that folds: wakes up when a commit was accepted, and at start for what a crash left over."""

import logging
import threading
import time

from cairn_map.errors import CairnError
from cairn_server.folding import CellCache, fold_pending
from cairn_server.store import Store

log = logging.getLogger(__name__)

GROUP_MAX = 64
"""Commits folded at once."""
RETRY_S = 5.0
"""A fold that failed (a full disk, a damaged cell) is tried again after this."""


class Folder:
    """Folds all maps of a store until closed."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._caches: dict[str, CellCache] = {}
        self._wake.set()
        self._thread = threading.Thread(target=self._run, name="cairn-folder", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Say that there may be something to fold."""
        self._wake.set()

    def close(self) -> None:
        """Stop after the fold under way."""
        self._closing.set()
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._closing.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                self._fold_all()
            except CairnError as exc:
                log.error("fold failed: %s: %s; trying again in %.0f s", exc.kind, exc.message, RETRY_S)
                self._closing.wait(RETRY_S)
                self._wake.set()

    def _fold_all(self) -> None:
        for row in self._store.maps():
            cache = self._caches.setdefault(row.name, CellCache())
            while not self._closing.is_set():
                start_s = time.monotonic()
                count = fold_pending(self._store, row, cache, limit=GROUP_MAX)
                if not count:
                    break
                log.info("map %s: folded %d commits in %.0f ms", row.name, count, (time.monotonic() - start_s) * 1e3)
