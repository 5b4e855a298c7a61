"""The embedded store as one file, copied while a server works on it; and a folder made out of such a file.

SQLite's backup begins again whenever another process writes, and would never end while a server is busy. So it copies
out of one read transaction: one state of all maps, however long it takes. What is written meanwhile waits in the
write-ahead log. The copy has its name only when all of it is on the disk.
"""

import os
import shutil
import struct
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import apsw

from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError
from cairn_server.store.backup_note import NOTE_NAME, note_backup
from cairn_server.store.folder_lock import LOCK_NAME, lock_folder
from cairn_server.store.private_files import give_to_owner
from cairn_server.store.sqlite.archive import check_form
from cairn_server.store.sqlite.ended_tokens import LIST_NAME, copy_list, ended_since
from cairn_server.store.sqlite.failures import is_full, opening_failure
from cairn_server.store.sqlite.schema import STEPS, ensure_schema, newer_store
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.sqlite.writer import BUSY_MS

STEP_PAGES = 256
"""Copied at once: 4 MB."""
SIDES = ("", "-wal", "-shm", "-journal")
MAGIC = b"SQLite format 3\0"
HEAD = struct.Struct(">16xH10xI")
"""Beginning of a file of SQLite: the size of a page (1: 2^16), and the count of pages."""
UNREADABLE = frozenset(
    {apsw.SQLITE_IOERR_READ, apsw.SQLITE_IOERR_SHORT_READ, apsw.SQLITE_IOERR_DATA, apsw.SQLITE_IOERR_CORRUPTFS}
)
"""Failures to read, not to write."""

Report = Callable[[int, int], None]
"""Called with pages done and all pages."""


def back_up(folder: Path, target: Path, report: Report) -> int:
    """Copy the store of a folder into a file; its size in bytes. An older backup of that name is replaced at the end.

    Raises:
        NotFoundError: kind `no_store`: the folder has none.
        BadInputError: kind `bad_backup`: it cannot be written there, or something that is no backup is there already;
            `bad_store`: this user may not read the store.
        DamagedDataError: kind `damaged_store`: the store cannot be read.
    """
    source = _store_in(folder)
    try:
        is_free = not target.exists()
    except OSError as exc:
        raise BadInputError("bad_backup", f"{target} cannot be written: {exc.strerror}") from exc
    if not is_free and (target.samefile(source) or not is_backup(target)):
        raise BadInputError("bad_backup", f"{target} is there and is no backup of this cairn's; choose another name")
    with partial_file(target) as partial:
        _copy(source, partial, report, shown=target)
    size_bytes = target.stat().st_size
    note_backup(folder, str(target.absolute()), size_bytes)
    give_store_to_owner(folder)
    return size_bytes


def send_backup(folder: Path, stream: BinaryIO, report: Report) -> int:
    """Write a copy of the store of a folder to a stream; its size in bytes.

    SQLite copies pages in an order of its own, into a file: the folder has room for the copy until all of it is sent.

    Raises:
        NotFoundError, DamagedDataError: as `back_up`.
        BadInputError: kind `bad_backup`: there is no room for the copy, or the reader of the stream went away.
    """
    source = _store_in(folder)
    try:
        with tempfile.TemporaryDirectory(prefix="backup-", dir=folder) as name:
            path = Path(name) / "copy"
            _copy(source, path, report, shown=path)
            copy = path.open("rb")
        with copy:
            shutil.copyfileobj(copy, stream)
            stream.flush()
            size_bytes = copy.tell()
    except OSError as exc:
        raise BadInputError("bad_backup", f"the backup is not whole, it cannot be written: {exc}") from exc
    note_backup(folder, "standard output", size_bytes)
    give_store_to_owner(folder)
    return size_bytes


def _store_in(folder: Path) -> Path:
    source = folder / FILE_NAME
    if not source.is_file():
        raise NotFoundError("no_store", f"{folder} has no store; name the folder that `cairn serve --data` works on")
    return source


@dataclass(frozen=True, slots=True)
class Restored:
    """Outcome of a restore: tokens that count, and losses against the store that it replaces."""

    tokens: int
    """Tokens that count at once."""
    unconfirmed: int
    """Tokens that are off until an admin confirms them: no list says which of them ended since the backup."""
    ended: int
    """Tokens of the backup that ended since, and stay so."""
    lost: Mapping[str, int] | None
    """Count of what the store that it replaces has and the backup has not, by name; None: it cannot be read."""
    newest_s: float
    """Time of the newest commit and audit line in the backup, UTC seconds since 1970; 0: there is none."""


