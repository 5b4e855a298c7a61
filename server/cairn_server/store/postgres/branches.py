"""Branches in PostgreSQL: registered robots, their last signs and states."""

import json
import time
from typing import Any

from cairn_map.commits.cursor import ENTRY_FOLD, Cursor, cursor_from_text
from cairn_map.commits.ids import Author, Incarnation, RobotName
from cairn_map.errors import NotFoundError
from cairn_server.map_refusals import check_assignment_count
from cairn_server.store.admission import Grounds
from cairn_server.store.branch_signs import LastSeen
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.robot_keys import admit_registration
from cairn_server.store.postgres.schema import NOW_S
from cairn_server.store.postgres.shares import lock_head
from cairn_server.store.postgres.tokens import put_registration, remove_tokens_of
from cairn_server.store.postgres.writing_threads import WritingThreads
from cairn_server.store.store_rows import Branch, EntrySize, HeardRobot, MapRow

_SELECT = "SELECT name, mode, sensors, cursor, last_seen_s, incarnation FROM branch WHERE map = %s"


class PgBranches:
    """Branches, and `branch_signs.BranchNotes`."""

    def __init__(self, connections: Connections, threads: WritingThreads) -> None:
        self._connections = connections
        self._threads = threads
        self._seen = LastSeen()

    def register(self, row: MapRow, branch: Branch, token_hash: bytes, grounds: Grounds, *, age_s: float) -> None:
        """Make a branch, or give an existing one a new token, if its name is not bound to another key."""
        author = Author(RobotName(branch.name), Incarnation(branch.incarnation))
        self.write_seen()  # before the row is replaced
        self._threads.flush()
        self._seen.forget(row.number, branch.name)
        sensors = json.dumps(branch.sensors)
        values = (row.number, branch.name, branch.mode, sensors, branch.last_seen_s, branch.incarnation)

        def job(connection: Connection) -> None:
            lock_head(connection, row)
            admit_registration(connection, row, author, grounds)
            connection.execute(
                "INSERT INTO branch (map, name, mode, sensors, last_seen_s, incarnation)"
                " VALUES (%s, %s, %s, %s, %s, %s)"
                " ON CONFLICT (map, name) DO UPDATE SET mode = excluded.mode, sensors = excluded.sensors,"
                " last_seen_s = excluded.last_seen_s,"
                # A new incarnation may have lost its disk: where it stands is not known before it fetches.
                " cursor = CASE WHEN branch.incarnation = excluded.incarnation THEN branch.cursor END,"
                " incarnation = excluded.incarnation",
                values,
            )
            put_registration(connection, row, branch.name, token_hash, age_s=age_s)

        self._connections.run(job)

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands; may be written later."""
        if self._seen.note(row.number, name, str(cursor) if cursor else None):
            self.write_seen()

    def write_seen(self) -> None:
        """Write soon what was heard of branches."""
        signs = sorted(self._seen.taken().items())
        if not signs:
            return
        query = (
            f"UPDATE branch SET last_seen_s = {NOW_S} - u.ago_s, cursor = coalesce(u.cursor, branch.cursor)"
            " FROM unnest(%s::bigint[], %s::text[], %s::float8[], %s::text[]) AS u (map, name, ago_s, cursor)"
            " WHERE branch.map = u.map AND branch.name = u.name"
        )

        def job(connection: Connection) -> None:
            now_s = time.time()
            columns: tuple[list[Any], ...] = (
                [number for (number, _), _ in signs],
                [name for (_, name), _ in signs],
                [max(0.0, now_s - sign.time_s) for _, sign in signs],
                [sign.cursor for _, sign in signs],
            )
            connection.execute(query, columns)

        self._threads.note(job)

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and its tokens."""

        def job(connection: Connection) -> None:
            if not connection.execute("DELETE FROM branch WHERE map = %s AND name = %s", (row.number, name)).rowcount:
                raise NotFoundError("no_branch", f"map {row.name} has no branch {name!r}")
            for table in ("branch_status", "branch_view"):
                connection.execute(f"DELETE FROM {table} WHERE map = %s AND name = %s", (row.number, name))
            remove_tokens_of(connection, row, name)

        self._connections.run(job)
        self._seen.forget(row.number, name)

    def all(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        self.write_seen()
        self._threads.flush()
        with self._connections.lent() as connection:
            return [_branch(*columns) for columns in rows(connection, f"{_SELECT} ORDER BY name", (row.number,))]

    def one(self, row: MapRow, name: str) -> Branch | None:
        """One branch as it is stored."""
        with self._connections.lent() as connection:
            found = first(connection, f"{_SELECT} AND name = %s", (row.number, name))
        return None if found is None else _branch(*found)

    def put_status(self, row: MapRow, branch: str, status: str) -> None:
        """Keep the last status of a branch, as JSON, if there is such a branch; may be written later."""
        self.put_heard_status(row, branch, status, heard_s=time.time())

    def put_heard_status(self, row: MapRow, branch: str, status: str, *, heard_s: float) -> None:
        """Keep the status of a branch, if there is such a branch, unless one that was heard later is kept."""
        query = (
            "INSERT INTO branch_status (map, name, status, heard_s)"
            # Locked, so that a branch which is removed at this moment leaves no status behind.
            " SELECT map, name, %s, %s::float8 FROM branch WHERE map = %s AND name = %s FOR KEY SHARE"
            " ON CONFLICT (map, name) DO UPDATE SET status = excluded.status, heard_s = excluded.heard_s"
            " WHERE branch_status.heard_s <= excluded.heard_s"
        )
        self._threads.note(lambda connection: connection.execute(query, (status, heard_s, row.number, branch)))

    def assign(self, row: MapRow, robot: str, assignment: str | None) -> None:
        """Keep which layers of a map a robot takes part in, as JSON, or (None) no more; durable on return."""

        def job(connection: Connection) -> None:
            lock_head(connection, row)
            connection.execute("DELETE FROM assignment WHERE map = %s AND robot = %s", (row.number, robot))
            if assignment is not None:
                ((others,),) = rows(connection, "SELECT count(*) FROM assignment WHERE map = %s", (row.number,))
                check_assignment_count(row.name, others)
                connection.execute("INSERT INTO assignment VALUES (%s, %s, %s)", (row.number, robot, assignment))

        self._connections.run(job)

    def assignments(self, row: MapRow, robot: str | None = None) -> dict[str, str]:
        """Assignments of a map by robot: of all, or (one at most) of a robot."""
        query = "SELECT robot, assignment FROM assignment WHERE map = %s"
        with self._connections.lent() as connection:
            if robot is None:
                return dict(rows(connection, f"{query} ORDER BY robot", (row.number,)))
            return dict(rows(connection, f"{query} AND robot = %s", (row.number, robot)))

    def flush(self) -> None:
        """Return when all notes that were made are written."""
        self._threads.flush()

    def statuses(self, row: MapRow) -> dict[str, str]:
        """Last status of each branch that ever reported one."""
        self._threads.flush()
        with self._connections.lent() as connection:
            return dict(rows(connection, "SELECT name, status FROM branch_status WHERE map = %s", (row.number,)))

    def heard(self, *, limit: int) -> list[HeardRobot]:
        """Robots of all maps by their last signs, the newest first."""
        query = (
            "SELECT map.name, branch.name, last_seen_s FROM branch JOIN map ON map.map = branch.map"
            " ORDER BY last_seen_s DESC, 1, 2 LIMIT %s"
        )
        with self._connections.lent() as connection:
            return [HeardRobot(*columns) for columns in rows(connection, query, (limit,))]

    def entry_sizes(self, row: MapRow, *, after_seq: int, limit: int) -> list[EntrySize]:
        """Log entries after one, oldest first, at most `limit`."""
        query = (
            "SELECT seq, kind, robot, incarnation, size_bytes FROM log"
            " JOIN commits ON commits.map = log.map AND commits.number = log.commit_number"
            " WHERE log.map = %s AND seq > %s ORDER BY seq LIMIT %s"
        )
        with self._connections.lent() as connection:
            found = rows(connection, query, (row.number, after_seq, limit))
        return [
            EntrySize(seq, Author(robot, incarnation) if kind == ENTRY_FOLD else None, size)
            for seq, kind, robot, incarnation, size in found
        ]


def _branch(name: str, mode: str, sensors: str, cursor: str | None, seen_s: float, born: str) -> Branch:
    return Branch(name, mode, tuple(json.loads(sensors)), cursor_from_text(cursor) if cursor else None, seen_s, born)
