"""Branches in SQLite, and the notes on them."""

import json
from contextlib import suppress

import apsw

from cairn_map.commits.cursor import ENTRY_FOLD, cursor_from_text
from cairn_map.commits.ids import Author
from cairn_map.errors import UnreachableError
from cairn_server.map_refusals import check_assignment_count
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.retention import check_lives
from cairn_server.store.sqlite.schema import MAPS
from cairn_server.store.sqlite.writer import Writer, rows
from cairn_server.store.store_rows import Branch, EntrySize, HeardRobot, MapRow


class SqliteBranchNotes:
    """`branch_signs.BranchNotes` over a store's connections."""

    def __init__(self, writer: Writer, readers: Readers) -> None:
        self._writer = writer
        self._readers = readers

    def put_status(self, row: MapRow, branch: str, status: str) -> None:
        """Keep the last status of a branch, as JSON, if there is such a branch; may be written later."""
        query = (
            "INSERT INTO branch_status (map, name, status) SELECT map, name, ? FROM branch WHERE map = ? AND name = ?"
            " ON CONFLICT (map, name) DO UPDATE SET status = excluded.status"
        )
        with suppress(UnreachableError):  # the next one comes soon
            self._writer.submit(lambda connection: rows(connection, query, (status, row.number, branch)))

    def statuses(self, row: MapRow) -> dict[str, str]:
        """Last status of each branch that ever reported one."""
        with self._readers.reading() as reader:
            return dict(rows(reader, "SELECT name, status FROM branch_status WHERE map = ?", (row.number,)))

    def heard(self, *, limit: int) -> list[HeardRobot]:
        """Robots of all maps by their last signs, the newest first."""
        query = (
            f"SELECT map.name, branch.name, last_seen_s FROM branch JOIN {MAPS} ON map.number = branch.map"  # noqa: S608
            " ORDER BY last_seen_s DESC, 1, 2 LIMIT ?"
        )
        with self._readers.reading() as reader:
            return [HeardRobot(*columns) for columns in rows(reader, query, (limit,))]

    def entry_sizes(self, row: MapRow, *, after_seq: int, limit: int) -> list[EntrySize]:
        """Log entries after one, oldest first, at most `limit`."""
        query = (
            "SELECT seq, kind, robot, incarnation, size_bytes"
            " FROM log JOIN commits ON commits.number = log.commit_number"
            " WHERE log.map = ? AND seq > ? ORDER BY seq LIMIT ?"
        )
        with self._readers.reading() as reader:
            found = rows(reader, query, (row.number, after_seq, limit))
        return [
            EntrySize(seq, Author(robot, incarnation) if kind == ENTRY_FOLD else None, size)
            for seq, kind, robot, incarnation, size in found
        ]

    def assign(self, row: MapRow, robot: str, assignment: str | None) -> None:
        """Keep which layers of a map a robot takes part in, as JSON, or (None) no more; durable on return."""

        def job(connection: apsw.Connection) -> None:
            check_lives(connection, row.number)
            connection.execute("DELETE FROM assignment WHERE map = ? AND robot = ?", (row.number, robot))
            if assignment is not None:
                ((others,),) = rows(connection, "SELECT count(*) FROM assignment WHERE map = ?", (row.number,))
                check_assignment_count(row.name, others)
                connection.execute("INSERT INTO assignment VALUES (?, ?, ?)", (row.number, robot, assignment))

        self._writer.run(job)

    def assignments(self, row: MapRow, robot: str | None = None) -> dict[str, str]:
        """Assignments of a map by robot: of all, or (one at most) of a robot."""
        query = "SELECT robot, assignment FROM assignment WHERE map = ?"
        with self._readers.reading() as reader:
            if robot is None:
                return dict(rows(reader, f"{query} ORDER BY robot", (row.number,)))
            return dict(rows(reader, f"{query} AND robot = ?", (row.number, robot)))


def stored_branches(reader: apsw.Connection, row: MapRow, name: str | None = None) -> list[Branch]:
    """All branches by name, or the one of a name."""
    query = "SELECT name, mode, sensors, cursor, last_seen_s, incarnation FROM branch WHERE map = ?"
    if name is None:
        found = rows(reader, f"{query} ORDER BY name", (row.number,))
    else:
        found = rows(reader, f"{query} AND name = ?", (row.number, name))
    return [
        Branch(name, mode, tuple(json.loads(sensors)), cursor_from_text(cursor) if cursor else None, seen_s, born)
        for name, mode, sensors, cursor, seen_s, born in found
    ]
