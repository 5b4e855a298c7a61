"""Attachments as rows of a database (`attachments.Attachments`), in SQL that SQLite and PostgreSQL both read.

    mark               attached_sha, attached_bytes      what a living mark names; NULL once it was taken out
    attachment         one row for each sender of it     with an empty sender: whole
    attachment_part    the bytes, in parts, in order

A sweep notes when a row was found out of use, and removes it once it stayed so for `GRACE_S`. What is named again in
time is in use again.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

from cairn_map.commits.attachment import Attachment
from cairn_map.commits.ids import OPERATOR
from cairn_server.store.attachments.attachments import (
    GRACE_S,
    NAMERS_MAX,
    SWEEP_MAX,
    AttachmentPart,
    Attachments,
    Namer,
    check_room,
)

T = TypeVar("T")
Rows = list[tuple[Any, ...]]
Query = Callable[[str, tuple[str | int | float | bytes | None, ...]], Rows]
"""Function that runs a statement, whose values are marked by `?`, and returns its rows, if it has any."""

ONE = "map = ? AND sha = ? AND uploader = ?"
IS_NAMED = "EXISTS (SELECT 1 FROM mark WHERE mark.map = attachment.map AND mark.attached_sha = attachment.sha)"
IS_IDLE = f"(uploader <> '' OR NOT {IS_NAMED})"
"""SQL that is true of rows that nothing keeps: of a sender, which sends on or not, and those that no mark names."""
OF_MARKS = "FROM mark JOIN commits AS c ON c.map = mark.map AND c.number = mark.commit_number WHERE mark.map = ?"
IS_LACKING = (
    "attached_sha IS NOT NULL AND NOT EXISTS (SELECT 1 FROM attachment AS whole"
    " WHERE whole.map = mark.map AND whole.sha = mark.attached_sha AND whole.uploader = '')"
)


class Database(Protocol):
    """Part of a database that these rows use."""

    def run(self, job: Callable[[Query], T]) -> T:
        """Result of a job in one transaction, durable on return."""
        ...

    def reading(self) -> AbstractContextManager[Query]:
        """Function for readings, for the length of a `with`."""
        ...

    def check_lives(self, query: Query, map_number: int) -> None:
        """Refuse to write to a map that was deleted, in a transaction that no deletion overlaps.

        Raises:
            NotFoundError: kind `gone`.
        """
        ...


class AttachmentRows:
    """`attachments.Attachments` in the tables of a database."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def wanted(self, map_number: int, *, robot: str | None, limit: int) -> list[Attachment]:
        """Attachments that living marks name and that are not whole here; oldest mark first."""
        of_robot, values = ("", ()) if robot is None else (" AND c.robot IN (?, ?)", (robot, OPERATOR))
        found = self._read(
            f"SELECT attached_sha, attached_bytes {OF_MARKS} AND {IS_LACKING}{of_robot}"
            " GROUP BY attached_sha, attached_bytes ORDER BY min(mark.commit_number), attached_sha LIMIT ?",
            (map_number, *values, limit),
        )
        return [Attachment(sha256=bytes(sha).hex(), size_bytes=size_bytes) for sha, size_bytes in found]

    def namers(self, map_number: int, sha: bytes) -> list[Namer]:
        """Marks that name an attachment, folded or not, oldest first."""
        found = self._read(
            f"SELECT c.robot, attached_bytes {OF_MARKS} AND attached_sha = ?"
            " ORDER BY mark.commit_number, mark.n LIMIT ?",
            (map_number, sha, NAMERS_MAX),
        )
        return [Namer(robot, size_bytes) for robot, size_bytes in found]

    def is_whole(self, map_number: int, sha: bytes) -> bool:
        """True if the bytes are here."""
        return bool(self._read(f"SELECT 1 FROM attachment WHERE {ONE}", (map_number, sha, "")))  # noqa: S608

    def add_part(self, map_number: int, sha: bytes, part: AttachmentPart) -> int:
        """Keep a part that goes on where this sender's last one ended; bytes held of it."""
        key = (map_number, sha, part.uploader)

        def job(query: Query) -> int:
            self._database.check_lives(query, map_number)
            known = query(f"SELECT size_bytes, held_bytes FROM attachment WHERE {ONE}", key)  # noqa: S608
            held_bytes = int(known[0][1]) if known and known[0][0] == part.total_bytes else 0
            if part.begin_bytes != held_bytes or not part.data:
                return held_bytes
            if not held_bytes:
                _drop(query, *key)
                _check_room(query, map_number, part)
                query(
                    "INSERT INTO attachment (map, sha, uploader, account, size_bytes, held_bytes)"
                    " VALUES (?, ?, ?, ?, ?, 0)",
                    (*key, part.account, part.total_bytes),
                )
            query(
                "INSERT INTO attachment_part (map, sha, uploader, begin_bytes, body) VALUES (?, ?, ?, ?, ?)",
                (*key, part.begin_bytes, part.data),
            )
            held_bytes += len(part.data)
            # It is in use now: the next sweep begins to count again.
            query(f"UPDATE attachment SET held_bytes = ?, idle_age_s = NULL WHERE {ONE}", (held_bytes, *key))  # noqa: S608
            return held_bytes

        return self._database.run(job)

    def data(self, map_number: int, sha: bytes, *, uploader: str = "") -> bytes:
        """Bytes of a sender, or of the whole attachment, as far as they are here."""
        found = self._read(
            f"SELECT body FROM attachment_part WHERE {ONE} ORDER BY begin_bytes",  # noqa: S608
            (map_number, sha, uploader),
        )
        return b"".join(bytes(body) for (body,) in found)

    def settle(self, map_number: int, sha: bytes, *, uploader: str) -> None:
        """Take the bytes of a sender for the attachment, and drop those of all others."""

        def job(query: Query) -> None:
            self._database.check_lives(query, map_number)
            for table in ("attachment_part", "attachment"):
                query(f"DELETE FROM {table} WHERE map = ? AND sha = ? AND uploader <> ?", (map_number, sha, uploader))  # noqa: S608
                query(f"UPDATE {table} SET uploader = '' WHERE {ONE}", (map_number, sha, uploader))  # noqa: S608
            query(f"UPDATE attachment SET idle_age_s = NULL WHERE {ONE}", (map_number, sha, ""))  # noqa: S608

        self._database.run(job)

    def drop(self, map_number: int, sha: bytes, *, uploader: str = "") -> None:
        """Drop the bytes of a sender, or of the whole attachment."""
        self._database.run(lambda query: _drop(query, map_number, sha, uploader))

    def whole(self, map_number: int) -> list[Attachment]:
        """Attachments that are whole here, by SHA-256."""
        query = "SELECT sha, size_bytes FROM attachment WHERE map = ? AND uploader = '' ORDER BY sha"
        found = self._read(query, (map_number,))
        return [Attachment(sha256=bytes(sha).hex(), size_bytes=size_bytes) for sha, size_bytes in found]

    def sweep(self, *, now_s: float) -> bool:
        """Remove some of what is out of use for `GRACE_S`; False once nothing is left of that."""
        if not self._is_to_sweep(now_s):
            return False

        def job(query: Query) -> bool:
            # What was named again in time, then what is out of use from now on, then what was so for long enough.
            query(f"UPDATE attachment SET idle_age_s = NULL WHERE idle_age_s IS NOT NULL AND NOT {IS_IDLE}", ())  # noqa: S608
            query(f"UPDATE attachment SET idle_age_s = ? WHERE idle_age_s IS NULL AND {IS_IDLE}", (now_s,))  # noqa: S608
            old = "SELECT map, sha, uploader FROM attachment WHERE idle_age_s < ? ORDER BY idle_age_s LIMIT ?"
            gone = query(old, (now_s - GRACE_S, SWEEP_MAX))
            for key in gone:
                _drop(query, *key)
            return len(gone) == SWEEP_MAX

        return self._database.run(job)

    def _is_to_sweep(self, now_s: float) -> bool:
        """True if a sweep would change something: an idle store writes nothing."""
        return bool(
            self._read(
                f"SELECT 1 FROM attachment WHERE (idle_age_s IS NULL AND {IS_IDLE})"  # noqa: S608 - our own clauses
                f" OR (idle_age_s IS NOT NULL AND NOT {IS_IDLE}) OR idle_age_s < ? LIMIT 1",
                (now_s - GRACE_S,),
            )
        )

    def _read(self, statement: str, values: tuple[str | int | float | bytes | None, ...]) -> Rows:
        with self._database.reading() as query:
            return query(statement, values)


def _drop(query: Query, map_number: int, sha: bytes, uploader: str) -> None:
    for table in ("attachment_part", "attachment"):
        query(f"DELETE FROM {table} WHERE {ONE}", (map_number, sha, uploader))  # noqa: S608 - our own clauses


def _check_room(query: Query, map_number: int, part: AttachmentPart) -> None:
    """Refuse an attachment for which its account has no room: what came in part counts whole.

    Raises:
        BadInputError: kind `too_many_attachments`.
    """
    ((held_bytes,),) = query(
        "SELECT coalesce(sum(size_bytes), 0) FROM attachment WHERE map = ? AND account = ?", (map_number, part.account)
    )
    check_room(part.account, held_bytes=int(held_bytes), more_bytes=part.total_bytes, room_bytes=part.room_bytes)


_IS_ATTACHMENTS: type[Attachments] = AttachmentRows
"""Check of the protocol by the type checker."""
