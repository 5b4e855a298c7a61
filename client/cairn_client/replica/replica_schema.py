"""Schema of a robot's file, by version, and the check that a file has it before anything is read through it.

A folder that somebody hands over may hold any database: a view in the place of a table, whose query never ends; a
trigger that empties the outbox; a text in a column of numbers, since SQLite keeps what it is given.
"""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import apsw

from cairn_map.errors import BadInputError, DamagedDataError

VERSION = 6
VALUE_BYTES_MAX = 256 << 20
"""Largest value that is read; a commit has at most 64 MB."""
DDL = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE commits (
    number INTEGER PRIMARY KEY,
    robot TEXT NOT NULL, incarnation TEXT NOT NULL, n INTEGER NOT NULL,
    sha BLOB NOT NULL,
    acked INTEGER NOT NULL DEFAULT 0,   -- the server said once that it has exactly these bytes
    acked_age_s REAL NOT NULL DEFAULT 0,    -- age of the store when it said so last
    cells TEXT NOT NULL,                -- numbers of the cells it touches, as JSON
    data BLOB,                          -- NULL once the commit may be forgotten
    seal TEXT,                          -- of a server's own retract, kept for it
    epoch INTEGER,                      -- of its evidence; NULL: it has none
    UNIQUE (robot, incarnation, n)
);
CREATE TABLE coverage (name INTEGER PRIMARY KEY, vector TEXT NOT NULL UNIQUE);
CREATE TABLE cell (
    cell INTEGER PRIMARY KEY,
    cursor TEXT,                        -- NULL: not proven any more, to be fetched whole; or `together`
    coverage INTEGER NOT NULL REFERENCES coverage,
    fingerprint BLOB NOT NULL,
    etag TEXT,
    body BLOB NOT NULL
);
CREATE INDEX cell_coverage ON cell (coverage);
"""
DELTAS = """
CREATE TABLE delta (                    -- evidence that was added to a cell since its body was written
    number INTEGER PRIMARY KEY,
    cell INTEGER NOT NULL REFERENCES cell,
    body BLOB NOT NULL
);
CREATE INDEX delta_cell ON delta (cell);
"""
DDL += DELTAS
STEPS = {
    1: "ALTER TABLE commits ADD COLUMN seal TEXT",
    # When older commits were acknowledged is unknown: they count from the first start with ages.
    2: "ALTER TABLE commits ADD COLUMN acked_age_s REAL NOT NULL DEFAULT 0",
    # Older commits are of maps without epochs.
    3: "ALTER TABLE commits ADD COLUMN epoch INTEGER",
    # The same form: from here on cells may stand together, at the map's own cursor, which an older cairn cannot read.
    4: "SELECT 1",
    5: DELTAS,
}
"""By version: what leads a store to the next one."""
COLUMNS_SINCE = {
    ("commits", "seal"): 2,
    ("commits", "acked_age_s"): 3,
    ("commits", "epoch"): 4,
    ("delta", "number"): 6,
    ("delta", "cell"): 6,
    ("delta", "body"): 6,
    ("delta", "delta_cell"): 6,
}
"""Columns and indices that the steps added, by table and name: the first version that has each."""
KINDS = {"INTEGER": "'integer'", "REAL": "'real', 'integer'", "TEXT": "'text'", "BLOB": "'blob'"}
"""SQL of the storage classes that a column of a declared type may hold."""
NULL = {True: "", False: ", 'null'"}
"""SQL that permits NULL, by whether a column needs a value."""


def check_form(connection: apsw.Connection, file: Path) -> int:
    """Version of a robot's file; 0 for one that is empty. SQLite's errors are the caller's.

    Raises:
        DamagedDataError: kind `damaged_store`: its tables, or kinds of values, are not those of its version.
        BadInputError: kind `store_version`: a version that this cairn does not have.
    """
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, VALUE_BYTES_MAX)
    version = int(connection.pragma("user_version"))
    if not 0 <= version <= VERSION:
        raise BadInputError("store_version", f"{file} has version {version}, this cairn needs {VERSION}")
    with closing(apsw.Connection(":memory:")) as model:
        if version:
            model.execute(DDL)
        expected = {each for each in _schema(model) if COLUMNS_SINCE.get(each[:2], 0) <= version}
    if other := expected ^ _schema(connection):
        names = ", ".join(sorted({f"{table}.{name}" for table, name, *_ in other})[:5])
        raise DamagedDataError(
            "damaged_store", f"{file} is no robot's file as cairn makes it: {names[:200]}; move it away to start again"
        )
    for table in sorted({table for table, _, kind, *_ in expected if kind in KINDS}):
        _check_values(connection, table, file)
    return version


@contextmanager
def translate_damage(file: Path) -> Iterator[None]:
    """Translate errors in the values of a robot's file into one that names it."""
    try:
        yield
    except (BadInputError, ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError) as exc:
        said = (str(exc).splitlines() or [""])[0][:200] or type(exc).__name__
        raise DamagedDataError(
            "damaged_store", f"{file} is damaged: a value in it cannot be read ({said}); move it away to start again"
        ) from exc


def _schema(connection: apsw.Connection) -> set[tuple[Any, ...]]:
    """Each column of a table, and each other thing in a file, with the table that it belongs to first."""
    found: set[tuple[Any, ...]] = set()
    query = "SELECT type, name, tbl_name FROM sqlite_master WHERE name NOT LIKE 'sqlite_%'"
    for kind, name, table in connection.execute(query).fetchall():
        if kind == "table":
            # xinfo: with the columns that are computed, which no table of a robot has.
            columns = 'SELECT name, type, "notnull", dflt_value, pk, hidden FROM pragma_table_xinfo(?)'
            found |= {(name, *column) for column in connection.execute(columns, (name,))}
        else:
            found.add((table, name, kind))
    return found


def _check_values(connection: apsw.Connection, table: str, file: Path) -> None:
    """Refuse a value of a kind that its column does not have; all columns in one pass."""
    columns = connection.execute('SELECT name, type, "notnull" FROM pragma_table_info(?)', (table,)).fetchall()
    wrong = " OR ".join(
        f"typeof({name}) NOT IN ({KINDS[str(kind)]}" + (")" if needed else ", 'null')")
        for name, kind, needed in columns
    )
    # Names of tables and columns are the schema's own by now.
    if connection.execute(f"SELECT 1 FROM {table} WHERE {wrong} LIMIT 1").get:  # noqa: S608
        raise DamagedDataError(
            "damaged_store",
            f"{file} is damaged: a row of {table} has a value of another kind than its column; move it away to start "
            "again",
        )
