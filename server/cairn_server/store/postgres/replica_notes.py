"""Notes that servers over one database share (`replica_notes.ReplicaNotes`), use of quotas apart.

Pictures, tickets and parts of bodies lie in tables that are not logged: they cost the database no flush, and a crash of
it empties them.
"""

import secrets
from collections.abc import Collection, Mapping
from typing import Any

from cairn_map.commits.ids import commit_id_from_text
from cairn_server.store.postgres.branches import PgBranches
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.use_accounts import PgUseAccounts
from cairn_server.store.replica_notes import (
    BodyPart,
    BodyPlace,
    NotedReport,
    RobotView,
    StagedBody,
    TicketNote,
)
from cairn_server.store.store_rows import MapRow

SECRET_BYTES = 32


class PgReplicaNotes:
    """All notes of one store."""

    def __init__(self, connections: Connections, noting: Connections, branches: PgBranches) -> None:
        """Read the secret of the store, or make it.

        Args:
            connections: for what is durable on return.
            noting: for what need not be.
            branches: of the store, among whose notes the statuses are.
        """
        self._connections = connections
        self.reports = PgReports(noting, branches)
        self.tickets = PgTickets(noting)
        self.bodies = PgBodies(noting)
        self.uses = PgUseAccounts(noting)
        self.secret: bytes = connections.run(_secret)

    def put_handed_over(self, upstream: str, map_name: str, age_s: float) -> None:
        """Note up to which age all of a map is on an upstream server. Durable on return."""
        query = (
            "INSERT INTO handed_over (upstream, map_name, age_s) VALUES (%s, %s, %s)"
            " ON CONFLICT (upstream, map_name) DO UPDATE SET age_s = greatest(handed_over.age_s, excluded.age_s)"
        )
        self._connections.run(lambda connection: connection.execute(query, (upstream, map_name, age_s)))

    def handed_over(self, upstream: str) -> Mapping[str, float]:
        """Ages by the map's name."""
        with self._connections.lent() as connection:
            return dict(rows(connection, "SELECT map_name, age_s FROM handed_over WHERE upstream = %s", (upstream,)))


class PgReports:
    """`replica_notes.NotedReports`."""

    def __init__(self, noting: Connections, branches: PgBranches) -> None:
        self._noting = noting
        self._branches = branches

    def put_status(self, row: MapRow, branch: str, status: str, *, heard_s: float) -> None:
        """Keep a status, unless a later one is kept."""
        self._branches.put_heard_status(row, branch, status, heard_s=heard_s)

    def put_view(self, row: MapRow, branch: str, view: RobotView) -> None:
        """Keep a picture, unless a later one is kept."""
        query = (
            "INSERT INTO branch_view (map, name, media_type, time_s, data)"
            " SELECT map, name, %s, %s::float8, %s FROM branch WHERE map = %s AND name = %s"
            " ON CONFLICT (map, name) DO UPDATE SET media_type = excluded.media_type, time_s = excluded.time_s,"
            " data = excluded.data WHERE branch_view.time_s <= excluded.time_s"
        )
        with self._noting.lent() as connection:
            connection.execute(query, (view.media_type, view.time_s, view.data, row.number, branch))

    def view(self, row: MapRow, branch: str) -> RobotView | None:
        """The picture of a branch."""
        query = "SELECT data, media_type, time_s FROM branch_view WHERE map = %s AND name = %s"
        with self._noting.lent() as connection:
            found = first(connection, query, (row.number, branch))
        return None if found is None else RobotView(*found)

    def view_s(self, row: MapRow, branch: str) -> float | None:
        """Time at which the picture of a branch came."""
        query = "SELECT time_s FROM branch_view WHERE map = %s AND name = %s"
        with self._noting.lent() as connection:
            time_s: float | None = first(connection, query, (row.number, branch))
        return time_s

    def all(self, row: MapRow) -> dict[str, NotedReport]:
        """Reports of all branches, without their pictures."""
        self._branches.flush()
        query = (
            "SELECT name, status, coalesce(heard_s, 0), time_s"
            " FROM (SELECT name, status, heard_s FROM branch_status WHERE map = %(map)s) AS s"
            " FULL JOIN (SELECT name, time_s FROM branch_view WHERE map = %(map)s) AS v USING (name)"
        )
        with self._noting.lent() as connection:
            found = rows(connection, query, {"map": row.number})
        return {name: NotedReport(*report) for name, *report in found}


