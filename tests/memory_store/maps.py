"""All maps of a store in memory under one lock.

    writer     changes the dictionaries of one map under the lock
    snapshot   gets these very dictionaries; whoever writes next copies them first

So reading never waits for writing, and a map that nobody reads is not copied for each commit.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tests.memory_store.admission import Keys
from tests.memory_store.map import MemoryMap

from cairn_map.commits.ids import map_of_layer
from cairn_map.errors import UnreachableError
from cairn_server.map_refusals import GoneMap, map_gone, no_map
from cairn_server.store.replica_notes import FoldHint, OnHint
from cairn_server.store.store_rows import MapRow


class MemoryMaps:
    """Maps by name; whoever holds the lock may take it again."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._maps: dict[str, MemoryMap] = {}
        self.gone: list[GoneMap] = []
        """Deleted maps, oldest first."""
        self.made = 0
        """Count of the maps that ever were."""
        self._is_closed = False
        self.written = 0
        """Changes since the start."""
        self._on_hint: list[OnHint] = []

    @contextmanager
    def locked(self) -> Iterator[dict[str, MemoryMap]]:
        """All maps, while nobody changes any.

        Raises:
            UnreachableError: kind `shutting_down`.
        """
        with self._lock:
            if self._is_closed:
                raise UnreachableError("shutting_down", "the server is shutting down", retry_after_s=5.0)
            yield self._maps

    @contextmanager
    def reading(self, row: MapRow) -> Iterator[MemoryMap]:
        """A map, while nobody changes it."""
        with self.locked() as maps:
            yield self._found(maps, row)

    @contextmanager
    def changing(self, row: MapRow) -> Iterator[MemoryMap]:
        """A map's dictionaries, which no snapshot has."""
        with self.locked() as maps:
            state = self._found(maps, row)
            if state.is_shared:
                state = maps[row.name] = state.copied()
            yield state
            self.written += 1

    @contextmanager
    def changing_keys(self, row: MapRow) -> Iterator[Keys]:
        """Keys that robots' names are bound to on a map, of a layer its map's; no snapshot has them."""
        with self.reading(row), self.locked() as maps:
            name = map_of_layer(row.name)
            with self.changing(row if name is None else maps[name].row) as state:
                yield state.keys

    def row(self, name: str) -> MapRow:
        """The map of a name.

        Raises:
            NotFoundError: kind `no_map` or `gone`.
        """
        with self.locked() as maps:
            if name in maps:
                return maps[name].row
            gone = next((gone for gone in reversed(self.gone) if gone.name == name), None)
            raise no_map(name) if gone is None else map_gone(gone)

    def _found(self, maps: dict[str, MemoryMap], row: MapRow) -> MemoryMap:
        for gone in self.gone:
            if gone.number == row.number:
                raise map_gone(gone)
        return maps[row.name]

    def shared(self, row: MapRow) -> MemoryMap:
        """A map's dictionaries as they are now; nobody changes them from then on."""
        with self.reading(row) as state:
            state.is_shared = True
            return state

    def hear_folds(self, on_hint: OnHint) -> None:
        """Call this after each fold."""
        self._on_hint.append(on_hint)

    def hear_no_folds(self, on_hint: OnHint) -> None:
        """Call it no more."""
        self._on_hint.remove(on_hint)

    def tell_fold(self, hint: FoldHint) -> None:
        """Tell all who hear folds of one."""
        for on_hint in list(self._on_hint):
            on_hint(hint)

    def close(self) -> None:
        """Answer nothing any more."""
        with self._lock:
            self._is_closed = True
