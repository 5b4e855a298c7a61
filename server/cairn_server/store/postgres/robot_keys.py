"""Robots' keys in PostgreSQL (`store.AdmittedKeys`): which a name is bound to, and by whose word."""

from cairn_map.commits.ids import SERVERS_OWN, Author, Incarnation, RobotName
from cairn_server.store.admission import Grounds, RobotKey, check_commit, check_registration
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.schema import NOW_S
from cairn_server.store.postgres.shares import lock_head, lock_names
from cairn_server.store.store_rows import MapRow

_SELECT = "SELECT robot, incarnation, is_proven, may_return, since_s, by FROM robot_key WHERE map = %s"


class PgAdmittedKeys:
    """`store.AdmittedKeys`."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def all(self, row: MapRow) -> list[RobotKey]:
        """All admitted keys, by robot and incarnation."""
        with self._connections.lent() as connection:
            found = rows(connection, f"{_SELECT} ORDER BY robot, incarnation", (row.names_number,))
        return [_key(*values) for values in found]

    def of(self, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
        """Admitted keys of a robot."""
        with self._connections.lent() as connection:
            return _known(connection, row, robot)

    def admit(self, row: MapRow, author: Author, *, by: str) -> None:
        """Admit a key by an operator's word; durable on return."""

        def job(connection: Connection) -> None:
            lock_head(connection, row)
            lock_names(connection, row)
            _put(connection, row, author, may_return=True, by=by)

        self._connections.run(job)


def admit_commit(connection: Connection, row: MapRow, author: Author, grounds: Grounds) -> None:
    """Admit the author of a new commit inside its transaction, or refuse it (`admission.check_commit`)."""
    if author.robot in SERVERS_OWN:
        return
    query = "SELECT is_proven FROM robot_key WHERE map = %s AND robot = %s AND incarnation = %s"
    is_proven, signs = first(connection, query, (row.names_number, *author)), author.incarnation in grounds.signers
    if is_proven is None:
        lock_names(connection, row)
        check_commit(author, grounds, _known(connection, row, author.robot))
    if is_proven is None or (signs and not is_proven):
        _put(connection, row, author, is_proven=signs, by=grounds.by)


def admit_registration(connection: Connection, row: MapRow, author: Author, grounds: Grounds) -> None:
    """Admit a registration, or refuse it (`admission.check_registration`); the head is locked."""
    lock_names(connection, row)
    check_registration(author, grounds, _known(connection, row, author.robot))
    _put(connection, row, author, is_proven=author.incarnation in grounds.signers, by=grounds.by)
    query = "UPDATE robot_key SET may_return = false WHERE map = %s AND robot = %s"
    connection.execute(query, (row.names_number, author.robot))


def _known(connection: Connection, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
    found = [_key(*values) for values in rows(connection, f"{_SELECT} AND robot = %s", (row.names_number, robot))]
    return {key.author.incarnation: key for key in found}


def _put(
    connection: Connection,
    row: MapRow,
    author: Author,
    *,
    is_proven: bool = False,
    may_return: bool = False,
    by: str,
) -> None:
    connection.execute(
        "INSERT INTO robot_key (map, robot, incarnation, is_proven, may_return, since_s, by)"
        f" VALUES (%s, %s, %s, %s, %s, {NOW_S}, %s) ON CONFLICT (map, robot, incarnation) DO UPDATE SET"
        " is_proven = robot_key.is_proven OR excluded.is_proven,"
        " may_return = robot_key.may_return OR excluded.may_return",
        (row.names_number, *author, is_proven, may_return, by),
    )


def _key(robot: str, incarnation: str, is_proven: bool, may_return: bool, since_s: float, by: str) -> RobotKey:
    author = Author(RobotName(robot), Incarnation(incarnation))
    return RobotKey(author=author, is_proven=is_proven, may_return=may_return, since_s=since_s, by=by)
