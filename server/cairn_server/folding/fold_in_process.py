"""Folding with the cells under change in memory, and what waits for a damaged one: of all maps of one store."""

from dataclasses import dataclass

from cairn_map.errors import CairnError
from cairn_server.folding.cell_cache import CACHE_BYTES, CellCache
from cairn_server.folding.fold_around import Waiting, fold_around
from cairn_server.folding.fold_store import Damage, FoldStore
from cairn_server.store.store_rows import MapRow

GROUP_MAX = 256
"""Commits folded at once."""


@dataclass(frozen=True, slots=True)
class Folded:
    """What became of one group."""

    commits: int
    waits_for: CairnError | None
    """Why some have to wait: a damaged cell."""


class FoldHere:
    """Folds in the thread that asks; one thread at a time."""

    def __init__(self, store: FoldStore, damaged: Damage) -> None:
        self._store = store
        self._damaged = damaged
        self._caches: dict[str, CellCache] = {}
        self._waiting: dict[str, Waiting] = {}

    def fold(self, row: MapRow, *, maps: int) -> Folded:
        """Fold a group of what is pending on a map, one of so many maps that share the memory.

        Raises:
            CairnError: nothing was folded.
        """
        cache = self._caches.setdefault(row.name, CellCache(row.geometry))
        cache.limit_bytes = CACHE_BYTES // maps
        waiting = self._waiting.setdefault(row.name, Waiting())
        count = fold_around(self._store, row, cache, waiting, self._damaged, limit=GROUP_MAX)
        cache.trim()
        return Folded(count, waiting.why)
