"""Robots' keys in memory (`store.AdmittedKeys`)."""

from tests.memory_store.admission import known, put_key
from tests.memory_store.maps import MemoryMaps

from cairn_map.commits.ids import Author, Incarnation
from cairn_server.store.admission import RobotKey
from cairn_server.store.store_rows import MapRow


class MemoryAdmittedKeys:
    """`store.AdmittedKeys`, under the lock of the maps."""

    def __init__(self, maps: MemoryMaps) -> None:
        self._maps = maps

    def all(self, row: MapRow) -> list[RobotKey]:
        """All admitted keys, by robot and incarnation."""
        with self._maps.reading(row), self._maps.changing_keys(row) as keys:
            return [keys[author] for author in sorted(keys)]

    def of(self, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
        """Admitted keys of a robot."""
        with self._maps.reading(row), self._maps.changing_keys(row) as keys:
            return known(keys, robot)

    def admit(self, row: MapRow, author: Author, *, by: str) -> None:
        """Admit a key by an operator's word."""
        with self._maps.reading(row), self._maps.changing_keys(row) as keys:
            put_key(keys, author, may_return=True, by=by)
