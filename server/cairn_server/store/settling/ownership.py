"""Ownership of a bucket: the proof that this database, and no copy of it, may settle into it and delete from it.

A copy of a database knows all that the original knew, so no secret in it can tell the two apart. An object of the
bucket does, which the settler that works writes again every some seconds:

    database   cluster and number of the database     a dump that was restored has another one
    era        drawn when the bucket was taken        `cairn serve adopt` draws the next one: all others are out
    turned_s   time of the turn, in the row, too      a copy knows an older one: at most `TAIL_S` is a lost tail
    holder     the process                            the text changes while any other process works

A process begins once the text stood still for `STILL_TURNS` turns, and goes on while it is the one that it wrote. So
a standby that was promoted goes on by itself, though its newest turns may be lost; a copy next to a live original finds
a text that changes, and one of yesterday a turn that is too new, be the original alive or not.
"""

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from cairn_map.errors import BadInputError
from cairn_server.store.objects.bucket import Bucket
from cairn_server.store.objects.cold_bytes import OWNER
from cairn_server.store.postgres.connections import Connections, first
from cairn_server.store.postgres.schema import NOW_S

TURN_S = 20.0
"""Time between two turns."""
STILL_TURNS = 15
"""Turns of the other settler for which its text has to stand still: one that writes 64 MB over a slow link is alive."""
CHECK_SHARE = 0.1
"""Share of a turn for which the object is not read again: who takes the bucket waits for many turns first."""
TAIL_S = 600.0
"""Longest time by which a database may be behind its bucket's object and go on: turns that a failover lost."""
ERA_BYTES = 16
THIS_DATABASE = f"""
    SELECT c.system_identifier || '/' || d.oid, o.era, o.turned_s, {NOW_S}
    FROM object_store AS o, pg_control_system() AS c, pg_database AS d WHERE d.datname = current_database()"""


class Owner(BaseModel):
    """Text of the bucket's object."""

    model_config = ConfigDict(frozen=True)

    database: str
    era: str
    turned_s: float
    holder: str
    every_s: float


class _Row(NamedTuple):
    """Facts of the database itself."""

    database: str
    era: str | None
    turned_s: float
    now_s: float


class Ownership:
    """Proof for one process that works on a bucket; one thread at a time."""

    def __init__(
        self,
        connections: Connections,
        bucket: Bucket,
        *,
        holder: str,
        every_s: float = TURN_S,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take turns each `every_s`, by this steady clock."""
        self._connections = connections
        self._bucket = bucket
        self._holder = holder
        self._every_s = every_s
        self._steady_s = steady_s
        self._written: bytes | None = None
        self._written_s = self._checked_s = 0.0
        self._found: bytes | None = None
        self._found_s: float | None = None

    def holds(self) -> bool:
        """True if this process may settle and delete now; False: it waits until the object stood still.

        Raises:
            BadInputError: kind `bad_objects`: the bucket is another database's.
            AwayError: the object store does not answer.
        """
        now_s = self._steady_s()
        if self._written is not None and now_s - self._checked_s < CHECK_SHARE * self._every_s:
            return True
        found, self._checked_s = self._bucket.get(OWNER), now_s
        if found is not None and found == self._written:
            if now_s - self._written_s >= self._every_s:
                self._turn(_row(self._connections))
            return True
        self._written = None
        row = _row(self._connections)
        if found is None and row.era is None:
            self._turn(row._replace(era=secrets.token_hex(ERA_BYTES)))
            return True
        stated = None if found is None else _stated(found)
        if stated is not None:
            _check(stated, row)
        if not self._stands_still(found, self._every_s if stated is None else max(stated.every_s, self._every_s)):
            return False
        self._turn(row)
        return True

    def _stands_still(self, found: bytes | None, every_s: float) -> bool:
        now_s = self._steady_s()
        if self._found_s is None or found != self._found:
            self._found, self._found_s = found, now_s
        return now_s - self._found_s >= STILL_TURNS * every_s

    def _turn(self, row: _Row) -> None:
        """Write the object, then the row: a kill between the two is a lost tail of one turn."""
        era = row.era or secrets.token_hex(ERA_BYTES)
        text = _write(self._connections, self._bucket, row, era, holder=self._holder, every_s=self._every_s)
        self._written, self._written_s = text, self._steady_s()


def adopt(connections: Connections, bucket: Bucket) -> Owner | None:
    """Make this database the owner of its bucket, whichever was; the owner until now.

    Raises:
        AwayError: the object store does not answer.
    """
    before: Owner | None = None
    with suppress(BadInputError):  # an object that cannot be read is written again
        found = bucket.get(OWNER)
        before = None if found is None else _stated(found)
    _write(connections, bucket, _row(connections), secrets.token_hex(ERA_BYTES), holder="adopted", every_s=0.0)
    return before


def check_owner(connections: Connections, bucket: Bucket) -> None:
    """Refuse a database that cannot be the owner of its bucket.

    Raises:
        BadInputError: kind `bad_objects`: the bucket is another database's.
        AwayError: the object store does not answer.
    """
    found = bucket.get(OWNER)
    if found is not None:
        _check(_stated(found), _row(connections))


def _write(connections: Connections, bucket: Bucket, row: _Row, era: str, *, holder: str, every_s: float) -> bytes:
    owner = Owner(database=row.database, era=era, turned_s=row.now_s, holder=holder, every_s=every_s)
    text = owner.model_dump_json().encode()
    bucket.put(OWNER, text)
    with connections.lent() as connection:
        connection.execute("UPDATE object_store SET era = %s, turned_s = %s", (era, row.now_s))
    return text


def _row(connections: Connections) -> _Row:
    with connections.lent() as connection:
        return _Row(*first(connection, THIS_DATABASE))


def _stated(text: bytes) -> Owner:
    try:
        return Owner.model_validate_json(text)
    except ValidationError as exc:
        raise _foreign(f"its object {OWNER} cannot be read") from exc


def _check(stated: Owner, row: _Row) -> None:
    if stated.database != row.database:
        raise _foreign(f"database {stated.database} owns it, and this one is {row.database}")
    if stated.era != row.era:
        raise _foreign("it was taken by another database, or by a later state of this one")
    if stated.turned_s - row.turned_s > TAIL_S:
        raise _foreign(
            f"a database that is this one's original, or its later state, worked on it until {time_text(stated)}, and "
            f"this one until {_time_text(row.turned_s)}"
        )


def time_text(owner: Owner) -> str:
    """Time of an owner's newest turn."""
    return _time_text(owner.turned_s)


def _time_text(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _foreign(why: str) -> BadInputError:
    return BadInputError(
        "bad_objects",
        f"the bucket is not this database's: {why}. Cold bytes are read, but nothing is moved there or deleted. If "
        "this database is a copy, give it a copy of the bucket, too; if it takes the other one's place for good "
        "(after a restore), end the servers of the other one and run `cairn serve adopt --store URL --objects URL`",
    )
