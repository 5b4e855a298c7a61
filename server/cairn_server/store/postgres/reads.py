"""Reads of a PostgreSQL store outside a snapshot: maps, and commits with their evidence."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName, map_of_layer
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
from cairn_server.store.stored_columns import epoch_from_column, ids_from_text

STORED = """
SELECT c.number, robot, incarnation, n, sha, meta, retracts, gone, c.due_from, signatures, c.epoch, d.*
FROM {commits} AS c LEFT JOIN LATERAL (
    SELECT array_agg(cell ORDER BY cell), array_agg(body ORDER BY cell), array_agg(segment ORDER BY cell),
        array_agg(start_bytes ORDER BY cell), array_agg(size_bytes ORDER BY cell)
    FROM diff WHERE map = %(map)s AND layer = 0 AND commit_number = c.number AND {reads}
) AS d ON true"""
"""SQL of commits with their diffs, one row each."""
OF_ID = "map = %(map)s AND robot = %(robot)s AND incarnation = %(incarnation)s AND n = %(n)s"
ONE = f"{STORED.format(commits='commits', reads='true')} WHERE {OF_ID}"
PENDING = f"""
WITH waiting AS (
    SELECT number, due_from, size_bytes, row_number() OVER (PARTITION BY robot ORDER BY number) AS turn
    FROM commits WHERE map = %(map)s AND {IS_WAITING} AND number <> ALL(%(skip)s::bigint[])
), ordered AS (
    SELECT number, row_number() OVER (ORDER BY turn, number) AS place,
        sum(CASE WHEN due_from IS NULL THEN size_bytes ELSE 0 END) OVER (ORDER BY turn, number) AS total_bytes
    FROM waiting
), chosen AS (
    SELECT * FROM ordered JOIN commits USING (number)
    WHERE map = %(map)s AND (place = 1 OR (place <= %(limit)s AND total_bytes <= %(size_bytes_max)s))
)
{STORED.format(commits="chosen", reads="c.due_from IS NULL")} ORDER BY place"""
"""SQL of the commits to be folded: one statement, since it is asked for a single commit most often. Of one that is
folded, what its retract names is still to be done, and its own evidence, cold perhaps, is not needed."""

NEXT_WAITING = f"""
WITH RECURSIVE waiting AS (
    (SELECT map FROM commits WHERE {IS_WAITING} AND map > %s ORDER BY map LIMIT 1)
    UNION ALL
    SELECT (SELECT map FROM commits WHERE {IS_WAITING} AND map > waiting.map ORDER BY map LIMIT 1)
    FROM waiting WHERE waiting.map IS NOT NULL
)
SELECT map FROM waiting WHERE map IS NOT NULL LIMIT %s"""
"""SQL of the maps above a number that have commits to be folded, by number; of each its first is read, not all."""


class _StoredColumns(NamedTuple):
    """Columns of `STORED`."""

    number: int
    robot: RobotName
    incarnation: Incarnation
    n: int
    sha: bytes
    text: bytes
    retracts: str
    gone: bool
    due_from: int | None
    signatures: str | None
    epoch: int | None
    cells: list[int] | None
    """Cells of its diff, and below what is stored of each; None: no evidence is kept, or it is not needed."""
    bodies: list[bytes] | None
    segments: list[str | None] | None
    starts: list[int] | None
    sizes: list[int] | None

    @property
    def diff(self) -> list[tuple[int, bytes, str | None, int, int]]:
        """Cells, each with its bytes, or the segment, start and size of those that are in the object store."""
        columns = (self.cells or [], self.bodies or [], self.segments or [], self.starts or [], self.sizes or [])
        return list(zip(*columns, strict=True))


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

    def layers(self, row: MapRow) -> list[MapRow]:
        """Further layers of a map, by name."""
        return self.map_rows("WHERE starts_with(name, %s) ORDER BY name", (f"{row.name}.",))

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
        return self.map_rows(f"WHERE map IN ({NEXT_WAITING}) ORDER BY name", (-1, None))

    def next_waiting(self, *, after: int, limit: int) -> list[MapRow]:
        """Maps with commits to be folded whose numbers are above `after`, by number: the first `limit`."""
        return self.map_rows(f"WHERE map IN ({NEXT_WAITING}) ORDER BY map", (after, limit))

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
        values = {"map": row.number, "skip": sorted(skip), "limit": limit, "size_bytes_max": size_bytes_max}
        with self._connections.lent() as connection:
            commits = _commits(connection, PENDING, values, self._objects)
            cold = _cold_cells(connection, row, commits) if self._ahead is not None else []
        # No transaction waits for it.
        if self._ahead is not None:
            self._ahead.read(cold)
        return commits

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        return self._commit(row, commit, ONE)

    def kept_sha(self, row: MapRow, commit: CommitId) -> bytes | None:
        """SHA-256 of a commit whose bytes are not wanted; None of any other."""
        query = (
            f"SELECT sha FROM commits WHERE {OF_COMMIT} AND damaged IS NULL"
            " AND (NOT gone OR EXISTS (SELECT FROM retracted WHERE retracted.map = commits.map AND id = %s))"
        )
        with self._connections.lent() as connection:
            sha: bytes | None = first(connection, query, (row.number, *commit.author, commit.n, str(commit)))
        return sha

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        return self._commit(row, commit, f"{ONE} AND folded_seq IS NOT NULL")

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """True if a retract of this id has taken effect, or waits for the commit to come."""
        with self._connections.lent() as connection:
            return is_retracted(connection, row, commit)

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[PgSnapshot]:
        """One state of the map."""
        with self._connections.snapshot() as connection:
            yield PgSnapshot(connection, row.number, row.layer.digest(), self._vectors, self._objects)

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
            query = (
                "SELECT map, name, geometry, sensor_model, seal_key, epoch_s, CASE WHEN position('.' IN name) > 0 THEN"
                " (SELECT map FROM map AS whole WHERE whole.name = split_part(map.name, '.', 1)) END"
                " FROM map WHERE map = ANY(%s)"
            )
            for number, name, geometry, sensor_model, seal_key, epoch_s, of_map in rows(connection, query, (unknown,)):
                self._maps[number] = MapRow(
                    number=number,
                    name=name,
                    geometry=Geometry.model_validate_json(geometry),
                    sensor_model=SensorModel.model_validate_json(sensor_model),
                    seal_key=seal_key,
                    epoch_s=epoch_s,
                    of_map=of_map,
                )
        rows_found = [self._maps[number] for number, _ in found]
        # The map of a layer that came out of an archive may follow it.
        for row in rows_found:
            if row.of_map is None and map_of_layer(row.name) is not None:
                self._maps.pop(row.number, None)
        return rows_found

    def _commit(self, row: MapRow, commit: CommitId, query: str) -> StoredCommit | None:
        robot, incarnation = commit.author
        values = {"map": row.number, "robot": robot, "incarnation": incarnation, "n": commit.n}
        with self._connections.lent() as connection:
            found = _commits(connection, query, values, self._objects)
        return found[0] if found else None


def _commits(connection: Connection, query: str, values: dict[str, Any], objects: ColdReads) -> list[StoredCommit]:
    """Commits that a query of `COMMIT_COLUMNS` gives, with their diffs.

    Raises:
        AwayError: a diff is in the object store, which does not answer.
    """
    found = [_StoredColumns(*columns) for columns in rows(connection, query, values)]
    diffs = [each.diff for each in found]
    cold = _cold_bodies([(name, start, size) for diff in diffs for _, _, name, start, size in diff if name], objects)
    return [
        StoredCommit(
            number=each.number,
            id=CommitId(Author(each.robot, each.incarnation), each.n),
            sha=each.sha,
            text=each.text,
            retracts=ids_from_text(each.retracts),
            diff={CellKey(cell): cold[name, start] if name else body for cell, body, name, start, _ in diff},
            gone=each.gone,
            signatures=each.signatures,
            due_from=each.due_from,
            epoch=epoch_from_column(each.epoch),
        )
        for each, diff in zip(found, diffs, strict=True)
    ]


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
