"""One map of a database as the rows of an archive, which is a store of SQLite with one map, and such rows as a map.

    archive                             database
    map                                 map, head
    charged and tops, packed integers   arrays
    touched                             with what a reader asks of each entry
    numbers of commits                  others: they are handles, and nothing hashes them
    ages of the store                   moved, as between two stores of SQLite

All rows are of one state of the database, and go as they are: log with its id and chain, commits with signatures and
seals, what is kept of their evidence, accounts, keys, branches. Bytes in an object store come out of it; those of a map
that comes back are in the database until they are at rest again.
"""

import json
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice
from operator import sub
from struct import iter_unpack, pack
from typing import Any

from cairn_map.commits.ids import new_incarnation
from cairn_map.errors import ConflictError, NotFoundError
from cairn_map.evidence.grid import Geometry
from cairn_server.store.objects.cold_bytes import ColdReads, split_cell_object
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.pushes import NUMBER_BITS
from cairn_server.store.postgres.schema import (
    ATTACHMENTS_OLDEST,
    EPOCHS_OLDEST,
    LAYERS_OLDEST,
    MARKS_OLDEST,
    bar_older_programs,
)
from cairn_server.store.shares import limits_of
from cairn_server.store.stored_columns import TableRows

TABLES = {
    "commits": "number, robot, incarnation, n, sha, size_bytes, cells, meta, captured_first_s, captured_last_s,"
    " retracts, received_s, received_age_s, folded_age_s, folded_seq, unfolded_seq, due_from, damaged, gone, rig,"
    " signatures, via, bricks, epoch, regions, tops",
    "diff": "commit_number, cell, body, segment, start_bytes, size_bytes",
    "log": "seq, kind, commit_number, chain",
    "touched": "cell, seq",
    "retracted": "id",
    "cell": "cell, lm, digest, fingerprint, voxels, size_bytes, gone_seq, hottest_k, history_bytes, body, stamps,"
    " object",
    "tile": "tile, lm, cells, size_bytes, fingerprint, history_bytes",
    "mark": "commit_number, n, changed_seq, low_x, low_y, low_z, high_x, high_y, high_z, record, attached_sha,"
    " attached_bytes",
    "attachment": "sha, uploader, account, size_bytes, held_bytes",
    "attachment_part": "sha, uploader, begin_bytes, body",
    "held": "account, region, tops, part",
    "author": "robot, incarnation, top, intervals, closed, kept_bytes, marks",
    "vector_mark": "seq, vector",
    "robot_key": "robot, incarnation, is_proven, may_return, since_s, by",
    "branch": "name, mode, sensors, cursor, last_seen_s, incarnation",
    "branch_status": "name, status",
    "assignment": "robot, assignment",
}
"""Columns of the database by table, each after those that it refers to in an archive."""
MAP = (
    "SELECT map, name, geometry, sensor_model, seal_key, epoch_s, log_id, seq, chain, folded, cells, cells_bytes,"
    " fingerprint, history_bytes, corners FROM map JOIN head USING (map) WHERE name = %s"
)
DEFINES = (
    "SELECT EXISTS (SELECT FROM commits WHERE map = %s AND cells = 0 AND position('\"layer\":'::bytea IN meta) > 0)"
)
"""SQL that finds a commit which defines a layer; in texts of a meta a quote has a backslash before it."""
HAS_MARKS = "SELECT EXISTS (SELECT FROM mark WHERE map = %s)"
HAS_ATTACHED = "SELECT EXISTS (SELECT FROM mark WHERE map = %s AND attached_sha IS NOT NULL)"
HEAD = ("log_id", "seq", "chain", "folded", "cells", "cells_bytes", "fingerprint", "history_bytes")
BOOLEANS = frozenset({"closed", "gone", "is_proven", "may_return"})
ARRAYS = frozenset({"regions", "tops", "corners"})
AT_ONCE = 100
"""Rows that are written or fetched at once: cells and evidence may have megabytes each."""
Row = Sequence[Any]


