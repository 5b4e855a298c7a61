"""Maps that were folded since somebody last asked, so that a map in which nothing happens costs no look at it.

this server folds          -->  note
another one, by its hint   -->  note                 -->  take: these maps, or all of them
hints may have been lost   -->  note_loss
"""

import threading


class FoldNews:
    """Maps folded by any server of the store since they were last taken; thread-safe, for one taker."""

    def __init__(self) -> None:
        """Begin with all maps: nothing is known of any."""
        self._lock = threading.Lock()
        self._numbers: set[int] = set()
        self._is_any = True

    def note(self, number: int) -> None:
        """Note that the map of a number was folded."""
        with self._lock:
            self._numbers.add(number)

    def note_loss(self) -> None:
        """Note that any map may have been folded."""
        with self._lock:
            self._is_any = True

    def take(self) -> frozenset[int] | None:
        """Numbers of the maps that were folded since the last call; None: it may be any."""
        with self._lock:
            found = None if self._is_any else frozenset(self._numbers)
            self._numbers.clear()
            self._is_any = False
            return found

    def take_of(self, numbers: frozenset[int]) -> frozenset[int]:
        """Those of these maps that were folded, or may have been, since they were last taken."""
        with self._lock:
            found = numbers if self._is_any else numbers & self._numbers
            self._numbers -= found
            return found

    def put_back(self, found: frozenset[int] | None) -> None:
        """Take back what was taken and could not be looked at."""
        with self._lock:
            self._is_any |= found is None
            self._numbers |= found or frozenset()
