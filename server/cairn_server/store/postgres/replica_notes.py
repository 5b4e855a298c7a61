"""Notes that servers over one database share, and hints of folds (`replica_notes.ReplicaNotes`); no use of quotas.

Pictures, tickets and parts of bodies lie in tables that are not logged: they cost the database no flush, and a crash of
it empties them.
"""

import logging
import secrets
import select
import selectors
import socket
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import asdict, fields
from typing import Any

import psycopg

from cairn_map.commits.ids import commit_id_from_text
from cairn_map.errors import CairnError
from cairn_server.store.postgres.branches import PgBranches
from cairn_server.store.postgres.connections import Connection, Connections, connect, first, rows
from cairn_server.store.postgres.folds import CHANNEL
from cairn_server.store.postgres.schema import NOW_S, STEPS
from cairn_server.store.postgres.use_accounts import PgUseAccounts
from cairn_server.store.replica_notes import (
    SERVER_S,
    BodyPart,
    BodyPlace,
    FoldHint,
    NotedReport,
    NotedServer,
    OnHint,
    RobotView,
    StagedBody,
    TicketNote,
)
from cairn_server.store.store_rows import MapRow

log = logging.getLogger(__name__)

SECRET_BYTES = 32
FIRST_PAUSE_S, AWAY_PAUSE_S, SILENT_PAUSE_S = 0.5, 10.0, 600.0
"""Pauses before listening is tried again: the first one, and the longest of those that double, while the database is
away and where it says nothing."""
PROVE_S = 5.0
"""Time in which what this server notifies has to come back to it."""
PROVE_EVERY_S = 60.0
"""Time between two such proofs that the connection is alive."""


class PgReplicaNotes:
    """All notes of one store."""

    def __init__(self, url: str, connections: Connections, noting: Connections, branches: PgBranches) -> None:
        """Read the secret of the store, or make it.

        Args:
            url: of the database.
            connections: for what is durable on return.
            noting: for what need not be.
            branches: of the store, among whose notes the statuses are.
        """
        self._url = url
        self._connections = connections
        self._noting = noting
        self.reports = PgReports(noting, branches)
        self.tickets = PgTickets(noting)
        self.bodies = PgBodies(noting)
        self.uses = PgUseAccounts(noting)
        self.servers = PgServers(noting)
        self.secret: bytes = connections.run(_secret)

    def fold_hints(self, on_hint: OnHint) -> "PgFoldHints":
        """Begin to hear of folds by any server of the store."""
        return PgFoldHints(self._url, self._noting, on_hint)

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

    def write_seen(self) -> None:
        """Write soon what was heard of branches."""
        self._branches.write_seen()

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


class PgServers:
    """`replica_notes.NotedServers`, by the database's clock."""

    def __init__(self, noting: Connections) -> None:
        self._noting = noting

    def put(self, sign: NotedServer, *, wall_s: float) -> None:
        """Keep the sign of a server."""
        query = (
            "INSERT INTO server (id, answers, folds, version, clock_ahead_s, folded_at, heard_at, step)"
            f" SELECT %(id)s, %(answers)s, %(folds)s, %(version)s, %(wall_s)s::float8 - {NOW_S},"
            f" clock_timestamp() - make_interval(secs => %(folded_s)s::float8), clock_timestamp(), {len(STEPS)}"
            " ON CONFLICT (id) DO UPDATE SET folds = excluded.folds, clock_ahead_s = excluded.clock_ahead_s,"
            " folded_at = excluded.folded_at, heard_at = excluded.heard_at"
        )
        with self._noting.lent() as connection:
            connection.execute("DELETE FROM server WHERE heard_at < clock_timestamp() - interval '1 hour'")
            connection.execute(query.encode(), asdict(sign) | {"wall_s": wall_s})

    def all(self) -> list[NotedServer]:
        """Servers that gave a sign of late."""
        now = "clock_timestamp()"
        ages = ", ".join(f"extract(epoch FROM {now} - {name})::float8" for name in ("folded_at", "heard_at"))
        query = (
            f"SELECT id, answers, folds, version, clock_ahead_s, {ages} FROM server"
            " WHERE heard_at > clock_timestamp() - make_interval(secs => %s::float8) ORDER BY id"
        )
        names = [each.name for each in fields(NotedServer)]
        with self._noting.lent() as connection:
            found = rows(connection, query, (SERVER_S,))
        return [NotedServer(**dict(zip(names, row, strict=True))) for row in found]

    def remove(self, server: str) -> None:
        """Drop a server."""
        with self._noting.lent() as connection:
            connection.execute("DELETE FROM server WHERE id = %s", (server,))


