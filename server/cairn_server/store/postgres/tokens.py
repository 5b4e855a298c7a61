"""Tokens and the audit log in PostgreSQL (`store.Tokens`, `store.AuditLog`)."""

import logging
import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, field

from cairn_map.errors import ConflictError
from cairn_map.wire.access_messages import AuditEntry, AuditText, audit_chain
from cairn_server.store.known_tokens import KnownTokens, check_changed, token_row
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.schema import NOW_S
from cairn_server.store.postgres.writing_threads import WritingThreads
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_rows import (
    ALL_LINES,
    AUDIT_COLUMNS,
    AUDIT_ROWS_MAX,
    NUMBER_LIMIT,
    AuditChoice,
    MapRow,
    Token,
    audit_entry,
    registration_name,
)

log = logging.getLogger(__name__)

USED_EVERY_S = 10.0
"""Time between two writes of all tokens' times of last use."""
SERVER_STREAM = "server"
"""Stream of the lines that are about the server."""
_SELECT = (
    "SELECT t.name, t.role, t.map, m.name, t.robot, t.created_s, t.expires_s, t.last_used_s, t.created_age_s,"
    " t.used_age_s, t.confirmed FROM token t LEFT JOIN map m ON m.map = t.map"
)


class PgTokens:
    """`store.Tokens`."""

    def __init__(self, connections: Connections, threads: WritingThreads, age: StoreAge) -> None:
        self._connections = connections
        self._threads = threads
        self._age = age
        self._lock = threading.Lock()
        self._used: dict[str, tuple[float, float]] = {}
        """By name: steady time and age of the store when the token was shown last."""
        self._written_s = float("-inf")
        self._known = KnownTokens()

    def forget_known(self) -> None:
        """Look all tokens up again; called once a change is durable, before it is answered."""
        self._known.forget()

    def add(self, token: Token, secret_hash: bytes) -> None:
        """Keep a new token."""
        query = (
            "INSERT INTO token (name, role, map, robot, hash, created_s, expires_s, created_age_s)"
            " VALUES (%s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT (name) DO NOTHING"
        )
        values = (token.name, token.role, token.map_number, token.robot, secret_hash, token.created_s, token.expires_s)

        def job(connection: Connection) -> None:
            if not connection.execute(query, (*values, self._age.now_s())).rowcount:
                raise ConflictError("token_exists", f"a token {token.name!r} exists; rotate it, or take another name")

        self._connections.run(job)

    def renew(self, name: str, secret_hash: bytes) -> Token:
        """Give a token another secret."""
        return self._changed("UPDATE token SET hash = %s, confirmed = true WHERE name = %s", name, secret_hash)

    def remove(self, name: str) -> None:
        """Forget a token."""

        def job(connection: Connection) -> None:
            check_changed(connection.execute("DELETE FROM token WHERE name = %s", (name,)).rowcount, name)

        self._connections.run(job)
        self.forget_known()

    def confirm(self, name: str) -> Token:
        """Let a restored token count again."""
        return self._changed("UPDATE token SET confirmed = true WHERE name = %s", name)

    def all(self) -> list[Token]:
        """All tokens, by name."""
        self.write_used()
        self._threads.flush()
        with self._connections.lent() as connection:
            return [token_row(row) for row in rows(connection, f"{_SELECT} ORDER BY t.name")]

    def of_hash(self, secret_hash: bytes) -> Token | None:
        """The token of a secret, as it was at most a second ago, and not before it was changed here."""
        return self._known.get(secret_hash, lambda: self._look_up(secret_hash))

    def used(self, name: str) -> None:
        """Note that a token was shown just now; written some seconds later."""
        with self._lock:
            self._used[name] = time.monotonic(), self._age.now_s()
            if time.monotonic() - self._written_s < USED_EVERY_S:
                return
        self.write_used()

    def write_used(self) -> None:
        """Write soon what is noted."""
        with self._lock:
            noted, self._used = self._used, {}
            self._written_s = time.monotonic()
        if not noted:
            return
        names = sorted(noted)
        query = (
            f"UPDATE token SET last_used_s = {NOW_S} - u.ago_s, used_age_s = u.age_s"
            " FROM unnest(%s::text[], %s::float8[], %s::float8[]) AS u (name, ago_s, age_s) WHERE token.name = u.name"
        )

        def job(connection: Connection) -> None:
            ago_s = [time.monotonic() - noted[name][0] for name in names]
            connection.execute(query, (names, ago_s, [noted[name][1] for name in names]))

        self._threads.note(job)

    def _look_up(self, secret_hash: bytes) -> Token | None:
        with self._connections.lent() as connection:
            found = rows(connection, f"{_SELECT} WHERE t.hash = %s", (secret_hash,))
        return token_row(found[0]) if found else None

    def _changed(self, query: str, name: str, *values: bytes) -> Token:
        def job(connection: Connection) -> Token:
            check_changed(connection.execute(query.encode(), (*values, name)).rowcount, name)
            return token_row(rows(connection, f"{_SELECT} WHERE t.name = %s", (name,))[0])

        token = self._connections.run(job)
        self.forget_known()
        return token


