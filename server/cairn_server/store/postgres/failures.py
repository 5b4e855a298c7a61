"""Errors of PostgreSQL as errors of cairn: a full disk, damaged pages, or a database that cannot work now."""

import psycopg
from psycopg import errors

from cairn_map.errors import BadInputError, CairnError, DamagedDataError, UnreachableError

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


def lost_map(number: int) -> UnreachableError:
    """Error for a map that a server knows and the database has no more: it was put back to a state before the map.

    The name is looked up again soon (`store.NAMES_S`), and may be another map's now.
    """
    return UnreachableError("store_failed", f"the database has lost map number {number}", retry_after_s=RETRY_S)


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
