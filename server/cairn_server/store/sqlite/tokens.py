"""Tokens and the audit log in the embedded store (`store.Tokens`)."""

import logging
import threading
import time
from contextlib import suppress
from typing import Any

import apsw

from cairn_map.errors import ConflictError, UnreachableError
from cairn_map.wire.access_messages import AuditEntry, AuditText, audit_chain
from cairn_server.store.known_tokens import KnownTokens, check_changed, token_row
from cairn_server.store.sqlite.ended_tokens import EndedTokens
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.writer import Writer, first, rows
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
_SELECT = (
    "SELECT t.name, t.role, t.map, m.name, t.robot, t.created_s, t.expires_s, t.last_used_s, t.created_age_s,"
    " t.used_age_s, t.confirmed"
    " FROM token t LEFT JOIN map m ON m.number = t.map"
)


class SqliteTokens:
    """`store.Tokens`."""

    def __init__(self, writer: Writer, readers: Readers, age: StoreAge, ended: EndedTokens) -> None:
        self._writer = writer
        self._ended = ended
        self._readers = readers
        self._age = age
        self._lock = threading.Lock()
        self._used: dict[str, tuple[float, float]] = {}
        """By name: time and age of the store when the token was shown last."""
        self._written_s = float("-inf")
        self._known = KnownTokens()

    def forget_known(self) -> None:
        """Look all tokens up again; called once a change is durable, before it is answered."""
        self._known.forget()

    def add(self, token: Token, secret_hash: bytes) -> None:
        """Keep a new token."""

        def job(connection: apsw.Connection) -> None:
            if first(connection, "SELECT 1 FROM token WHERE name = ?", (token.name,)):
                raise ConflictError("token_exists", f"a token {token.name!r} exists; rotate it, or take another name")
            connection.execute(
                "INSERT INTO token (name, role, map, robot, hash, created_s, expires_s, created_age_s)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    token.name,
                    token.role,
                    token.map_number,
                    token.robot,
                    secret_hash,
                    token.created_s,
                    token.expires_s,
                    self._age.now_s(),
                ),
            )

        self._writer.run(job)

    def renew(self, name: str, secret_hash: bytes) -> Token:
        """Give a token another secret."""

        def job(connection: apsw.Connection) -> Token:
            self._ended.note_named(connection, name)
            connection.execute("UPDATE token SET hash = ?, confirmed = 1 WHERE name = ?", (secret_hash, name))
            check_changed(connection.changes(), name)
            return token_row(connection.execute(f"{_SELECT} WHERE t.name = ?", (name,)).fetchall()[0])

        token = self._writer.run(job)
        self.forget_known()
        return token

    def remove(self, name: str) -> None:
        """Forget a token."""

        def job(connection: apsw.Connection) -> None:
            self._ended.note_named(connection, name)
            connection.execute("DELETE FROM token WHERE name = ?", (name,))
            check_changed(connection.changes(), name)

        self._writer.run(job)
        self.forget_known()

    def confirm(self, name: str) -> Token:
        """Let a restored token count again."""

        def job(connection: apsw.Connection) -> Token:
            connection.execute("UPDATE token SET confirmed = 1 WHERE name = ?", (name,))
            check_changed(connection.changes(), name)
            return token_row(connection.execute(f"{_SELECT} WHERE t.name = ?", (name,)).fetchall()[0])

        token = self._writer.run(job)
        self.forget_known()
        return token

    def all(self) -> list[Token]:
        """All tokens, by name."""
        self.write_used()
        with self._readers.reading() as reader:
            return [token_row(row) for row in rows(reader, f"{_SELECT} ORDER BY t.name")]

    def of_hash(self, secret_hash: bytes) -> Token | None:
        """The token of a secret, as it was at most a second ago, and not before it was changed."""
        return self._known.get(secret_hash, lambda: self._look_up(secret_hash))

    def used(self, name: str) -> None:
        """Note that a token was shown just now; written some seconds later."""
        with self._lock:
            self._used[name] = time.time(), self._age.now_s()
            if time.monotonic() - self._written_s < USED_EVERY_S:
                return
        with suppress(UnreachableError):  # it is only a note
            self._submit()

    def write_used(self) -> None:
        """Write what is noted now."""
        self._submit().result()

    def _look_up(self, secret_hash: bytes) -> Token | None:
        with self._readers.reading() as reader:
            found = rows(reader, f"{_SELECT} WHERE t.hash = ?", (secret_hash,))
        return token_row(found[0]) if found else None

    def _submit(self) -> Any:
        with self._lock:
            noted, self._used = self._used, {}
            self._written_s = time.monotonic()
        values = [(*used, name) for name, used in noted.items()]
        return self._writer.submit(
            lambda connection: connection.executemany(
                "UPDATE token SET last_used_s = ?, used_age_s = ? WHERE name = ?", values
            ).fetchall()
        )


