"""Form of a store's file: tables, indexes and kinds of values, compared with those that the schema's steps make.

A file that somebody hands over may be any database: a view in the place of a table, whose query never ends; a trigger
that empties the tokens; a text in a column of numbers, since SQLite keeps what it is given. All later checks read
through the tables, so this one comes first, and reads the schema alone before it reads a row.
"""

from typing import Any

import apsw

from cairn_map.errors import DamagedDataError
from cairn_server.store.sqlite.schema import STEPS
from cairn_server.store.sqlite.writer import first, rows

KINDS = {"INTEGER": "'integer'", "REAL": "'real', 'integer'", "TEXT": "'text'", "BLOB": "'blob'"}
"""SQL of the storage classes that a column of a declared type may hold."""


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