class PgFoldHints:
    """Thread with a connection that listens (`replica_notes.FoldHints`), and connects again by itself.

    A pooler in transaction mode lets LISTEN pass and loses what is notified, and databases that only speak
    PostgreSQL's language may not know it. So a second connection notifies first, and hints count as heard when that
    came; else this is tried again after a growing pause, and until then looks at the heads have to do.
    """

    def __init__(self, url: str, notifying: Connections, on_hint: OnHint) -> None:
        """Begin; `notifying` are other connections to the same database."""
        self._url = url
        self._notifying = notifying
        self._on_hint = on_hint
        self.are_heard = False
        self._closing, self._close = socket.socketpair()
        self._is_closing = False
        self._thread = threading.Thread(target=self._run, name="cairn-hints", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hear no more."""
        self._is_closing = True
        self._close.close()
        self._thread.join()
        self._closing.close()

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._is_closing:
            longest_s, said = self._listen()
            if said and (pause_s == FIRST_PAUSE_S or longest_s == FIRST_PAUSE_S):
                log.info("no hints of folds by other servers, looking at heads each second: %s", said)
            pause_s = min(2 * pause_s, longest_s)
            select.select([self._closing], [], [], pause_s)

    def _listen(self) -> tuple[float, str]:
        """Pass on hints until that ends; the longest pause before the next try, and the reason."""
        try:
            with closing(connect(self._url)) as connection:
                connection.execute(f"LISTEN {CHANNEL}".encode())
                said = self._hear(connection)
                return FIRST_PAUSE_S if self.are_heard else SILENT_PAUSE_S, said
        except (psycopg.Error, CairnError) as exc:
            is_away = isinstance(exc, psycopg.OperationalError | CairnError)
            longest_s = FIRST_PAUSE_S if self.are_heard else AWAY_PAUSE_S if is_away else SILENT_PAUSE_S
            return longest_s, " ".join(str(exc).split())
        finally:
            self.are_heard = False

    def _hear(self, connection: Connection) -> str:
        """Pass on hints while what is notified comes back; the reason why it ended."""
        with selectors.DefaultSelector() as events:
            events.register(self._closing, selectors.EVENT_READ)
            events.register(connection.fileno(), selectors.EVENT_READ)
            end_s = 0.0
            sign = ""
            while not self._is_closing:
                if time.monotonic() >= end_s:
                    if sign:
                        return "what is notified does not come back, as behind a pooler in transaction mode"
                    # Said again and again: a link that broke without a word would be silent for ever.
                    sign, end_s = secrets.token_hex(8), time.monotonic() + PROVE_S
                    self._notify(sign)
                events.select(max(0.0, end_s - time.monotonic()))
                for notice in connection.notifies(timeout=0):
                    if notice.payload == sign:
                        sign, end_s = "", time.monotonic() + PROVE_EVERY_S
                        self._begin()
                    else:
                        self._pass_on(notice.payload)
        return ""

    def _begin(self) -> None:
        if not self.are_heard:
            self.are_heard = True
            self._on_hint(None)

    def _notify(self, sign: str) -> None:
        with self._notifying.lent() as connection:
            connection.execute("SELECT pg_notify(%s, %s)", (CHANNEL, sign))

    def _pass_on(self, payload: str) -> None:
        number, _, seq = payload.partition(" ")
        if number.isdecimal() and seq.isdecimal():  # else a sign of another server
            self._on_hint(FoldHint(int(number), int(seq)))


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
