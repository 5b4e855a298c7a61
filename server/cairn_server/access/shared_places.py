"""Shared places: a bounded list of what many askers want, in which none pushes out the others.

    room for all               what is put stays
    no room                    the asker that holds most loses what it put first; of equal ones, the one that puts

So an asker keeps the newest `most // N` of what it put, whatever the other N - 1 put. Not thread-safe.
"""

from collections import OrderedDict
from collections.abc import Hashable, Iterator
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class SharedPlaces(Generic[Key, Value]):
    """Values by key, each in a place of one asker; two askers may hold the same key."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._of: dict[str, OrderedDict[Key, Value]] = {}
        """By asker; of each, what was put first comes first."""

    def put(self, asker: str, key: Key, value: Value) -> None:
        """Give a value a place, or put it in again as the asker's newest."""
        held = self._of.setdefault(asker, OrderedDict())
        held[key] = value
        held.move_to_end(key)
        if sum(map(len, self._of.values())) > self._most:
            fullest = max(self._of, key=lambda other: (len(self._of[other]), other == asker))
            self._of[fullest].popitem(last=False)

    def get(self, asker: str, key: Key) -> Value | None:
        """Value of an asker under a key; None: it has no place."""
        held = self._of.get(asker)
        return held.get(key) if held is not None else None

    def remove(self, key: Key) -> None:
        """Free the places of a key, of all askers."""
        for asker in [asker for asker, held in self._of.items() if key in held]:
            del self._of[asker][key]
            if not self._of[asker]:
                del self._of[asker]

    def keys(self) -> Iterator[Key]:
        """Keys that have a place, each once, asker by asker."""
        return iter(dict.fromkeys(key for held in self._of.values() for key in held))

    def values(self) -> Iterator[Value]:
        """Values that have a place, asker by asker."""
        return (value for held in self._of.values() for value in held.values())
