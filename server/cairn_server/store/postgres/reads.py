"""Reads of a PostgreSQL store outside a snapshot: maps, and commits with their evidence."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.history import KnownVectors
from cairn_server.store.objects.cold_bytes import ColdReads, NoObjects
from cairn_server.store.objects.read_ahead import NamedSize, ReadAhead
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.retention import is_retracted
from cairn_server.store.postgres.schema import IS_WAITING
from cairn_server.store.postgres.snapshot import OF_COMMIT, PgSnapshot
from cairn_server.store.store_rows import MapRow, StoredCommit
from cairn_server.store.stored_columns import ids_from_text


class PgReads:
    """The reading half of `store.Store`."""

    def __init__(
        self, connections: Connections, objects: ColdReads | None = None, *, ahead: ReadAhead | None = None
    ) -> None:
        """Read a database, and what moved from it to an object store: cells of pending commits ahead, if so said."""
        self._connections = connections
        self._objects = ahead or objects or NoObjects()
        self._ahead = ahead
        self._vectors = KnownVectors()
        self._maps: dict[int, MapRow] = {}

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        return self.map_rows("ORDER BY name", ())

    def heads(self, numbers: Collection[int] | None = None) -> list[tuple[MapRow, Cursor]]:
        """All maps, or those of these numbers that there are, with their present states."""
        query = "SELECT map, seal_key, log_id, seq, chain FROM map JOIN head USING (map)"
        with self._connections.lent() as connection:
            if numbers is None:
                found = rows(connection, f"{query} ORDER BY name")
            else:
                found = rows(connection, f"{query} WHERE map = ANY(%s) ORDER BY name", (list(numbers),))
            known = self._map_rows(connection, [(number, seal_key) for number, seal_key, *_ in found])
        return [(row, Cursor(*cursor)) for row, (_, _, *cursor) in zip(known, found, strict=True)]

    def waiting_maps(self) -> list[MapRow]:
        """Maps with commits to be folded, or with a retract under way, by name."""
        # A look at each map's first waiting commit, and not at all that wait.
        next_map = f"SELECT map FROM commits WHERE {IS_WAITING} AND map > waiting.map ORDER BY map LIMIT 1"
        waiting = (
            f"WITH RECURSIVE waiting AS ((SELECT map FROM commits WHERE {IS_WAITING} ORDER BY map LIMIT 1)"
            f" UNION ALL SELECT ({next_map}) FROM waiting WHERE waiting.map IS NOT NULL)"
            " SELECT map FROM waiting WHERE map IS NOT NULL"
        )
        return self.map_rows(f"WHERE map IN ({waiting}) ORDER BY name", ())

    def maps_with_evidence(self, *, before_s: float) -> list[MapRow]:
        """Maps with evidence of commits folded before an age of the store, by name."""
        kept = (
            "SELECT FROM commits WHERE commits.map = map.map AND NOT gone AND cells > 0 AND folded_seq IS NOT NULL"
            " AND folded_age_s < %s::float8"
        )
        return self.map_rows(f"WHERE EXISTS ({kept}) ORDER BY name", (before_s,))

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """Commits to be folded, in turn of their robots, with their diffs: at most `limit`, and one or within the size.

        First the oldest of each robot, then the second of each. Folded ones whose retract is under way are among them.
        """
        turn = "row_number() OVER (PARTITION BY robot ORDER BY number)"
        clause = (
            f"map = %(map)s AND {IS_WAITING} AND number <> ALL(%(skip)s::bigint[])"
            f" ORDER BY {turn}, number LIMIT %(limit)s"
        )
        values = {"map": row.number, "skip": sorted(skip), "limit": limit}
        with self._connections.snapshot() as connection:
            found = rows(connection, f"SELECT number, size_bytes, due_from FROM commits WHERE {clause}", values)
            numbers: list[int] = []
            unread: set[int] = set()
            total_bytes = 0
            for number, size_bytes, due_from in found:
                # Folded: what its retract names is still to be done, and its own evidence, cold perhaps, is not needed.
                if due_from is not None:
                    unread.add(number)
                else:
                    total_bytes += size_bytes
                if numbers and total_bytes > size_bytes_max:
                    break
                numbers.append(number)
            commits = _commits(connection, row, numbers, self._objects, unread=unread)
            cold = _cold_cells(connection, row, commits) if self._ahead is not None else []
        # No transaction waits for it.
        if self._ahead is not None:
            self._ahead.read(cold)
        return commits

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        return self._commit(row, commit, OF_COMMIT)

    def kept_sha(self, row: MapRow, commit: CommitId) -> bytes | None:
        """SHA-256 of a commit whose evidence is kept, folded or not; None if there is none. No evidence is read."""
        query = f"SELECT sha FROM commits WHERE {OF_COMMIT} AND NOT gone"
        with self._connections.lent() as connection:
            sha: bytes | None = first(connection, query, (row.number, *commit.author, commit.n))
        return sha

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        return self._commit(row, commit, f"{OF_COMMIT} AND folded_seq IS NOT NULL")

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """True if a retract of this id has taken effect, or waits for the commit to come."""
        with self._connections.lent() as connection:
            return is_retracted(connection, row, commit)

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[PgSnapshot]:
        """One state of the map."""
        with self._connections.snapshot() as connection:
            yield PgSnapshot(connection, row.number, row.geometry.digest(), self._vectors, self._objects)

    def map_rows(self, clause: str, values: tuple[Any, ...]) -> list[MapRow]:
        """Maps that fit a clause of ours."""
        with self._connections.lent() as connection:
            found = rows(connection, f"SELECT map, seal_key FROM map {clause}", values)
            return self._map_rows(connection, found)

    def _map_rows(self, connection: Connection, found: Sequence[Sequence[Any]]) -> list[MapRow]:
        """Maps by number and key of seals; each is read once, for a map never changes."""
        # In a store that was restored the number may be another map's.
        unknown = [number for number, key in found if number not in self._maps or self._maps[number].seal_key != key]
        if unknown:
            query = "SELECT map, name, geometry, sensor_model, seal_key FROM map WHERE map = ANY(%s)"
            for number, name, geometry, sensor_model, seal_key in rows(connection, query, (unknown,)):
                self._maps[number] = MapRow(
                    number=number,
                    name=name,
                    geometry=Geometry.model_validate_json(geometry),
                    sensor_model=SensorModel.model_validate_json(sensor_model),
                    seal_key=seal_key,
                )
        return [self._maps[number] for number, _ in found]

    def _commit(self, row: MapRow, commit: CommitId, clause: str) -> StoredCommit | None:
        with self._connections.snapshot() as connection:
            query = f"SELECT number FROM commits WHERE {clause}"
            number = first(connection, query, (row.number, *commit.author, commit.n))
            return None if number is None else _commits(connection, row, [number], self._objects)[0]


def _commits(
    connection: Connection, row: MapRow, numbers: list[int], objects: ColdReads, *, unread: Collection[int] = ()
) -> list[StoredCommit]:
    """Commits of these numbers, in this order, with their diffs, but for the `unread` ones.

    Raises:
        AwayError: a diff is in the object store, which does not answer.
    """
    if not numbers:
        return []
    bodies: defaultdict[int, dict[CellKey, bytes]] = defaultdict(dict)
    query = (
        "SELECT commit_number, cell, body, segment, start_bytes, size_bytes FROM diff"
        " WHERE map = %s AND layer = 0 AND commit_number = ANY(%s) ORDER BY cell"
    )
    found = rows(connection, query, (row.number, [number for number in numbers if number not in unread]))
    cold = _cold_bodies([each[3:] for each in found if each[3] is not None], objects)
    for number, cell, body, name, start, _ in found:
        bodies[number][CellKey(cell)] = body if name is None else cold[name, start]
    columns = "number, robot, incarnation, n, sha, meta, retracts, gone, due_from, signatures"
    query = f"SELECT {columns} FROM commits WHERE map = %s AND number = ANY(%s)"
    known = {
        number: StoredCommit(
            number=number,
            id=CommitId(Author(*author), n),
            sha=sha,
            text=text,
            retracts=ids_from_text(retracts),
            diff=bodies[number],
            gone=gone,
            signatures=signed,
            due_from=due_from,
        )
        for number, *author, n, sha, text, retracts, gone, due_from, signed in rows(
            connection, query, (row.number, numbers)
        )
    }
    return [known[number] for number in numbers]


def _cold_cells(connection: Connection, row: MapRow, commits: Iterable[StoredCommit]) -> list[NamedSize]:
    """Objects of the cells that these commits change, in the order of the commits."""
    keys = list(dict.fromkeys(int(key) for commit in commits for key in commit.diff))
    query = (
        "SELECT object, size_bytes FROM unnest(%s::bigint[]) WITH ORDINALITY AS u (key, place)"
        " JOIN cell ON map = %s AND layer = 0 AND cell = key WHERE body IS NULL ORDER BY place"
    )
    return [NamedSize(*found) for found in rows(connection, query, (keys, row.number))]


def _cold_bodies(pieces: list[tuple[str, int, int]], objects: ColdReads) -> dict[tuple[str, int], bytes]:
    """Bytes of pieces of segments (name, start, size), by name and start: one read for each segment.

    Pieces of one commit lie side by side. Those of a segment that is lost are empty, as damaged as it is.
    """
    bodies: dict[tuple[str, int], bytes] = {}
    spans: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
    for name, start, size_bytes in pieces:
        spans[name].append((start, start + size_bytes))
    for name, ends in spans.items():
        first_byte, last = min(start for start, _ in ends), max(end for _, end in ends)
        data = objects.part(name, start=first_byte, size_bytes=last - first_byte) or b""
        bodies |= {(name, start): data[start - first_byte : end - first_byte] for start, end in ends}
    return bodies
