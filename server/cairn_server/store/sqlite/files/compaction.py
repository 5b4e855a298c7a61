"""Compaction of a stopped server's store: the file written again without what nothing uses.

What deleted maps left is removed first. The new file takes the old one's name only when all of it is on the disk, so a
power cut leaves one of the two, whole. From then on the running server gives unused pages back itself.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import apsw

from cairn_map.errors import BadInputError, NotFoundError
from cairn_server.store.folder_lock import lock_folder
from cairn_server.store.sqlite.backup import give_store_to_owner, partial_file
from cairn_server.store.sqlite.retention import clear_part
from cairn_server.store.sqlite.schema import ensure_schema
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.sqlite.writer import connect_to_store

PART_BYTES = 64 << 20
"""Bytes of deleted maps that are removed in one transaction; no push waits for it."""


class Compacted(NamedTuple):
    """Sizes of a store's file."""

    before_bytes: int
    after_bytes: int


def compact(folder: Path) -> Compacted:
    """Write the store of a folder again, as small as it can be.

    Raises:
        NotFoundError: kind `no_store`.
        ConflictError: kind `store_in_use`: a server works on it.
        BadInputError: kind `disk_full`: the disk has no room for the new file next to the old one; or `store_version`.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        raise NotFoundError("no_store", f"{folder} has no store; name the folder that `cairn serve --data` works on")
    with lock_folder(folder):
        connection = connect_to_store(path)
        try:
            with _room_for_it(path):
                ensure_schema(connection)
                _clear(connection)
                connection.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_TRUNCATE)
            before_bytes = path.stat().st_size
            connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # of the new file, whatever the old one is
            with partial_file(path) as partial, _room_for_it(path):
                connection.execute("VACUUM INTO ?", (str(partial),))
                # The last connection takes the old file's log along, before the new file has its name.
                connection.close()
        finally:
            connection.close()
            give_store_to_owner(folder)
    return Compacted(before_bytes, path.stat().st_size)


@contextmanager
def _room_for_it(path: Path) -> Iterator[None]:
    """Work on a store for which its disk may have no room."""
    try:
        yield
    except apsw.FullError as exc:
        size_mb = path.stat().st_size / 1e6
        raise BadInputError(
            "disk_full",
            f"there is no room in {path.parent} for the smaller file, which is written next to the old one of "
            f"{size_mb:.0f} MB; nothing was changed",
        ) from exc


def _clear(connection: apsw.Connection) -> None:
    """Remove all that deleted maps left."""
    while True:
        with connection:
            if not clear_part(connection, size_bytes_max=PART_BYTES):
                return