def restore(
    source: Path, folder: Path, report: Report, verify: Callable[[Path], None], *, old: Path | None = None
) -> Restored:
    """Make a folder's store out of a backup; `verify` raises if the copy is not sound, and then nothing is left of it.

    The list of ended tokens is that of the folder `old`, which the new one takes the place of, or one that lies in the
    new folder.

    Raises:
        NotFoundError: kind `no_store`: the file is not there.
        ConflictError: kind `store_in_use` or `not_empty`: a server works on the folder, or something is in it.
        BadInputError: kind `bad_backup` or `store_version`: the file is no store that this version knows; `bad_store`:
            nothing can be written to the folder.
        DamagedDataError: the file is cut off; or what `verify` finds.
    """
    check_backup(source)
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
        lock = lock_folder(folder)
    except OSError as exc:
        raise BadInputError("bad_store", f"cannot keep a store in {folder}: {exc.strerror}") from exc
    with lock:
        found = sorted(path.name for path in folder.iterdir() if path.name not in (LOCK_NAME, LIST_NAME))
        if found:
            raise ConflictError("not_empty", f"{folder} is not empty, it has {found[0]}; restore into a new folder")
        with partial_file(folder / FILE_NAME) as partial:
            copy_checked(source, partial, report, verify, shown=folder / FILE_NAME)
            ended = ended_since((old or folder) / LIST_NAME, partial)
            restored = _without_ended(partial, ended, old)
            settle_file(partial)
            if old is not None and ended is not None:
                copy_list(old / LIST_NAME, folder / LIST_NAME)
        give_store_to_owner(folder)
    return restored


def give_store_to_owner(folder: Path) -> None:
    """Give what root has written of a store to the owner of its folder, as whom the server runs."""
    names = (*(FILE_NAME + side for side in SIDES), LOCK_NAME, LIST_NAME, NOTE_NAME)
    give_to_owner(folder / name for name in names)


def check_backup(path: Path) -> None:
    """Refuse a file that is no whole backup which this version can read; raises as `restore`."""
    try:
        size_bytes = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(HEAD.size)
    except FileNotFoundError as exc:
        raise NotFoundError("no_store", f"there is no file {path}") from exc
    except OSError as exc:
        raise BadInputError("bad_backup", f"{path} cannot be read: {exc.strerror}") from exc
    if not head:
        raise DamagedDataError("damaged_store", f"{path} is cut off: nothing of it is there; take another backup")
    if len(head) == HEAD.size and head.startswith(MAGIC):
        page_bytes, pages = HEAD.unpack(head)
        whole_bytes = pages * (page_bytes if page_bytes > 1 else 1 << 16)
        if size_bytes < whole_bytes:
            there = f"{size_bytes / 1e6:.1f} of {whole_bytes / 1e6:.1f} MB ({100 * size_bytes // whole_bytes} %)"
            raise DamagedDataError("damaged_store", f"{path} is cut off: {there} are there; take another backup")
    version = _version_of(path)
    if not version:
        raise BadInputError("bad_backup", f"{path} is no backup of a cairn server")
    if version > len(STEPS):
        raise newer_store(f"the backup {path}", version)


def copy_checked(source: Path, target: Path, report: Report, verify: Callable[[Path], None], *, shown: Path) -> None:
    """Copy a store's file that somebody may have handed over, brought up to date; `verify` raises if it is not sound.

    Raises:
        DamagedDataError: kind `damaged_store`: it cannot be read; and what `verify` finds.
    """
    _copy(source, target, report, shown=shown)
    _check_form(target)
    _migrate(target)
    verify(target)


def is_backup(path: Path) -> bool:
    """True if a file is a store that this version can read."""
    return _version_of(path) in range(1, len(STEPS) + 1)


def _version_of(path: Path) -> int:
    """Version of the store that a file is; 0 if it is none."""
    try:
        connection = _opened(path)
        try:
            tables = "SELECT count(*) FROM sqlite_master WHERE name IN ('map', 'commits', 'log')"
            return int(connection.pragma("user_version")) if connection.execute(tables).get == 3 else 0
        finally:
            connection.close()
    except apsw.Error:
        return 0


def _opened(path: Path) -> apsw.Connection:
    """Connection that only reads; on a store at work it must be able to write next to the file, not in it."""
    connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READWRITE)
    connection.set_busy_timeout(BUSY_MS)
    connection.execute("PRAGMA query_only = ON")
    return connection