class PgTickets:
    """`replica_notes.NotedTickets`."""

    def __init__(self, noting: Connections) -> None:
        self._noting = noting

    def put(self, key: bytes, note: TicketNote, *, lifetime_s: float) -> None:
        """Keep a ticket."""
        query = (
            "INSERT INTO ticket (hash, map_name, asked, holder, until)"
            " VALUES (%s, %s, %s, %s, clock_timestamp() + make_interval(secs => %s::float8))"
        )
        with self._noting.lent() as connection:
            connection.execute("DELETE FROM ticket WHERE until < clock_timestamp()")
            connection.execute(query, (key, note.map_name, note.asked, note.holder, lifetime_s))

    def take(self, key: bytes) -> TicketNote | None:
        """Take a ticket out."""
        query = "DELETE FROM ticket WHERE hash = %s AND until > clock_timestamp() RETURNING map_name, asked, holder"
        with self._noting.lent() as connection:
            found = first(connection, query, (key,))
        return None if found is None else TicketNote(*found)

    def left(self, keys: Collection[bytes]) -> set[bytes]:
        """Those of these tickets that were neither taken nor have ended."""
        query = "SELECT hash FROM ticket WHERE hash = ANY(%s) AND until > clock_timestamp()"
        with self._noting.lent() as connection:
            return {key for (key,) in rows(connection, query, (list(keys),))}


OF_BODY = "map = %s AND robot = %s AND commit = %s"
BODY_COLUMNS = (
    "map, robot, commit, digest, total_bytes, size_bytes, extract(epoch FROM clock_timestamp() - used_at)::float8"
)


class PgBodies:
    """`replica_notes.StagedBodies`."""

    def __init__(self, noting: Connections) -> None:
        self._noting = noting

    def all(self) -> list[StagedBody]:
        """All of them, the one without a part for the longest time first."""
        with self._noting.lent() as connection:
            return [_staged(row) for row in rows(connection, f"SELECT {BODY_COLUMNS} FROM body ORDER BY used_at")]

    def at(self, place: BodyPlace) -> StagedBody | None:
        """The one at a place."""
        with self._noting.lent() as connection:
            return _at(connection, place)

    def append(self, place: BodyPlace, part: BodyPart) -> StagedBody | None:
        """Add a part where the last one of this very body ended."""
        return self._noting.run(lambda connection: _append(connection, place, part))

    def body(self, place: BodyPlace, digest: str) -> bytes | None:
        """Bytes that came of a body."""
        query = f"SELECT data FROM body_part JOIN body USING (map, robot, commit) WHERE {OF_BODY} AND digest = %s"
        with self._noting.lent() as connection:
            found = rows(connection, f"{query} ORDER BY offset_bytes", (*_key(place), digest))
        return b"".join(data for (data,) in found) if found else None

    def drop(self, place: BodyPlace) -> None:
        """Drop what is at a place."""
        self._noting.run(lambda connection: _drop(connection, place))


def _append(connection: Connection, place: BodyPlace, part: BodyPart) -> StagedBody | None:
    query = f"SELECT digest, total_bytes, size_bytes FROM body WHERE {OF_BODY} FOR UPDATE"
    known = first(connection, query, _key(place))
    is_same = known is not None and known[:2] == (part.digest, part.total_bytes)
    size_bytes = known[2] if known is not None and is_same else 0
    is_next = part.offset_bytes == size_bytes and bool(part.data)
    if not is_same:
        if not is_next:
            return None
        _drop(connection, place)
        # Of two first parts at a time one meets the key of the other, and is looked at again after it.
        query = (
            "INSERT INTO body (map, robot, commit, digest, total_bytes, size_bytes, used_at)"
            " VALUES (%s, %s, %s, %s, %s, 0, clock_timestamp())"
        )
        connection.execute(query, (*_key(place), part.digest, part.total_bytes))
    if is_next:
        query = "INSERT INTO body_part (map, robot, commit, offset_bytes, data) VALUES (%s, %s, %s, %s, %s)"
        connection.execute(query, (*_key(place), part.offset_bytes, part.data))
        size_bytes += len(part.data)
    query = f"UPDATE body SET size_bytes = %s, used_at = clock_timestamp() WHERE {OF_BODY}"
    connection.execute(query, (size_bytes, *_key(place)))
    return _at(connection, place)


def _at(connection: Connection, place: BodyPlace) -> StagedBody | None:
    found = first(connection, f"SELECT {BODY_COLUMNS} FROM body WHERE {OF_BODY}", _key(place))
    return None if found is None else _staged(found)


def _drop(connection: Connection, place: BodyPlace) -> None:
    # The row that a part locks is deleted first: no part is added to a body that goes.
    for table in ("body", "body_part"):
        connection.execute(f"DELETE FROM {table} WHERE {OF_BODY}", _key(place))


def _key(place: BodyPlace) -> tuple[int, str, str]:
    return place.map, place.robot, str(place.commit)


def _staged(row: tuple[Any, ...]) -> StagedBody:
    number, robot, commit, digest, total_bytes, size_bytes, idle_s = row
    place = BodyPlace(number, robot, commit_id_from_text(commit))
    return StagedBody(place, digest, total_bytes, size_bytes, idle_s)


def _secret(connection: Connection) -> bytes:
    query = "INSERT INTO shared_secret (one, secret) VALUES (true, %s) ON CONFLICT DO NOTHING"
    connection.execute(query, (secrets.token_bytes(SECRET_BYTES),))
    found: bytes = first(connection, "SELECT secret FROM shared_secret")
    return found