def archive_rows(connection: Connection, name: str, objects: ColdReads) -> tuple[tuple[float, float], list[TableRows]]:
    """Age and time of day of the store, and the rows of a map as an archive has them, while a snapshot is open.

    Raises:
        NotFoundError: kind `no_map`.
        AwayError: the object store does not answer, when rows are read that have bytes there.
    """
    found = first(connection, MAP, (name,))
    if found is None:
        raise NotFoundError("no_map", f"the store has no map {name!r}; `cairn map ls` lists them")
    number, name, geometry, *rest, corners = found
    planes = 2 + Geometry.model_validate_json(geometry).plane_count
    map_columns = ("name", "geometry", "sensor_model", "seal_key", "epoch_s", *HEAD, "corners", "operator", "tops")
    ends = json.dumps([corners[:3], corners[3:]]) if corners else None
    values = (name, geometry, *rest, ends, new_incarnation(), json.dumps([0] * planes))
    made = [TableRows("map", map_columns, iter([values]))]
    for table, columns in TABLES.items():
        names = tuple(columns.split(", "))
        found_rows = _fetched(connection, f"SELECT {columns} FROM {table} WHERE map = %s", number)
        made.append(_archive_table(table, names, found_rows, objects))
    age_s, wall_s = first(connection, "SELECT age_s, wall_s FROM age")
    return (age_s, wall_s), made


def _fetched(connection: Connection, query: str, number: int) -> Iterator[Row]:
    """Rows of a query, some at a time."""
    with connection.cursor(name=f"rows_{secrets.token_hex(4)}") as cursor:
        cursor.itersize = AT_ONCE
        cursor.execute(query.encode(), (number,), binary=True)
        yield from cursor


def _archive_table(table: str, names: tuple[str, ...], found: Iterator[Row], objects: ColdReads) -> TableRows:
    match table:
        case "commits":
            return TableRows(table, (*names[:-2], "charged"), ((*row[:-2], _packed(row[-2], row[-1])) for row in found))
        case "diff":
            return TableRows(table, names[:3], ((*row[:2], _piece(row, objects)) for row in found))
        case "cell":
            return TableRows(table, names[:-1], ((*row[:-3], *_body(row, objects)) for row in found))
        case "held":
            return TableRows(
                table, names, ((a, region, pack(f"<{len(tops)}q", *tops), part) for a, region, tops, part in found)
            )
    return TableRows(table, names, found)


def _packed(regions: Sequence[int], tops: Sequence[int]) -> bytes:
    """Charge of a commit as an archive has it: for each region its number and its numbers, eight bytes each."""
    planes = len(tops) // len(regions) if regions else 0
    numbers = chain.from_iterable((r, *tops[n * planes : (n + 1) * planes]) for n, r in enumerate(regions))
    return b"".join(pack("<q", number) for number in numbers)


def _piece(row: Row, objects: ColdReads) -> bytes:
    _, _, body, segment, start, size_bytes = row
    if segment is None:
        return bytes(body)
    # Lost bytes are found as damage, when the archive is checked.
    return objects.part(segment, start=start, size_bytes=size_bytes) or b""


def _body(row: Row, objects: ColdReads) -> tuple[bytes, bytes]:
    body, stamps, name = row[-3:]
    return (body, stamps) if name is None else split_cell_object(objects.get(name))


def put_map(connections: Connections, read: Callable[[], tuple[float, list[TableRows]]]) -> tuple[str, int]:
    """Make a map out of the rows of an archive; its name, and the count of the robots that may come back by their keys.

    Args:
        connections: to the database; servers may work on it.
        read: age of the store of the archive, and its rows, each time afresh.

    Raises:
        ConflictError: kind `map_exists`: the store has a map of that name; `older_servers`.
    """

    def job(connection: Connection) -> tuple[str, int]:
        age_s, tables = read()
        put = _Putting(connection, later_s=first(connection, "SELECT age_s FROM age") - age_s)
        for table in tables:
            put.table(table)
        connection.execute("UPDATE robot_key SET may_return = is_proven WHERE map = %s", (put.number,))
        robots = "SELECT count(DISTINCT robot) FROM robot_key WHERE map = %s AND may_return"
        return put.name, first(connection, robots, (put.number,))

    return connections.run(job)