def _copy(source: Path, target: Path, report: Report, *, shown: Path | None = None) -> None:
    """Copy one state of a store; `shown` is the target's name in messages.

    Raises:
        BadInputError: kind `bad_store`: the store cannot be opened; kind `bad_backup`: the target cannot be written.
        DamagedDataError: kind `damaged_store`: the store cannot be read.
    """
    try:
        from_store = _opened(source)
    except apsw.Error as exc:
        raise opening_failure(exc, source) from exc
    to_file = apsw.Connection(str(target))
    try:
        from_store.execute("BEGIN")
        from_store.execute("SELECT count(*) FROM sqlite_master").fetchall()
        with to_file.backup("main", from_store, "main") as backup:
            while not backup.done:
                backup.step(STEP_PAGES)
                report(backup.page_count - backup.remaining, backup.page_count)
    except apsw.Error as exc:
        if isinstance(exc, apsw.CorruptError | apsw.NotADBError) or getattr(exc, "extendedresult", 0) in UNREADABLE:
            raise DamagedDataError("damaged_store", f"{source} cannot be copied: {exc}") from exc
        raise _cannot_write(exc, target, shown or target) from exc
    finally:
        from_store.close()
        to_file.close()
    settle_file(target)


def _without_ended(path: Path, ended: Collection[bytes] | None, old: Path | None) -> Restored:
    """End again what ended since the backup, or without a list of it switch all tokens off."""
    connection = apsw.Connection(str(path))
    try:
        before = connection.execute("SELECT count(*) FROM token").get
        with connection:
            connection.execute("UPDATE robot_key SET may_return = 0")  # an operator's word may have been used since
            if ended is None:
                connection.execute("UPDATE token SET confirmed = 0")
            connection.executemany("DELETE FROM token WHERE hash = ?", [(each,) for each in ended or ()])
        counts, off = connection.execute("SELECT coalesce(sum(confirmed), 0), count(*) FROM token").get
        newest_s = connection.execute(
            "SELECT max(coalesce((SELECT max(received_s) FROM commits), 0),"
            " coalesce((SELECT max(time_s) FROM audit), 0))"
        ).get
        lost = _lost(connection, old / FILE_NAME) if old is not None else None
        return Restored(counts, off - counts, before - off, lost, newest_s)
    finally:
        connection.close()


LOST = {
    # No name has a slash but one of a deleted map, some of whose rows are left.
    "commits": "SELECT count(*) FROM old.commits AS theirs JOIN old.map AS m ON m.number = theirs.map"
    " WHERE m.name NOT LIKE '/%' AND NOT EXISTS"
    " (SELECT 1 FROM main.map JOIN main.commits AS ours ON ours.map = main.map.number WHERE main.map.name = m.name"
    " AND ours.robot = theirs.robot AND ours.incarnation = theirs.incarnation AND ours.n = theirs.n)",
    "audit lines": "SELECT count(*) FROM old.audit WHERE number > coalesce((SELECT max(number) FROM main.audit), 0)",
    "tokens": "SELECT count(*) FROM old.token WHERE hash NOT IN (SELECT hash FROM main.token)",
}
"""Queries of what an old store has and a backup has not."""


def _lost(connection: apsw.Connection, old: Path) -> dict[str, int] | None:
    """Count of what the store that a backup replaces has and the backup has not; None if it cannot be read."""
    if not old.is_file():
        return None
    try:
        connection.execute("ATTACH ? AS old", (str(old),))
        return {what: connection.execute(query).get for what, query in LOST.items()}
    except apsw.Error:
        return None


def settle_file(path: Path) -> None:
    """Make a copy one file, without a separate log."""
    connection = apsw.Connection(str(path))
    try:
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    finally:
        connection.close()


def _check_form(path: Path) -> None:
    connection = _opened(path)
    try:
        check_form(connection)
    finally:
        connection.close()


def _migrate(path: Path) -> None:
    connection = apsw.Connection(str(path))
    try:
        ensure_schema(connection)
    finally:
        connection.close()


@contextmanager
def scratch_file(near: Path) -> Iterator[Path]:
    """A file next to another one, gone at the end unless it was renamed."""
    scratch = near.with_name(f"{near.name}.{os.getpid()}.partial")
    try:
        scratch.touch(0o600)
        yield scratch
    except (OSError, apsw.Error) as exc:
        raise _cannot_write(exc, scratch, near) from exc
    finally:
        for side in SIDES:
            with suppress(OSError):
                scratch.with_name(scratch.name + side).unlink(missing_ok=True)


@contextmanager
def partial_file(target: Path) -> Iterator[Path]:
    """A file that takes the name of the target at the end, wholly on the disk; gone if anything fails."""
    with scratch_file(target) as partial:
        yield partial
        _sync(partial)
        partial.replace(target)
        _sync(target.parent)


def _cannot_write(exc: apsw.Error | OSError, path: Path, shown: Path) -> BadInputError:
    why = "its disk is full" if is_full(exc, path) else exc.strerror if isinstance(exc, OSError) else str(exc)
    return BadInputError("bad_backup", f"{shown} cannot be written: {why}")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
