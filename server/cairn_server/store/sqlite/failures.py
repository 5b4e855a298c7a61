"""Errors of SQLite as errors of cairn: a full disk, damaged pages, or a store that cannot work now."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager

import apsw

from cairn_map.errors import CairnError, DamagedDataError, UnreachableError

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""No space, no quota, a file as long as it may get: SQLite calls only the first of them a full disk."""
RETRY_S = 5.0
RETRY_FULL_S = 30.0
"""Somebody has to make room first."""


def write_failure(exc: apsw.Error | MemoryError, connection: apsw.Connection) -> UnreachableError:
    """A transaction that was not written; everything before it is safe."""
    if isinstance(exc, apsw.FullError) or (isinstance(exc, apsw.IOError) and connection.system_errno in FULL):
        return disk_full(f"the server's disk is full: {exc}")
    return UnreachableError("store_failed", f"the store could not write: {exc}", retry_after_s=RETRY_S)


def disk_full(message: str) -> UnreachableError:
    """Nothing can be kept until there is room; reading goes on."""
    return UnreachableError("disk_full", message, retry_after_s=RETRY_FULL_S)


def read_failure(exc: apsw.Error) -> CairnError:
    """A query that was not answered."""
    if isinstance(exc, apsw.CorruptError | apsw.NotADBError):
        return DamagedDataError("damaged_store", f"the store's file is damaged: {exc}; see `cairn serve check`")
    return UnreachableError("store_failed", f"the store could not read: {exc}", retry_after_s=RETRY_S)


@contextmanager
def damaged_pages() -> Iterator[None]:
    """Read one row whose pages may be damaged, without giving up the rows that can be read.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    try:
        yield
    except (apsw.CorruptError, apsw.NotADBError) as exc:
        raise read_failure(exc) from exc