@dataclass(frozen=True, slots=True)
class _WaitingLine:
    """A line of the audit log, and that it is durable."""

    said: AuditText
    written: "Future[None]" = field(default_factory=Future)

    def __post_init__(self) -> None:
        """Refuse a text that the database cannot hold, before it is written together with others' lines.

        Raises:
            UnicodeEncodeError: half of a surrogate pair.
        """
        f"{self.said.who}{self.said.what}{self.said.detail}{self.said.client}".encode()


class PgAuditLog:
    """`store.AuditLog`: one chain for all servers of the store, so one of them adds to it at a time.

    Lines that come to a server while it waits for its turn, as of robots that all register after an outage, are written
    by one transaction: they wait for one flush of the database's disk and not each for its own.
    """

    def __init__(self, connections: Connections) -> None:
        self._connections = connections
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._waiting: list[_WaitingLine] = []

    def add(self, who: str, what: str, detail: str, *, client: str = "") -> None:
        """One more line; durable on return."""
        log.info("%s: %s: %r", who, what, detail)
        line = _WaitingLine(AuditText(who, what, detail, client))
        with self._lock:
            self._waiting.append(line)
        with self._turn:
            if not line.written.done():
                self._write_waiting()
        line.written.result()

    def _write_waiting(self) -> None:
        """Write all lines that wait, in the order in which they came."""
        with self._lock:
            lines, self._waiting = self._waiting, []

        def job(connection: Connection) -> None:
            for line in lines:
                write_audit(connection, SERVER_STREAM, line.said)

        try:
            self._connections.run(job)
        except BaseException as exc:
            for line in lines:
                line.written.set_exception(exc)
            raise
        for line in lines:
            line.written.set_result(None)

    def page(
        self, *, limit: int, after: int = 0, before: int | None = None, choice: AuditChoice = ALL_LINES
    ) -> list[AuditEntry]:
        """Lines of a choice, oldest first, or with `before` newest first."""
        conditions, values = choice.conditions("%s")
        where = " AND ".join(["stream = %s", "number > %s", "number < %s", *conditions])
        order = "number" if before is None else "number DESC"
        query = f"SELECT {AUDIT_COLUMNS} FROM audit WHERE {where} ORDER BY {order} LIMIT %s"
        limits = (after, NUMBER_LIMIT - 1 if before is None else before)
        with self._connections.lent() as connection:
            found = rows(connection, query, (SERVER_STREAM, *limits, *values, limit))
        return [audit_entry(row) for row in found]


def write_audit(connection: Connection, stream: str, said: AuditText) -> None:
    """One more line of a stream, chained to its last, inside a transaction; the newest lines are kept."""
    said = AuditText(*(text.replace("\0", "\\0") for text in (said.who, said.what, said.detail, said.client)))
    connection.execute("INSERT INTO audit_head VALUES (%s, 0, '') ON CONFLICT DO NOTHING", (stream,))
    query = f"SELECT number, chain, {NOW_S} FROM audit_head WHERE stream = %s FOR NO KEY UPDATE"
    last, before, time_s = first(connection, query, (stream,))
    number = last + 1
    chain = audit_chain(before, number, time_s, said)
    connection.execute(
        "INSERT INTO audit (stream, number, time_s, who, what, detail, chain, client)"
        " VALUES (%s, %s, %s, %s, %s, %s, %s, %s)",
        (stream, number, time_s, said.who, said.what, said.detail, chain, said.client),
    )
    query = "UPDATE audit_head SET number = %s, chain = %s WHERE stream = %s"
    connection.execute(query, (number, chain, stream))
    connection.execute("DELETE FROM audit WHERE stream = %s AND number <= %s", (stream, number - AUDIT_ROWS_MAX))


def put_registration(connection: Connection, row: MapRow, robot: str, secret_hash: bytes, *, age_s: float) -> None:
    """The token of a registration, inside its transaction; the one of an earlier registration is worth nothing then."""
    connection.execute(
        "INSERT INTO token (name, role, map, robot, hash, created_s, created_age_s)"
        f" VALUES (%s, 'robot', %s, %s, %s, {NOW_S}, %s)"
        " ON CONFLICT (name) DO UPDATE SET hash = excluded.hash, created_s = excluded.created_s,"
        " created_age_s = excluded.created_age_s, expires_s = NULL, last_used_s = NULL, used_age_s = 0,"
        " confirmed = true",
        (registration_name(row.name, robot), row.number, robot, secret_hash, age_s),
    )


def remove_tokens_of(connection: Connection, row: MapRow, robot: str) -> None:
    """Forget every token of a robot on a map, inside a transaction."""
    connection.execute("DELETE FROM token WHERE map = %s AND robot = %s", (row.number, robot))
