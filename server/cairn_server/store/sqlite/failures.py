"""Errors of SQLite as errors of cairn: a full disk, damaged pages, or a store that cannot work now."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw

from cairn_map.errors import BadInputError, CairnError, DamagedDataError, UnreachableError

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""No space, no quota, a file as long as it may get: SQLite calls only the first of them a full disk."""
OPENING_BYTES = 1 << 16
"""Room that opening a store takes next to it: the index of the write-ahead log, and its first page."""
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


def opening_failure(exc: apsw.Error | OSError, path: Path) -> CairnError:
    """A store that cannot be opened, by its cause: its disk, its owner, or its bytes."""
    if is_full(exc, path):
        return disk_full(f"{path} cannot be opened: its disk is full, and the store may be sound; make room for it")
    if isinstance(exc, apsw.NotADBError):
        return BadInputError("bad_store", f"{path} is not a store: {exc}")
    if isinstance(exc, apsw.CorruptError):
        return DamagedDataError("damaged_store", f"{path} is damaged: {exc}; restore a backup (cairn serve restore)")
    text = exc.strerror if isinstance(exc, OSError) else str(exc)
    return BadInputError(
        "bad_store", f"{path} cannot be opened: {text}; it and its folder must belong to the user who runs this"
    )


def is_full(exc: apsw.Error | OSError, path: Path) -> bool:
    """True if there was no room for a file, or next to it."""
    if isinstance(exc, OSError):
        return exc.errno in FULL
    if isinstance(exc, apsw.FullError):
        return True
    # While a connection is made, its error does not say what the system said.
    found = os.statvfs(path.parent)
    return isinstance(exc, apsw.IOError | apsw.CantOpenError) and found.f_bavail * found.f_frsize < OPENING_BYTES


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
