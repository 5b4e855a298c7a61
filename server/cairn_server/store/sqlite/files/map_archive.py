"""One map of a store as a file, and such a file as a map of a store.

The file is a store of its own with one map and no tokens, so that all that looks after stores looks after it, too. All
rows of the map go along, as they are: cells, log with its id and chain, commits with signatures and seals, what is kept
of their evidence, accounts, keys, branches. So robots whose cursors are of the map go on with what comes out of it.

    number of the map, numbers of commits    others in each store: they are handles, and nothing hashes them
    ages of the store                        moved: what was a day old when it was archived is so when it is back
    tokens                                   not in the file; each robot comes back by its key (`robot_key.may_return`)
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw

from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_server.store.sqlite.failures import opening_failure
from cairn_server.store.sqlite.retention import next_map_number
from cairn_server.store.sqlite.schema import STEPS, ensure_schema, newer_store
from cairn_server.store.sqlite.writer import connect, connect_to_store, first, rows
from cairn_server.store.stored_columns import TableRows

MOVED = {"map": ":map", "commit_number": "commit_number + :shift", "idle_age_s": "NULL"}
"""SQL of what columns hold in the other store, where that is something else."""
AGES = {"received_age_s": "received_age_s + :later_s", "folded_age_s": "folded_age_s + :later_s"}
TABLES = (
    "commits",
    "diff",
    "log",
    "touched",
    "retracted",
    "cell",
    "tile",
    "mark",
    "attachment",
    "attachment_part",
    "held",
    "author",
    "vector_mark",
    "robot_key",
    "branch",
    "branch_status",
    "assignment",
)
"""Tables of a map's rows, each after those that it refers to."""
OF_MAP = {"diff": "commit_number IN (SELECT number FROM other.commits WHERE map = :of)"}
"""SQL of the rows of a map, where they do not say it themselves."""

TOUCHED = (
    "SELECT touched.cell, touched.seq, log.kind, robot, incarnation, n, coalesce(length(diff.body), 0), epoch"
    " FROM touched JOIN log ON log.map = touched.map AND log.seq = touched.seq"
    " JOIN commits ON commits.number = log.commit_number"
    " LEFT JOIN diff ON diff.commit_number = commits.number AND diff.cell = touched.cell"
)
"""SQL of what each entry touched, with what a reader asks of it."""


def archive_map(source: Path, name: str, target: Path) -> None:
    """Copy the map of a name out of a store, which a server may work on, into an empty store.

    Raises:
        NotFoundError: kind `no_map`.
        BadInputError: kind `disk_full`.
    """
    with _both(target, source) as connection, connection:
        number = _number_of(connection, name)
        age_s, wall_s = first(connection, "SELECT age_s, wall_s FROM other.age")
        connection.execute("UPDATE age SET age_s = ?, wall_s = ?", (age_s, wall_s))
        _copy_map(connection, number, later_s=0.0)


def restore_map(archive: Path, target: Path) -> tuple[str, int]:
    """Copy the map of an archive, which was checked, into a store that no server works on.

    Its name, and the count of the robots that may come back by their keys.

    Raises:
        BadInputError: kind `bad_backup`: there is not one map in it; or `disk_full`.
        ConflictError: kind `map_exists`: the store has a map of that name.
    """
    name, robots_back = "", 0
    with _both(target, archive) as connection, connection:
        number, name = _only_map(connection, "other.map")
        if first(connection, "SELECT 1 FROM map WHERE name = ?", (name,)):
            raise ConflictError("map_exists", f"the store has a map {name}: delete it, or take another folder")
        now_s, then_s = first(connection, "SELECT main.age.age_s, other.age.age_s FROM main.age, other.age")
        made = _copy_map(connection, number, later_s=now_s - then_s)
        connection.execute("UPDATE robot_key SET may_return = is_proven WHERE map = ?", (made,))
        robots = "SELECT count(DISTINCT robot) FROM robot_key WHERE map = ? AND may_return"
        robots_back = first(connection, robots, (made,))
    return name, robots_back


def write_archive(target: Path, age_s: tuple[float, float], tables: Iterable[TableRows]) -> None:
    """Write the rows of a map into an empty store, with the age of their store and its time of day.

    Raises:
        BadInputError: kind `disk_full`.
    """
    connection = connect(target)
    try:
        ensure_schema(connection)
        with connection:
            connection.execute("UPDATE age SET age_s = ?, wall_s = ?", age_s)
            for table in tables:
                own = {"map": "number", "diff": None}.get(table.name, "map")
                columns = (*table.columns, *([own] if own else ()))
                values = ", ".join(["?"] * len(table.columns) + ["1"] * (own is not None))
                # Names are our own.
                query = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({values})"  # noqa: S608
                connection.executemany(query, table.rows)
    except apsw.FullError as exc:
        raise BadInputError("disk_full", f"there is no room for the map in {target.parent}: {exc}") from exc
    finally:
        connection.close()


