"""Views of cells, as they were sent: an operator's page asks for all cells at once, and the next page for the same.

To make one takes some 15 ms, most of it to decode the cell; its name says all of what it is, so it is never stale.
`views_ahead` makes those that a page asks for first before anybody does, and keeps all of them over a restart.
"""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import lru_cache

from cairn_map.codec.view_code import VERSION
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.store_rows import CellRow, MapRow

BYTES_MAX = 1 << 26
"""Of all views kept; 56 cells of 4 cm are 2 MB at their voxels, 3 MB at all depths."""


def view_name(row: MapRow, stored: CellRow, depth: int) -> str:
    """What tells one view from all others, also from those of another map that once had this name."""
    return f"{row.name}/{way_of_seeing(row)}/{stored.digest.hex()}/{depth}"


def way_of_seeing(row: MapRow) -> str:
    """What the looks of a map's cells depend on besides their evidence, in 16 hex digits."""
    return _digest(row.geometry, row.sensor_model)


@lru_cache(maxsize=256)
def _digest(geometry: Geometry, model: SensorModel) -> str:
    text = f"{VERSION} {geometry.model_dump_json()} {model.model_dump_json()}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class ViewCache:
    """The views used last, by name; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._views: OrderedDict[str, bytes] = OrderedDict()
        self._size_bytes = 0
        self.made = 0
        """How many were put in."""

    def ready(self, name: str) -> bytes | None:
        """The view of a name, if it is here."""
        with self._lock:
            found = self._views.get(name)
            if found is not None:
                self._views.move_to_end(name)
            return found

    def view(self, name: str, make: Callable[[], bytes]) -> bytes:
        """The view of a name, made unless it is here."""
        found = self.ready(name)
        if found is not None:
            return found
        # Not under the lock: two may make the same at once, which is rare and does no harm.
        made = make()
        self.put({name: made})
        return made

    def put(self, views: Mapping[str, bytes]) -> None:
        """Keep these, the last one the longest."""
        with self._lock:
            for name, data in views.items():
                if name not in self._views:
                    self._views[name] = data
                    self._size_bytes += len(data)
                    self.made += 1
            while self._size_bytes > BYTES_MAX:
                self._size_bytes -= len(self._views.popitem(last=False)[1])

    def has(self, name: str) -> bool:
        """Whether it is here."""
        with self._lock:
            return name in self._views

    def newest(self, limit_bytes: int) -> dict[str, bytes]:
        """Those used last, oldest first, within a bound."""
        found: list[tuple[str, bytes]] = []
        with self._lock:
            for name in reversed(self._views):
                limit_bytes -= len(self._views[name])
                if limit_bytes < 0:
                    break
                found.append((name, self._views[name]))
        return dict(reversed(found))