class _Putting:
    """One map on its way into a database."""

    def __init__(self, connection: Connection, *, later_s: float) -> None:
        self._connection = connection
        self._later_s = later_s
        self._commits: dict[int, int] = {}  # numbers here by those of the archive
        self._planes = 0
        self.number = 1 + secrets.randbits(NUMBER_BITS)
        self.name = ""

    def table(self, table: TableRows) -> None:
        """Write the rows of a table; those of the map come first, then those of commits."""
        found = (dict(zip(table.columns, row, strict=True)) for row in table.rows)
        if table.name == "map":
            self._map(next(found))
        elif table.name == "commits":
            self._write("commits", self._numbered(found), " OVERRIDING SYSTEM VALUE")
        else:
            self._write(table.name, map(self._here, found))
        if table.name == "mark" and first(self._connection, HAS_MARKS, (self.number,)):
            self._bar_older("marks", MARKS_OLDEST)
            if first(self._connection, HAS_ATTACHED, (self.number,)):
                self._bar_older("attachments of marks", ATTACHMENTS_OLDEST)
        has_layers = "." in self.name or (table.name == "commits" and first(self._connection, DEFINES, (self.number,)))
        if has_layers:
            self._bar_older("layers", LAYERS_OLDEST)

    def _map(self, values: Mapping[str, Any]) -> None:
        self.name = values["name"]
        self._planes = 2 + Geometry.model_validate_json(values["geometry"]).plane_count
        made = self._connection.execute(
            "INSERT INTO map (map, name, geometry, sensor_model, seal_key, epoch_s) OVERRIDING SYSTEM VALUE"
            " VALUES (%s, %s, %s, %s, %s, %s) ON CONFLICT (name) DO NOTHING",
            (self.number, *(values[name] for name in ("name", "geometry", "sensor_model", "seal_key", "epoch_s"))),
        )
        if not made.rowcount:
            raise ConflictError("map_exists", f"the store has a map {self.name}: delete it first")
        if values["epoch_s"] is not None:
            self._bar_older("maps with epochs", EPOCHS_OLDEST)
        corners = list(chain.from_iterable(json.loads(values["corners"]))) if values["corners"] else None
        self._write("head", iter([{name: values[name] for name in HEAD} | {"corners": corners}]))

    def _bar_older(self, what: str, oldest: int) -> None:
        bar_older_programs(self._connection, oldest, what=what, instead="put the map into another store")

    def _numbered(self, found: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """Commits with numbers of this database, in the same order."""
        new = "SELECT nextval(pg_get_serial_sequence('commits', 'number')) FROM generate_series(1, %s) ORDER BY 1"
        while some := list(islice(found, AT_ONCE)):
            numbers = [number for (number,) in rows(self._connection, new, (len(some),))]
            for commit, number in zip(some, numbers, strict=True):
                self._commits[commit["number"]] = number
                charged = list(iter_unpack(f"<{1 + self._planes}q", commit.pop("charged") or b""))
                commit |= {
                    "number": number,
                    "regions": [region for region, *_ in charged],
                    "tops": [top for _, *tops in charged for top in tops],
                    "received_age_s": commit["received_age_s"] + self._later_s,
                    "folded_age_s": commit["folded_age_s"] + self._later_s,
                }
                yield self._here(commit)

    def _here(self, values: dict[str, Any]) -> dict[str, Any]:
        """A row as the database has it."""
        values |= {name: bool(values[name]) for name in BOOLEANS.intersection(values)}
        if "commit_number" in values:
            values["commit_number"] = self._commits[values["commit_number"]]
        if {"account", "tops"} <= values.keys():
            (tops,) = iter_unpack(f"<{self._planes}q", values["tops"])
            room = min(map(sub, limits_of(values["account"], self._planes), tops))
            values |= {"tops": list(tops), "room": room}
        return values

    def _write(self, table: str, found: Iterator[dict[str, Any]], how: str = "") -> None:
        while some := list(islice(found, AT_ONCE)):
            columns = ("map", *some[0])
            places = ", ".join("%s::bigint[]" if name in ARRAYS else "%s" for name in columns)
            query = f"INSERT INTO {table} ({', '.join(columns)}){how} VALUES ({places})"
            with self._connection.cursor() as cursor:
                cursor.executemany(query.encode(), [(self.number, *row.values()) for row in some])
