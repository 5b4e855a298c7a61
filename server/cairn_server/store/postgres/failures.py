"""Errors of PostgreSQL as errors of cairn: a full disk, damaged pages, a database that cannot work now; lost maps."""

from typing import Any

import psycopg
from psycopg import errors

from cairn_map.errors import BadInputError, CairnError, DamagedDataError, NotFoundError, UnreachableError
from cairn_server.map_refusals import GoneMap, map_gone, no_map

_Connection = psycopg.Connection[tuple[Any, ...]]

RETRY_S = 2.0
"""A failover takes some seconds."""
RETRY_FULL_S = 30.0
"""Somebody has to make room first."""
AGAIN = (
    *(errors.DeadlockDetected, errors.SerializationFailure, errors.CheckViolation, errors.UniqueViolation),
    errors.IdleInTransactionSessionTimeout,
)
"""Errors of a transaction that met another one: run again, it finds what the other one wrote. Or that was rolled back
because this process did not get to go on with it (`connections.SETTINGS`)."""


def failure_of(exc: psycopg.Error) -> CairnError:
    """Error for a statement that was not carried out; whatever was acknowledged before it is safe."""
    text = _cause(exc)
    if isinstance(exc, errors.DiskFull):
        return UnreachableError("disk_full", f"the database's disk is full: {text}", retry_after_s=RETRY_FULL_S)
    if isinstance(exc, errors.DataCorrupted | errors.IndexCorrupted):
        return DamagedDataError("damaged_store", f"the database is damaged: {text}")
    return UnreachableError("store_failed", f"the database does not answer: {text}", retry_after_s=RETRY_S)


def lost_map(connection: _Connection, number: int) -> CairnError:
    """Error for a map that a server knows and the database has no more: it was deleted.

    Or the database was put back to a state before the map. The name is looked up again soon (`store.NAMES_S`), and may
    be another map's now.
    """
    gone = _gone(connection, "WHERE map = %s", number)
    if gone is not None:
        return map_gone(gone)
    return UnreachableError("store_failed", f"the database has lost map number {number}", retry_after_s=RETRY_S)


def missing_map(connection: _Connection, name: str) -> NotFoundError:
    """Error for a name that no map has: `gone`, if one had it."""
    gone = _gone(connection, "WHERE name = %s ORDER BY deleted_s DESC LIMIT 1", name)
    return no_map(name) if gone is None else map_gone(gone)


def gone_of_token(connection: _Connection, secret_hash: bytes) -> GoneMap | None:
    """The deleted map with which the token of a secret ended."""
    return _gone(connection, "WHERE map = (SELECT map FROM gone_token WHERE hash = %s)", secret_hash)


def opening_failure(exc: psycopg.Error, place: str) -> BadInputError:
    """Error for a database that cannot be opened as a store; `place` names it without its password."""
    text = _cause(exc)
    if isinstance(exc, errors.InsufficientPrivilege | errors.ReadOnlySqlTransaction):
        return BadInputError(
            "bad_store",
            f"the user of {place} may not make tables there: {text}; make the user the owner of its database",
        )
    if isinstance(exc, errors.DuplicateTable):
        return BadInputError(
            "bad_store", f"{place} has tables of another program: {text}; give cairn a database of its own"
        )
    if isinstance(exc, psycopg.OperationalError):
        return BadInputError(
            "bad_store", f"cannot open a store at {place}: {text}; check that it runs, and host, database and password"
        )
    return BadInputError("bad_store", f"cannot open a store at {place}: {text}")


def _cause(exc: psycopg.Error) -> str:
    return exc.diag.message_primary or " ".join(str(exc).split()) or type(exc).__name__


def _gone(connection: _Connection, clause: str, value: str | int | bytes) -> GoneMap | None:
    found = connection.execute(f"SELECT map, name, deleted_s, by FROM gone_map {clause}".encode(), (value,)).fetchone()
    return None if found is None else GoneMap(number=found[0], name=found[1], deleted_s=found[2], by=found[3])
