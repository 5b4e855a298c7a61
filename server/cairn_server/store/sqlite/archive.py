"""A store's file for reading alone, whether a server works on it or not."""

from pathlib import Path

import apsw

from cairn_map.errors import BadInputError, NotFoundError
from cairn_server.store.sqlite.file_form import check_form
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.schema import STEPS
from cairn_server.store.sqlite.store import SqliteStore

COMPLAINTS_MAX = 20


class SqliteArchive(SqliteStore):
    """The reading half of a store; what would write is not there."""

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            NotFoundError: kind `no_store`.
            BadInputError: kind `store_version`: it was last opened by another version of cairn.
        """
        if not path.is_file():
            raise NotFoundError("no_store", f"there is no store {path}")
        self._readers = Readers(path)
        with self._readers.reading() as reader:
            version = reader.pragma("user_version")
        if version != len(STEPS):
            self._readers.close()
            raise BadInputError(
                "store_version", f"the store has version {version}, this cairn {len(STEPS)}: start the server once"
            )

    def complaints(self) -> list[str]:
        """Damage that SQLite itself finds in the file: in its pages and indexes, not in their contents.

        Raises:
            DamagedDataError: kind `damaged_store`: its tables are not those of a store, so nothing else can be read.
        """
        with self._readers.reading() as reader:
            check_form(reader)
            try:
                found = [str(text) for (text,) in reader.execute(f"PRAGMA integrity_check({COMPLAINTS_MAX})")]
            except apsw.CorruptError as exc:
                return [str(exc)]
        return [] if found == ["ok"] else found

    def close(self) -> None:
        """Close what is open."""
        self._readers.close()
