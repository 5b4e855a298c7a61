"""Reads of a SQLite store outside a snapshot: maps, and commits with their evidence."""

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager

import apsw

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, map_of_layer
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.history import KnownVectors
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.schema import MAPS, WAITING, WAITING_MAPS
from cairn_server.store.sqlite.snapshot import SqliteSnapshot
from cairn_server.store.sqlite.writer import Values, first, rows
from cairn_server.store.store_rows import MapRow, StoredCommit
from cairn_server.store.stored_columns import epoch_from_column, ids_from_text


class SqliteReads:
    """The reading half of `store.Store`."""

    def __init__(self, readers: Readers) -> None:
        self._readers = readers
        self._vectors = KnownVectors()
        self._maps: dict[int, MapRow] = {}

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        return self.map_rows("ORDER BY name", ())

    def layers(self, row: MapRow) -> list[MapRow]:
        """Further layers of a map, by name."""
        return self.map_rows("WHERE name GLOB ? ORDER BY name", (f"{row.name}.*",))

    def heads(self, numbers: Collection[int] | None = None) -> list[tuple[MapRow, Cursor]]:
        """All maps, or those of these numbers that there are, with their present states."""
        query = f"SELECT number, seal_key, log_id, seq, chain FROM {MAPS}"  # noqa: S608 - our own clause
        with self._readers.reading() as reader:
            if numbers is None:
                found = rows(reader, f"{query} ORDER BY name")
            else:
                among = "WHERE number IN (SELECT value FROM json_each(?))"
                found = rows(reader, f"{query} {among} ORDER BY name", (json.dumps(list(numbers)),))
            return [(self._map_row(reader, number, seal_key), Cursor(*cursor)) for number, seal_key, *cursor in found]

    def waiting_maps(self) -> list[MapRow]:
        """Maps with commits to be folded, or with a retract under way, by name."""
        return self.map_rows(f"WHERE number IN ({WAITING_MAPS}) ORDER BY name", ())

    def next_waiting(self, *, after: int, limit: int) -> list[MapRow]:
        """Maps with commits to be folded whose numbers are above `after`, by number: the first `limit`."""
        clause = f"WHERE number > ? AND number IN ({WAITING_MAPS}) ORDER BY number LIMIT ?"
        return self.map_rows(clause, (after, limit))

    def maps_with_evidence(self, *, before_s: float) -> list[MapRow]:
        """Maps with evidence of commits folded before an age of the store, by name."""
        kept = (
            "SELECT 1 FROM commits WHERE commits.map = map.number AND gone = 0 AND cells > 0"
            " AND folded_seq IS NOT NULL AND folded_age_s < ?"
        )
        return self.map_rows(f"WHERE EXISTS ({kept}) ORDER BY name", (before_s,))

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """Commits to be folded, in turn of their robots, with their diffs: at most `limit`, and one or within the size.

        First the oldest of each robot, then the second of each: 5 ms where 5000 wait. Folded ones whose retract is
        under way are among them.
        """
        skipped = " AND number NOT IN (SELECT value FROM json_each(?3))" if skip else ""
        turn = "ROW_NUMBER() OVER (PARTITION BY robot ORDER BY number)"
        clause = f"number IN {WAITING}{skipped} ORDER BY {turn}, number LIMIT ?2"
        values = (row.number, limit, json.dumps(sorted(skip))) if skip else (row.number, limit)
        return self._commits(clause, values, size_bytes_max=size_bytes_max)

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        return self._commit("map = ? AND robot = ? AND incarnation = ? AND n = ?", row, commit)

    def kept_sha(self, row: MapRow, commit: CommitId) -> bytes | None:
        """SHA-256 of a commit whose bytes are not wanted; None of any other."""
        query = (
            "SELECT sha FROM commits WHERE map = ?1 AND robot = ?2 AND incarnation = ?3 AND n = ?4 AND damaged IS NULL"
            " AND (gone = 0 OR EXISTS (SELECT 1 FROM retracted WHERE map = ?1 AND id = ?5))"
        )
        with self._readers.reading() as reader:
            sha: bytes | None = first(reader, query, (row.number, *commit.author, commit.n, str(commit)))
        return sha

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        clause = "map = ? AND robot = ? AND incarnation = ? AND n = ? AND folded_seq IS NOT NULL"
        return self._commit(clause, row, commit)

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """True if a retract of this id has taken effect, or waits for the commit to come."""
        query = "SELECT 1 FROM retracted WHERE map = ? AND id = ?"
        with self._readers.reading() as reader:
            return first(reader, query, (row.number, str(commit))) is not None

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[SqliteSnapshot]:
        """One state of the map."""
        with self._readers.transaction() as connection:
            yield SqliteSnapshot(connection, row.number, row.layer.digest(), self._vectors)

    def map_rows(self, clause: str, values: Values) -> list[MapRow]:
        """Maps that fit a clause of ours."""
        with self._readers.reading() as reader:
            found = rows(reader, f"SELECT number, seal_key FROM {MAPS} {clause}", values)  # noqa: S608 - our own clause
            return [self._map_row(reader, number, seal_key) for number, seal_key in found]

    def _map_row(self, reader: apsw.Connection, number: int, seal_key: bytes) -> MapRow:
        """The map of a number; read once, for a map never changes."""
        known = self._maps.get(number)
        # In a store that was restored the number may be another map's.
        if known is None or known.seal_key != seal_key:
            query = "SELECT name, geometry, sensor_model, epoch_s FROM map WHERE number = ?"
            name, geometry, sensor_model, epoch_s = first(reader, query, (number,))
            whole = map_of_layer(name)
            known = MapRow(
                number=number,
                name=name,
                geometry=Geometry.model_validate_json(geometry),
                sensor_model=SensorModel.model_validate_json(sensor_model),
                seal_key=seal_key,
                epoch_s=epoch_s,
                of_map=None if whole is None else first(reader, "SELECT number FROM map WHERE name = ?", (whole,)),
            )
            # The map of a layer that came out of an archive may follow it.
            if whole is None or known.of_map is not None:
                self._maps[number] = known
        return known

    def _commit(self, clause: str, row: MapRow, commit: CommitId) -> StoredCommit | None:
        found = self._commits(clause, (row.number, *commit.author, commit.n), size_bytes_max=0)
        return found[0] if found else None

    def _commits(self, clause: str, values: Values, *, size_bytes_max: int) -> list[StoredCommit]:
        """Commits in the order asked for, as long as their bytes stay within the size; the first in any case."""
        columns = "number, robot, incarnation, n, sha, meta, retracts, gone, due_from, size_bytes, signatures, epoch"
        found: list[StoredCommit] = []
        total_bytes = 0
        with self._readers.transaction() as reader:
            query = f"SELECT {columns} FROM commits WHERE {clause}"  # noqa: S608 - our own clause
            for number, *author, n, sha, text, retracts, gone, due_from, size_bytes, signed, epoch in reader.execute(
                query, values
            ):
                total_bytes += size_bytes
                if found and total_bytes > size_bytes_max:
                    break
                diff = rows(reader, "SELECT cell, body FROM diff WHERE commit_number = ? ORDER BY cell", (number,))
                found.append(
                    StoredCommit(
                        number=number,
                        id=CommitId(Author(*author), n),
                        sha=sha,
                        text=text,
                        retracts=ids_from_text(retracts),
                        diff={CellKey(cell): body or b"" for cell, body in diff},
                        gone=bool(gone),
                        signatures=signed,
                        due_from=due_from,
                        epoch=epoch_from_column(epoch),
                    )
                )
        return found