class SqliteAuditLog:
    """`store.AuditLog`."""

    def __init__(self, writer: Writer, readers: Readers) -> None:
        self._writer = writer
        self._readers = readers

    def add(self, who: str, what: str, detail: str, *, client: str = "") -> None:
        """One more line; durable on return."""
        log.info("%s: %s: %r", who, what, detail)
        said = AuditText(who, what, detail, client)
        self._writer.run(lambda connection: write_audit(connection, said))

    def page(
        self, *, limit: int, after: int = 0, before: int | None = None, choice: AuditChoice = ALL_LINES
    ) -> list[AuditEntry]:
        """Lines of a choice, oldest first, or with `before` newest first."""
        conditions, values = choice.conditions("?")
        where = " AND ".join(["number > ?", "number < ?", *conditions])
        order = "number" if before is None else "number DESC"
        query = f"SELECT {AUDIT_COLUMNS} FROM audit WHERE {where} ORDER BY {order} LIMIT ?"  # noqa: S608
        limits = (after, NUMBER_LIMIT - 1 if before is None else before)
        with self._readers.reading() as reader:
            found = rows(reader, query, (*limits, *values, limit))
        return [audit_entry(row) for row in found]


def write_audit(connection: apsw.Connection, said: AuditText) -> None:
    """One more line of the audit log, chained to the last, inside a transaction; the newest lines are kept."""
    last, before = first(connection, "SELECT number, chain FROM audit ORDER BY number DESC LIMIT 1") or (0, b"")
    number, time_s = last + 1, time.time()
    chain = audit_chain(before, number, time_s, said)
    connection.execute(
        "INSERT INTO audit (number, time_s, who, what, detail, chain, client) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (number, time_s, said.who, said.what, said.detail, chain, said.client),
    )
    connection.execute("DELETE FROM audit WHERE number <= ?", (number - AUDIT_ROWS_MAX,))


def put_registration(connection: apsw.Connection, row: MapRow, robot: str, secret_hash: bytes, *, age_s: float) -> None:
    """The token of a registration, inside its transaction; the one of an earlier registration is worth nothing then."""
    connection.execute(
        "INSERT INTO token (name, role, map, robot, hash, created_s, created_age_s) VALUES (?, 'robot', ?, ?, ?, ?, ?)"
        " ON CONFLICT (name) DO UPDATE SET hash = excluded.hash, created_s = excluded.created_s,"
        " created_age_s = excluded.created_age_s, expires_s = NULL, last_used_s = NULL, used_age_s = 0, confirmed = 1",
        (registration_name(row.name, robot), row.number, robot, secret_hash, time.time(), age_s),
    )


def remove_tokens_of(connection: apsw.Connection, row: MapRow, robot: str) -> None:
    """Forget every token of a robot on a map, inside a transaction."""
    connection.execute("DELETE FROM token WHERE map = ? AND robot = ?", (row.number, robot))
