"""A store's file that is only read: a server's at work, a backup, or one that somebody handed over.

A file that somebody hands over may be any database: a view in the place of a table, whose query never ends; a trigger
that empties the tokens; a text in a column of numbers, since SQLite keeps what it is given. So its form comes first:
tables, indexes and kinds of values are compared with those that the schema's steps make, and the schema alone is read
before a row is. All later checks read through the tables.
"""

from pathlib import Path
from typing import Any

import apsw

from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError
from cairn_server.store.attachments.attachment_rows import AttachmentRows
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.sqlite.schema import STEPS, newer_store
from cairn_server.store.sqlite.store import SqliteAttachmentTables, SqliteStore
from cairn_server.store.sqlite.writer import connect_to_store, first, rows

COMPLAINTS_MAX = 20
KINDS = {"INTEGER": "'integer'", "REAL": "'real', 'integer'", "TEXT": "'text'", "BLOB": "'blob'"}
"""SQL of the storage classes that a column of a declared type may hold."""


class SqliteArchive(SqliteStore):
    """The reading half of a store; what would write is not there."""

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            NotFoundError: kind `no_store`.
            BadInputError: kind `bad_store`: it is none; `store_version`: another version of cairn opened it last.
            UnreachableError: kind `disk_full`: there is no room to open it.
        """
        if not path.is_file():
            raise NotFoundError("no_store", f"there is no store {path}")
        connect_to_store(path).close()
        SqliteReads.__init__(self, Readers(path))
        self.attachments = AttachmentRows(SqliteAttachmentTables(self._readers))
        with self._readers.reading() as reader:
            version = reader.pragma("user_version")
        if version > len(STEPS):
            self._readers.close()
            raise newer_store(f"the store {path}", version)
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


def check_form(connection: apsw.Connection) -> None:
    """Refuse a file whose tables, or kinds of values, are not those of a store of its version.

    Raises:
        DamagedDataError: kind `damaged_store`.
    """
    model = apsw.Connection(":memory:")
    try:
        for step in STEPS[: connection.pragma("user_version")]:
            model.execute(step)
        expected, found = _schema(model), _schema(connection)
        other = sorted(f"{kind} {name}" for kind, name in dict(expected ^ found))
    except apsw.Error as exc:
        raise DamagedDataError("damaged_store", f"the schema of the store cannot be read: {exc}") from exc
    finally:
        model.close()
    if other:
        raise DamagedDataError("damaged_store", f"the file is no store as cairn makes it: {', '.join(other[:5])}")
    try:
        for table in sorted(name for (kind, name), _ in expected if kind == "table"):
            _check_values(connection, table)
    except apsw.Error as exc:
        raise DamagedDataError("damaged_store", f"the store cannot be read: {exc}") from exc


def _schema(connection: apsw.Connection) -> set[tuple[tuple[str, str], tuple[Any, ...]]]:
    """Each thing in a file by kind and name, with its table, and the columns if it is a table."""
    found = rows(connection, "SELECT type, name, tbl_name FROM sqlite_master WHERE name NOT LIKE 'sqlite_%'")
    return {((kind, name), (table, *_columns(connection, kind, name))) for kind, name, table in found}


def _columns(connection: apsw.Connection, kind: str, name: str) -> list[tuple[Any, ...]]:
    # xinfo: with the columns that are computed, which no table of a store has.
    query = 'SELECT name, type, "notnull", dflt_value, pk, hidden FROM pragma_table_xinfo(?) ORDER BY cid'
    return rows(connection, query, (name,)) if kind == "table" else []


def _check_values(connection: apsw.Connection, table: str) -> None:
    """Refuse a value of a kind that its column does not have; all columns in one pass."""
    wrong = [
        f"(typeof({name}) NOT IN ({KINDS[kind]}) AND {name} IS NOT NULL) OR ({needed} AND {name} IS NULL)"
        for name, kind, needed, *_ in _columns(connection, "table", table)
        if kind in KINDS
    ]
    # Names of tables and columns are the schema's own by now.
    if wrong and first(connection, f"SELECT 1 FROM {table} WHERE {' OR '.join(wrong)} LIMIT 1"):  # noqa: S608
        raise DamagedDataError(
            "damaged_store", f"a row of the table {table} has a value of another kind than its column"
        )
