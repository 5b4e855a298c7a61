"""Beginnings of bodies that come in parts, in the memory of one process.

They are `store.replica_notes.StagedBodies`, which a store of several servers keeps itself.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from cairn_server.store.replica_notes import BodyPart, BodyPlace, StagedBodies, StagedBody


@dataclass(slots=True)
class _Begun:
    """Beginning of a body."""

    digest: str
    total_bytes: int
    used_s: float
    data: bytearray = field(default_factory=bytearray)

    def is_of(self, part: BodyPart) -> bool:
        """True if a part is of this very body."""
        return (self.digest, self.total_bytes) == (part.digest, part.total_bytes)


class OwnStagedBodies:
    """Bodies that one process holds; thread-safe."""

    def __init__(self, steady_s: Callable[[], float]) -> None:
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._begun: dict[BodyPlace, _Begun] = {}
        """The one used last stands last."""

    def all(self) -> list[StagedBody]:
        """All of them, the one without a part for the longest time first."""
        with self._lock:
            return [self._staged(place, begun) for place, begun in self._begun.items()]

    def at(self, place: BodyPlace) -> StagedBody | None:
        """The one at a place."""
        with self._lock:
            begun = self._begun.get(place)
            return self._staged(place, begun) if begun else None

    def append(self, place: BodyPlace, part: BodyPart) -> StagedBody | None:
        """Add a part where the last one of this very body ended."""
        with self._lock:
            begun = self._begun.get(place)
            if begun is None or not begun.is_of(part):
                if part.offset_bytes or not part.data:
                    return None
                begun = _Begun(part.digest, part.total_bytes, 0.0)
            if part.offset_bytes == len(begun.data):
                begun.data += part.data
            begun.used_s = self._steady_s()
            self._begun.pop(place, None)
            self._begun[place] = begun
            return self._staged(place, begun)

    def body(self, place: BodyPlace, digest: str) -> bytes | None:
        """Bytes that came of a body."""
        with self._lock:
            begun = self._begun.get(place)
            return bytes(begun.data) if begun and begun.digest == digest else None

    def drop(self, place: BodyPlace) -> None:
        """Drop what is at a place, if anything is."""
        with self._lock:
            self._begun.pop(place, None)

    def _staged(self, place: BodyPlace, begun: _Begun) -> StagedBody:
        idle_s = self._steady_s() - begun.used_s
        return StagedBody(place, begun.digest, begun.total_bytes, len(begun.data), idle_s)


_ARE_STAGED_BODIES: type[StagedBodies] = OwnStagedBodies
"""Check of the protocol by the type checker."""
