"""The embedded store as one file, copied while a server works on it; and a folder made out of such a file.

SQLite's backup begins again whenever another process writes, and would never end while a server is busy. So it copies
out of one read transaction: one state of all maps, however long it takes. What is written meanwhile waits in the
write-ahead log. The copy has its name only when all of it is on the disk.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import apsw

from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError
from cairn_server.store.folder_lock import LOCK_NAME, lock_folder
from cairn_server.store.sqlite.schema import STEPS, ensure_schema
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.sqlite.writer import BUSY_MS

STEP_PAGES = 256
"""Copied at once: 4 MB."""
SIDES = ("", "-wal", "-shm", "-journal")

Report = Callable[[int, int], None]
"""Called with pages done and all pages."""


def back_up(folder: Path, target: Path, report: Report) -> int:
    """Copy the store of a folder into a file; its size in bytes. An older backup of that name is replaced at the end.

    Raises:
        NotFoundError: kind `no_store`: the folder has none.
        BadInputError: kind `bad_backup`: it cannot be written there, or something that is no backup is there already.
        DamagedDataError: kind `damaged_store`: the store cannot be read.
    """
    source = folder / FILE_NAME
    if not source.is_file():
        raise NotFoundError("no_store", f"{folder} has no store; name the folder that `cairn serve --data` works on")
    if target.exists() and (target.samefile(source) or not is_store(target)):
        raise BadInputError("bad_backup", f"{target} is there and is no backup; choose another name")
    with _partial(target) as partial:
        _copy(source, partial, report)
    return target.stat().st_size


def restore(source: Path, folder: Path, report: Report, verify: Callable[[Path], None]) -> None:
    """Make a folder's store out of a backup; `verify` raises if the copy is not sound, and then nothing is left of it.

    Raises:
        NotFoundError: kind `no_store`: the file is not there.
        ConflictError: kind `store_in_use` or `not_empty`: a server works on the folder, or something is in it.
        BadInputError: kind `bad_backup` or `store_version`: the file is no store that this version knows.
        DamagedDataError: what `verify` finds.
    """
    if not source.is_file():
        raise NotFoundError("no_store", f"there is no file {source}")
    if not is_store(source):
        raise BadInputError("bad_backup", f"{source} is no backup of a cairn server")
    folder.mkdir(0o700, parents=True, exist_ok=True)
    with lock_folder(folder):
        found = sorted(path.name for path in folder.iterdir() if path.name != LOCK_NAME)
        if found:
            raise ConflictError("not_empty", f"{folder} is not empty, it has {found[0]}; restore into a new folder")
        with _partial(folder / FILE_NAME) as partial:
            _copy(source, partial, report)
            _migrate(partial)
            verify(partial)
            _settle(partial)


def is_store(path: Path) -> bool:
    """True if a file is a store of this version of cairn, or of an earlier one."""
    try:
        connection = _opened(path)
        try:
            version = connection.pragma("user_version")
            return 0 < version <= len(STEPS) and bool(
                connection.execute("SELECT count(*) FROM sqlite_master WHERE name IN ('map', 'commits', 'log')").get
                == 3
            )
        finally:
            connection.close()
    except apsw.Error:
        return False


def _opened(path: Path) -> apsw.Connection:
    """Connection that only reads; on a store at work it must be able to write next to the file, not in it."""
    connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READWRITE)
    connection.set_busy_timeout(BUSY_MS)
    connection.execute("PRAGMA query_only = ON")
    return connection


def _copy(source: Path, target: Path, report: Report) -> None:
    from_store = _opened(source)
    to_file = apsw.Connection(str(target))
    try:
        from_store.execute("BEGIN")
        from_store.execute("SELECT count(*) FROM sqlite_master").fetchall()
        with to_file.backup("main", from_store, "main") as backup:
            while not backup.done:
                backup.step(STEP_PAGES)
                report(backup.page_count - backup.remaining, backup.page_count)
    except apsw.FullError as exc:
        raise BadInputError("bad_backup", f"no room for {target.parent}: {exc}") from exc
    except apsw.Error as exc:
        raise DamagedDataError("damaged_store", f"{source} cannot be copied: {exc}") from exc
    finally:
        from_store.close()
        to_file.close()
    _settle(target)


def _settle(path: Path) -> None:
    """Make a copy one file, without a separate log."""
    connection = apsw.Connection(str(path))
    try:
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    finally:
        connection.close()


def _migrate(path: Path) -> None:
    connection = apsw.Connection(str(path))
    try:
        ensure_schema(connection)
    finally:
        connection.close()


@contextmanager
def _partial(target: Path) -> Iterator[Path]:
    """A file that takes the name of the target at the end, wholly on the disk; gone if anything fails."""
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    try:
        partial.touch(0o600)
        yield partial
        _sync(partial)
        partial.replace(target)
        _sync(target.parent)
    except (OSError, apsw.Error) as exc:
        raise BadInputError("bad_backup", f"{target} cannot be written: {exc}") from exc
    finally:
        for side in SIDES:
            with suppress(OSError):
                partial.with_name(partial.name + side).unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
