"""Robots' keys in the embedded store (`store.AdmittedKeys`): which a name is bound to, and by whose word."""

import time

import apsw

from cairn_map.commits.ids import SERVERS_OWN, Author, Incarnation, RobotName
from cairn_server.store.admission import Grounds, RobotKey, check_commit, check_registration
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.retention import check_lives
from cairn_server.store.sqlite.writer import Writer, first, rows
from cairn_server.store.store_rows import MapRow

_SELECT = "SELECT robot, incarnation, is_proven, may_return, since_s, by FROM robot_key WHERE map = ?"


class SqliteAdmittedKeys:
    """`store.AdmittedKeys`."""

    def __init__(self, writer: Writer, readers: Readers) -> None:
        self._writer = writer
        self._readers = readers

    def all(self, row: MapRow) -> list[RobotKey]:
        """All admitted keys, by robot and incarnation."""
        with self._readers.reading() as reader:
            return [
                _key(*found) for found in rows(reader, f"{_SELECT} ORDER BY robot, incarnation", (row.names_number,))
            ]

    def of(self, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
        """Admitted keys of a robot."""
        with self._readers.reading() as reader:
            return _known(reader, row, robot)

    def admit(self, row: MapRow, author: Author, *, by: str) -> None:
        """Admit a key by an operator's word; durable on return."""

        def job(connection: apsw.Connection) -> None:
            check_lives(connection, row.number)
            _put(connection, row, author, may_return=True, by=by)

        self._writer.run(job)


def admit_commit(connection: apsw.Connection, row: MapRow, author: Author, grounds: Grounds) -> None:
    """Admit the author of a new commit inside its transaction, or refuse it (`admission.check_commit`)."""
    if author.robot in SERVERS_OWN:
        return
    query = "SELECT is_proven FROM robot_key WHERE map = ? AND robot = ? AND incarnation = ?"
    is_proven, signs = first(connection, query, (row.names_number, *author)), author.incarnation in grounds.signers
    if is_proven is None:
        check_commit(author, grounds, _known(connection, row, author.robot))
    if is_proven is None or (signs and not is_proven):
        _put(connection, row, author, is_proven=signs, by=grounds.by)


def admit_registration(connection: apsw.Connection, row: MapRow, author: Author, grounds: Grounds) -> None:
    """Admit a registration inside its transaction, or refuse it (`admission.check_registration`)."""
    check_registration(author, grounds, _known(connection, row, author.robot))
    _put(connection, row, author, is_proven=author.incarnation in grounds.signers, by=grounds.by)
    connection.execute(
        "UPDATE robot_key SET may_return = 0 WHERE map = ? AND robot = ?", (row.names_number, author.robot)
    )


def _known(connection: apsw.Connection, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
    found = [_key(*values) for values in rows(connection, f"{_SELECT} AND robot = ?", (row.names_number, robot))]
    return {key.author.incarnation: key for key in found}


def _put(
    connection: apsw.Connection,
    row: MapRow,
    author: Author,
    *,
    is_proven: bool = False,
    may_return: bool = False,
    by: str,
) -> None:
    connection.execute(
        "INSERT INTO robot_key (map, robot, incarnation, is_proven, may_return, since_s, by)"
        " VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT (map, robot, incarnation) DO UPDATE SET"
        " is_proven = max(is_proven, excluded.is_proven), may_return = max(may_return, excluded.may_return)",
        (row.names_number, *author, is_proven, may_return, time.time(), by),
    )


def _key(robot: str, incarnation: str, is_proven: int, may_return: int, since_s: float, by: str) -> RobotKey:
    author = Author(RobotName(robot), Incarnation(incarnation))
    return RobotKey(author=author, is_proven=bool(is_proven), may_return=bool(may_return), since_s=since_s, by=by)
