"""The embedded store: one SQLite file, one writer, readers that never wait for it (`store.Store`)."""

import json
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import apsw

from cairn_map.cursor import Cursor, cursor_from_text, first_chain
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence import COUNT_MAX, SUM_MAX
from cairn_map.grid import CellKey, Geometry
from cairn_map.ids import Author, CommitId, Incarnation, new_incarnation
from cairn_map.sensor_model import SensorModel
from cairn_server.sqlite_schema import ensure_schema
from cairn_server.sqlite_snapshot import SqliteSnapshot, ids_from_text
from cairn_server.sqlite_writer import Values, Writer, connect, first, rows
from cairn_server.store import Branch, Fold, MapRow, NewCommit, StoredCommit

log = logging.getLogger(__name__)

FILE_NAME = "cairn.sqlite"


class SqliteStore:
    """`store.Store` in a folder."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / FILE_NAME
        connection = connect(self._path)
        try:
            ensure_schema(connection)
        finally:
            connection.close()
        self._writer = Writer(self._path)
        self._local = threading.local()
        self._readers: list[apsw.Connection] = []

    def create_map(self, name: str, geometry: Geometry, sensor_model: SensorModel) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already."""

        def job(connection: apsw.Connection) -> bool:
            found = first(connection, "SELECT geometry, sensor_model FROM map WHERE name = ?", (name,))
            if found:
                if found != (geometry.model_dump_json(), sensor_model.model_dump_json()):
                    raise ConflictError("map_exists", f"map {name} exists with another geometry or sensor model")
                return False
            log_id = secrets.token_bytes(16)
            tops = [0] * (2 + geometry.plane_count)
            connection.execute(
                "INSERT INTO map (name, geometry, sensor_model, operator, log_id, seq, chain, vector, tops)"
                " VALUES (?, ?, ?, ?, ?, 0, ?, '{}', ?)",
                (
                    name,
                    geometry.model_dump_json(),
                    sensor_model.model_dump_json(),
                    new_incarnation(),
                    log_id,
                    first_chain(log_id, geometry.digest()),
                    json.dumps(tops),
                ),
            )
            return True

        is_new = self._writer.run(job)
        return self.map(name), is_new

    def map(self, name: str) -> MapRow:
        """The map of a name."""
        for row in self._map_rows("WHERE name = ?", (name,)):
            return row
        raise NotFoundError("no_map", f"there is no map {name!r}; `cairn map ls` lists them")

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        return list(self._map_rows("ORDER BY name", ()))

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit; True if it is new, False if the same one is kept already. Durable on return."""
        return self._writer.run(lambda connection: _append(connection, row, commit))

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""

        def job(connection: apsw.Connection) -> NewCommit:
            n: int = first(
                connection,
                "SELECT coalesce(max(n) + 1, 0) FROM commits WHERE map = ? AND robot = ? AND incarnation = ?",
                (row.number, *author),
            )
            commit = build(n)
            _append(connection, row, commit)
            return commit

        return self._writer.run(job)

    def pending(self, row: MapRow, *, limit: int) -> list[StoredCommit]:
        """Commits that are not folded, in order of arrival, with their diffs."""
        return self._commits("map = ? AND folded_seq IS NULL ORDER BY number LIMIT ?", (row.number, limit))

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        found = self._commits(
            "map = ? AND robot = ? AND incarnation = ? AND n = ? AND folded_seq IS NOT NULL",
            (row.number, *commit.author, commit.n),
        )
        return found[0] if found else None

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """Whether a retract of this id has taken effect, or waits for it to come."""
        query = "SELECT 1 FROM retracted WHERE map = ? AND id = ?"
        return first(self._reader(), query, (row.number, str(commit))) is not None

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        return self._writer.run(lambda connection: _fold(connection, row, fold))

    @contextmanager
    def snapshot(self, row: MapRow) -> Iterator[SqliteSnapshot]:
        """One state of the map."""
        connection = self._reader()
        connection.execute("BEGIN")
        try:
            yield SqliteSnapshot(connection, row.number, row.geometry.digest())
        finally:
            connection.execute("ROLLBACK")

    def register(self, row: MapRow, branch: Branch, token_hash: bytes) -> None:
        """Make a branch, or give an existing one a new token."""
        values = (row.number, branch.name, branch.mode, json.dumps(branch.sensors), branch.last_seen_s, token_hash)
        self._writer.run(
            lambda connection: connection.execute(
                "INSERT INTO branch (map, name, mode, sensors, last_seen_s, token_hash) VALUES (?, ?, ?, ?, ?, ?)"
                " ON CONFLICT (map, name) DO UPDATE SET mode = excluded.mode, sensors = excluded.sensors,"
                " last_seen_s = excluded.last_seen_s, token_hash = excluded.token_hash",
                values,
            ).fetchall()
        )

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands; may be written later."""
        values = (time.time(), str(cursor) if cursor else None, row.number, name)
        self._writer.submit(
            lambda connection: connection.execute(
                "UPDATE branch SET last_seen_s = ?, cursor = coalesce(?, cursor) WHERE map = ? AND name = ?", values
            ).fetchall()
        )

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and its token."""

        def job(connection: apsw.Connection) -> None:
            connection.execute("DELETE FROM branch WHERE map = ? AND name = ?", (row.number, name))
            if not connection.changes():
                raise NotFoundError("no_branch", f"map {row.name} has no branch {name!r}")

        self._writer.run(job)

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        found = rows(
            self._reader(),
            "SELECT name, mode, sensors, cursor, last_seen_s FROM branch WHERE map = ? ORDER BY name",
            (row.number,),
        )
        return [
            Branch(name, mode, tuple(json.loads(sensors)), cursor_from_text(cursor) if cursor else None, seen_s)
            for name, mode, sensors, cursor, seen_s in found
        ]

    def branch_of_token(self, row: MapRow, token_hash: bytes) -> str | None:
        """The branch that a token was given to."""
        query = "SELECT name FROM branch WHERE map = ? AND token_hash = ?"
        return cast("str | None", first(self._reader(), query, (row.number, token_hash)))

    def audit(self, what: str, detail: str) -> None:
        """Note something that an administrator may have to look into; may be written later."""
        log.warning("%s: %s", what, detail)
        self._writer.submit(
            lambda connection: connection.execute(
                "INSERT INTO audit (time_s, what, detail) VALUES (?, ?, ?)", (time.time(), what, detail)
            ).fetchall()
        )

    def close(self) -> None:
        """Finish what was accepted and close."""
        self._writer.close()
        for connection in self._readers:
            connection.close()

    def _reader(self) -> apsw.Connection:
        """The reading connection of the calling thread."""
        connection: apsw.Connection | None = getattr(self._local, "connection", None)
        if connection is None:
            connection = connect(self._path)
            connection.execute("PRAGMA query_only = ON")
            self._local.connection = connection
            self._readers.append(connection)
        return connection

    def _map_rows(self, clause: str, values: Values) -> Iterator[MapRow]:
        query = f"SELECT number, name, geometry, sensor_model, operator FROM map {clause}"  # noqa: S608 - our own clause
        for number, name, geometry, sensor_model, operator in rows(self._reader(), query, values):
            yield MapRow(
                number=number,
                name=name,
                geometry=Geometry.model_validate_json(geometry),
                sensor_model=SensorModel.model_validate_json(sensor_model),
                operator=Incarnation(operator),
            )

    def _commits(self, clause: str, values: Values) -> list[StoredCommit]:
        reader = self._reader()
        query = f"SELECT number, robot, incarnation, n, sha, retracts FROM commits WHERE {clause}"  # noqa: S608 - our own clause
        found: list[StoredCommit] = []
        for number, robot, incarnation, n, sha, retracts in rows(reader, query, values):
            diff = rows(reader, "SELECT cell, body FROM diff WHERE commit_number = ? ORDER BY cell", (number,))
            found.append(
                StoredCommit(
                    number=number,
                    id=CommitId(Author(robot, incarnation), n),
                    sha=sha,
                    retracts=ids_from_text(retracts),
                    diff={CellKey(cell): body for cell, body in diff},
                )
            )
        return found


def _append(connection: apsw.Connection, row: MapRow, commit: NewCommit) -> bool:
    key = (row.number, *commit.id.author, commit.id.n)
    known = first(connection, "SELECT sha FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND n = ?", key)
    if known is not None:
        if known != commit.sha:
            raise ConflictError("id_taken", f"commit {commit.id} is already here with other bytes")
        return False
    sums = json.loads(first(connection, "SELECT tops FROM map WHERE number = ?", (row.number,)))
    sums = [total + top for total, top in zip(sums, commit.tops, strict=True)]
    if max(sums[:2]) > COUNT_MAX or max(sums[2:], default=0) > SUM_MAX:
        raise BadInputError("evidence_overflow", "the map could not take this much evidence without an overflow")
    connection.execute("UPDATE map SET tops = ? WHERE number = ?", (json.dumps(sums), row.number))
    connection.execute(
        "INSERT INTO commits (map, robot, incarnation, n, sha, size_bytes, cells, meta, retracts, received_s)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            *key,
            commit.sha,
            commit.size_bytes,
            len(commit.diff),
            commit.meta,
            " ".join(map(str, commit.retracts)),
            time.time(),
        ),
    )
    number = connection.last_insert_rowid()
    connection.executemany(
        "INSERT INTO diff (commit_number, cell, body) VALUES (?, ?, ?)",
        [(number, cell, body) for cell, body in commit.diff.items()],
    )
    return True


def _fold(connection: apsw.Connection, row: MapRow, fold: Fold) -> bool:
    head = first(connection, "SELECT seq, chain FROM map WHERE number = ?", (row.number,))
    if head != (fold.base.seq, fold.base.chain):
        return False
    connection.execute(
        "UPDATE map SET seq = ?, chain = ?, vector = ? WHERE number = ?",
        (fold.head.seq, fold.head.chain, json.dumps(fold.vector.to_json()), row.number),
    )
    now_s = time.time()
    for seq, entry in enumerate(fold.entries, start=fold.base.seq + 1):
        connection.execute(
            "INSERT INTO log (map, seq, kind, commit_number, chain) VALUES (?, ?, ?, ?, ?)",
            (row.number, seq, entry.kind, entry.commit, entry.chain),
        )
        connection.execute(
            "INSERT INTO touched (map, cell, seq) SELECT ?, cell, ? FROM diff WHERE commit_number = ?",
            (row.number, seq, entry.commit),
        )
        connection.execute(
            "UPDATE commits SET folded_seq = ?, folded_s = ? WHERE number = ? AND folded_seq IS NULL",
            (seq, now_s, entry.commit),
        )
    connection.executemany(
        "INSERT INTO retracted (map, id) VALUES (?, ?)", [(row.number, str(target)) for target in fold.retracted]
    )
    connection.executemany(
        "INSERT INTO cell (map, cell, lm, digest, fingerprint, voxels, size_bytes, body)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (map, cell) DO UPDATE SET lm = excluded.lm, digest = excluded.digest,"
        " fingerprint = excluded.fingerprint, voxels = excluded.voxels, size_bytes = excluded.size_bytes,"
        " body = excluded.body",
        [
            (row.number, c.key, c.lm, c.digest, c.fingerprint.to_bytes(), c.voxels, c.size_bytes, c.body)
            for c in fold.cells
        ],
    )
    return True
