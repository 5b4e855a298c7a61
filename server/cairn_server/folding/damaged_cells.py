"""Which cells were found damaged for good, so that whoever still has one is asked for it.

It is not written anywhere: after a start a cell is found damaged again as soon as it is read or folded into.
"""

import threading
from collections.abc import Iterable
from itertools import islice

from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import DAMAGED_MAX
from cairn_server.store.store import Snapshot

Damaged = list[tuple[tuple[int, int, int], str]]
"""As a header names them: the cell, and the fingerprint of what it was."""


class DamagedCells:
    """Damaged cells of all maps; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: dict[str, set[CellKey]] = {}
        self._healed: dict[str, int] = {}

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        """These cells could not be read, nor made anew."""
        with self._lock:
            self._found.setdefault(map_name, set()).update(keys)

    def forget(self, map_name: str, key: CellKey) -> None:
        """The cell is sound."""
        with self._lock:
            self._found.get(map_name, set()).discard(key)
            self._healed[map_name] = self._healed.get(map_name, 0) + 1

    def healed(self, map_name: str) -> int:
        """How often a cell of a map was said to be sound: if it is more than before, look again."""
        with self._lock:
            return self._healed.get(map_name, 0)

    def of(self, map_name: str) -> frozenset[CellKey]:
        """The damaged cells of a map, as far as anybody asked for them."""
        with self._lock:
            return frozenset(self._found.get(map_name, ()))


def as_named(snapshot: Snapshot, keys: frozenset[CellKey]) -> Damaged:
    """What a header says of damaged cells: what they were is kept apart from their bytes."""
    if not keys:
        return []
    found = ((cell_of_key(cell.key), cell.fingerprint.hex()) for cell in snapshot.cells() if cell.key in keys)
    return list(islice(found, DAMAGED_MAX))
