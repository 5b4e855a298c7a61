"""Views of cells, as they were sent: an operator's page asks for all cells at once, and the next page for the same.

To make one takes some 30 ms, most of it to decode the cell; its name says all of what it is, so it is never stale.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable

BYTES_MAX = 1 << 26
"""Of all views kept; 56 cells of 4 cm are 2 MB at their voxels, 3 MB at all depths."""


class ViewCache:
    """The views used last, by name; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._views: OrderedDict[str, bytes] = OrderedDict()
        self._size_bytes = 0

    def view(self, name: str, make: Callable[[], bytes]) -> bytes:
        """The view of a name, made unless it is here."""
        with self._lock:
            found = self._views.get(name)
            if found is not None:
                self._views.move_to_end(name)
                return found
        # Not under the lock: two may make the same at once, which is rare and does no harm.
        made = make()
        with self._lock:
            if name not in self._views:
                self._views[name] = made
                self._size_bytes += len(made)
            while self._size_bytes > BYTES_MAX:
                self._size_bytes -= len(self._views.popitem(last=False)[1])
        return made
