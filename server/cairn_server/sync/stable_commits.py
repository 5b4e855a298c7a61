"""Which commits no restore can lose any more: without backups, those folded longer ago than a setting of time."""

import threading
import time

from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import MapRow

KEEP_S = 10.0
"""The answer is kept this long: it only ever grows, so an old one is safe."""


class StableVectors:
    """Stable vectors of all maps, computed at most every few seconds."""

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._keep_s = min(KEEP_S, after_s)
        self._lock = threading.Lock()
        self._kept: dict[int, tuple[float, VersionVector]] = {}

    def of(self, row: MapRow, snapshot: Snapshot) -> VersionVector:
        """The stable vector of the map in this snapshot."""
        now_s = time.time()
        with self._lock:
            made_s, vector = self._kept.get(row.number, (float("-inf"), EMPTY))
            if now_s - made_s < self._keep_s and made_s <= now_s:
                return vector
            vector = snapshot.folded_before(now_s - self._after_s)
            self._kept[row.number] = (now_s, vector)
            return vector
