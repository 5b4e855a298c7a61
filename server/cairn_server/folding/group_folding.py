"""Folding around damaged cells: commits that touch none of them go on, the others wait as if they had not come yet.

A commit is one entry of the log, of all its cells or of none: chain, `lm`, coverage and what a later retract takes out
know no half ones. So it waits as a whole, and so does a retract of a commit that is in a damaged cell. That is allowed,
since any order of the same commits gives the same cells; and it is in `pending` meanwhile, so nobody pushes it again.
"""

import logging
import time
from dataclasses import dataclass, field

from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_server.folding.cell_cache import CACHE_BYTES, CellCache
from cairn_server.folding.cells_at_rest import DamagedCellError, cell_to_change
from cairn_server.folding.folding import GROUP_BYTES_MAX, Damage, FoldStore, fold_commits
from cairn_server.store.store_rows import MapRow, StoredCommit

GROUP_MAX = 256
"""Commits folded at once."""

log = logging.getLogger(__name__)

PROBE_S = 60.0
"""How often it is looked whether a damaged cell can be read again, if nobody says that it was healed."""


@dataclass(slots=True)
class Waiting:
    """What one map waits for."""

    cells: set[CellKey] = field(default_factory=set)
    commits: set[int] = field(default_factory=set)
    """Numbers of those that touch these cells, as far as was looked."""
    why: DamagedCellError | None = None
    """Of the cell found last; None: nothing is damaged."""
    healed: int = 0
    """`DamagedCells.healed` when it was looked last; noted before the look, so that no healing falls between."""
    probed_s: float = 0.0

    def forget(self) -> None:
        """Try all of them again."""
        self.cells.clear()
        self.commits.clear()
        self.why = None


def fold_around(
    store: FoldStore, row: MapRow, cache: CellCache, waiting: Waiting, damaged: Damage, *, limit: int
) -> int:
    """Fold up to `limit` pending commits that touch no damaged cell; returns how many were.

    Args:
        store: of the map.
        row: the map.
        cache: of its cells.
        waiting: what was found damaged until now; changed here.
        damaged: where it is said which cells are damaged, and by others that one was healed.
        limit: of one group.
    """
    healed = damaged.healed(row.name)
    if waiting.cells and (healed != waiting.healed or time.monotonic() - waiting.probed_s > PROBE_S):
        waiting.probed_s = time.monotonic()
        sound = [key for key in waiting.cells if _can_be_read(store, row, key)]
        for key in sound:
            damaged.forget(row.name, key)
        if sound:
            waiting.forget()
    waiting.healed = healed
    while commits := store.pending(row, limit=limit, size_bytes_max=GROUP_BYTES_MAX, skip=waiting.commits):
        ready = [commit for commit in commits if not _touches(store, row, commit, waiting.cells)]
        waiting.commits.update({commit.number for commit in commits} - {commit.number for commit in ready})
        if not ready:
            continue
        try:
            return fold_commits(store, row, cache, ready)
        except DamagedCellError as exc:
            if exc.key in waiting.cells:
                raise
            log.error("map %s: what touches cell %s waits: %s", row.name, cell_of_key(exc.key), exc.message)
            waiting.cells.add(exc.key)
            waiting.why, waiting.probed_s = exc, time.monotonic()
            damaged.note(row.name, [exc.key])
    return 0


def _touches(store: FoldStore, row: MapRow, commit: StoredCommit, cells: set[CellKey]) -> bool:
    """Whether to fold a commit, or to take out what it retracts, changes one of these cells."""
    if not cells:
        return False
    if not cells.isdisjoint(commit.diff):
        return True
    targets = (store.folded(row, target) for target in commit.retracts if not store.is_retracted(row, target))
    return any(target is not None and not cells.isdisjoint(target.diff) for target in targets)


def _can_be_read(store: FoldStore, row: MapRow, key: CellKey) -> bool:
    try:
        with store.snapshot(row) as snapshot:
            cell_to_change(snapshot, key, row.geometry)
    except DamagedCellError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class Folded:
    """What became of one group."""

    commits: int
    waits_for: CairnError | None
    """Why some have to wait: a damaged cell."""


class LocalFolding:
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