def archived_rows(archive: apsw.Connection) -> tuple[float, list[TableRows]]:
    """Age of the store of an archive, which was checked, and the rows of its map.

    Raises:
        BadInputError: kind `bad_backup`: there is not one map in it.
    """
    _only_map(archive, "map")
    made = []
    for table in ("map", *TABLES):
        columns: list[str] = [name for (name,) in rows(archive, "SELECT name FROM pragma_table_info(?)", (table,))]
        own = [name for name in columns if name not in ("map", "folded_s") and (name != "number" or table == "commits")]
        query = f"SELECT {', '.join(own)} FROM {table}"  # noqa: S608 - names are our own
        if table == "diff":  # of evidence that is gone, former versions left the row
            query += " WHERE body IS NOT NULL"
        if table == "touched":
            own, query = [*own, "kind", "robot", "incarnation", "n", "size_bytes", "epoch"], TOUCHED
        made.append(TableRows(table, tuple(own), archive.execute(query)))
    return first(archive, "SELECT age_s FROM age"), made


@contextmanager
def opened_archive(path: Path) -> Iterator[apsw.Connection]:
    """Connection that reads an archive, for the length of a `with`."""
    connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
    try:
        yield connection
    finally:
        connection.close()


def _only_map(connection: apsw.Connection, table: str) -> tuple[int, str]:
    """Number and name of the one map of an archive."""
    found = rows(connection, f"SELECT number, name FROM {table}")  # noqa: S608 - one of two names of ours
    if len(found) != 1:
        raise BadInputError("bad_backup", f"the file has {len(found)} maps, and an archive has one")
    number, name = found[0]
    return number, name


def _copy_map(connection: apsw.Connection, number: int, *, later_s: float) -> int:
    """Copy a map's rows from `other`; its number here."""
    made = next_map_number(connection)
    newest = first(connection, "SELECT coalesce((SELECT seq FROM sqlite_sequence WHERE name = 'commits'), 0)")
    oldest = first(connection, "SELECT coalesce(min(number), 1) FROM other.commits WHERE map = ?", (number,))
    values = {"map": made, "of": number, "shift": newest + 1 - oldest, "later_s": later_s}
    _copy_rows(connection, "map", "number = :of", {"number": ":map"}, values)
    for table in TABLES:
        moved = MOVED | ({"number": "number + :shift", **AGES} if table == "commits" else {})
        _copy_rows(connection, table, OF_MAP.get(table, "map = :of"), moved, values)
    return made


def _copy_rows(
    connection: apsw.Connection, table: str, where: str, moved: dict[str, str], values: dict[str, float]
) -> None:
    columns: list[str] = [name for (name,) in rows(connection, "SELECT name FROM pragma_table_info(?)", (table,))]
    # The numbers of cells and of pieces of evidence are handles of their rows alone: they are given again.
    if table in ("cell", "diff"):
        columns.remove("number")
    taken = ", ".join(moved.get(name, name) for name in columns)
    # Names and clauses are our own.
    query = f"INSERT INTO main.{table} ({', '.join(columns)}) SELECT {taken} FROM other.{table} WHERE {where}"  # noqa: S608
    used = {name: value for name, value in values.items() if f":{name}" in f"{taken} {where}"}
    connection.execute(query, used).fetchall()


def _number_of(connection: apsw.Connection, name: str) -> int:
    living = "number NOT IN (SELECT number FROM other.gone_map)"
    number = first(connection, f"SELECT number FROM other.map WHERE name = ? AND {living}", (name,))  # noqa: S608
    if number is None:
        raise NotFoundError("no_map", f"the store has no map {name!r}; `cairn map ls` lists them")
    return int(number)


@contextmanager
def _both(path: Path, other: Path) -> Iterator[apsw.Connection]:
    """Connection to a store, with another one as `other`, for one transaction.

    Raises:
        BadInputError: kind `disk_full`; or `store_version`: the other one was last opened by another version of cairn.
    """
    connection = connect_to_store(path)
    try:
        ensure_schema(connection)
        try:
            connection.execute("ATTACH ? AS other", (str(other),))
            version = connection.pragma("user_version", schema="other")
        except apsw.Error as exc:
            raise opening_failure(exc, other) from exc
        if version > len(STEPS):
            raise newer_store(f"the store {other}", version)
        if version != len(STEPS):
            raise BadInputError(
                "store_version", f"the store has version {version}, this cairn {len(STEPS)}: start the server once"
            )
        yield connection
    except apsw.FullError as exc:
        raise BadInputError("disk_full", f"there is no room for the map in {path.parent}: {exc}") from exc
    finally:
        connection.close()
