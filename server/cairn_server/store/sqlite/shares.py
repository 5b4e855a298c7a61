"""Accounts of what each robot holds of a map's bounds (`store.shares`), each function inside one transaction.

A commit is charged when it is kept, and its charge goes back when the log takes it out again. So an account is, at any
time, the sum over the account's commits that are pending or in the map.
"""

import json
from collections.abc import Mapping, Sequence
from operator import add, sub
from struct import Struct, pack, unpack

import apsw

from cairn_map.commits.ids import SERVERS_OWN, CommitId
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_server.store.numbering import Numbering, check_number
from cairn_server.store.shares import (
    ALARM_PART,
    LEAST_FULL,
    RESERVE,
    ROBOTS_MAX,
    Tops,
    account_of,
    check_old_sums,
    check_reserve,
    check_sums,
    full_authors,
    used_part,
)
from cairn_server.store.sqlite.old_sums import old_sums
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.retention import check_lives
from cairn_server.store.sqlite.schema import MAPS
from cairn_server.store.sqlite.writer import Writer, first, rows
from cairn_server.store.store_rows import ClosedRobot, MapRow, NewCommit, RobotShares, UsedPart

SERVERS_IN_SQL = ", ".join(f"'{robot}'" for robot in sorted(SERVERS_OWN))
IS_RESERVE = f"(closed = 1 OR robot IN ({SERVERS_IN_SQL}))"
"""SQL of the authors whose commits are the reserve's."""
OF_ROBOT = "map = ? AND robot = ? AND closed = 0"
COUNTS = "SELECT count(*), coalesce(sum(intervals), 0) FROM author WHERE"


def note_number(connection: apsw.Connection, row: MapRow, commit: CommitId, *, is_carried: bool) -> None:
    """Count the author's intervals as they are with this commit, if `numbering` lets it in.

    Raises:
        BadInputError, ConflictError: as `check_number`.
    """
    author = (row.number, *commit.author)
    query = "SELECT top, intervals, closed FROM author WHERE map = ? AND robot = ? AND incarnation = ?"
    top, intervals, is_closed = first(connection, query, author) or (None, 0, 0)
    query = "SELECT count(*) FROM commits WHERE map = ? AND robot = ? AND incarnation = ? AND n IN (?, ?)"
    neighbours: int = first(connection, query, (*author, commit.n - 1, commit.n + 1))
    counted, spans, robots = 0, 0, 0
    if not neighbours:  # only then does anything grow but a number
        counted, spans, robots = _uses(connection, row, commit.author.robot)
    known = Numbering(
        top=top,
        neighbours=neighbours,
        is_closed=bool(is_closed),
        incarnations=counted,
        intervals=spans,
        robots=robots,
        is_carried=is_carried,
    )
    check_number(commit, known)
    connection.execute(
        "INSERT INTO author (map, robot, incarnation, top, intervals) VALUES (?, ?, ?, ?, ?)"
        " ON CONFLICT DO UPDATE SET top = max(top, excluded.top), intervals = excluded.intervals",
        (*author, commit.n, intervals + 1 - neighbours),
    )


def take_sums(connection: apsw.Connection, row: MapRow, commit: NewCommit) -> bytes:
    """Charge a new commit's largest numbers to its robot's account; what was charged, as `give_back_sums` reads it.

    Raises:
        BadInputError: kind `evidence_overflow`: the robot's share does not allow it; nothing was changed.
    """
    tops = commit.tops
    if not tops:
        return b""
    account = account_of(commit.id.author.robot, is_closed=False)
    held = _held(connection, row, account, list(tops))
    totals = {region: tuple(map(add, top, held[region])) if region in held else top for region, top in tops.items()}
    _check(connection, row, account, totals)
    _put(connection, row, account, totals)
    return b"".join(_packed((region, *top)) for region, top in tops.items())


def give_back_sums(connection: apsw.Connection, row: MapRow, number: int) -> None:
    """Take a commit off its account: the log has taken it out."""
    query = "SELECT robot, closed, charged FROM commits JOIN author USING (map, robot, incarnation) WHERE number = ?"
    robot, is_closed, charged = first(connection, query, (number,))
    if not charged:  # it came before there were accounts, or has no evidence
        return
    account = account_of(robot, is_closed=bool(is_closed))
    tops = {region: top for region, *top in Struct(f"<{3 + row.geometry.plane_count}q").iter_unpack(charged)}
    held = _held(connection, row, account, list(tops))
    _put(connection, row, account, {region: tuple(map(sub, held[region], top)) for region, top in tops.items()})


def close_robot(connection: apsw.Connection, row: MapRow, robot: str) -> ClosedRobot:
    """Close all authors of a robot, and move what they hold into the reserve.

    Raises:
        NotFoundError: kind `no_author`: it has none that is open.
        ConflictError: kind `reserve_full`; nothing was changed.
    """
    authors, intervals = first(connection, f"{COUNTS} {OF_ROBOT}", (row.number, robot))
    if not authors or robot in SERVERS_OWN:
        raise NotFoundError("no_author", f"robot {robot!r} has no commits in map {row.name} that are its own to close")
    reserved = first(connection, f"{COUNTS} map = ? AND {IS_RESERVE}", (row.number,))
    tops = _all_held(connection, row, robot)
    held = _all_held(connection, row, RESERVE)
    totals = {region: tuple(map(add, top, held[region])) if region in held else top for region, top in tops.items()}
    try:
        check_reserve(authors=reserved[0] + authors, intervals=reserved[1] + intervals, what=robot)
        _check(connection, row, RESERVE, totals)
    except BadInputError as exc:
        raise ConflictError("reserve_full", f"{robot} cannot be closed: {exc.message}") from exc
    _put(connection, row, RESERVE, totals)
    connection.execute("DELETE FROM held WHERE map = ? AND account = ?", (row.number, robot))
    connection.execute("UPDATE author SET closed = 1 WHERE map = ? AND robot = ?", (row.number, robot))
    return ClosedRobot(authors=authors, intervals=intervals)


class SqliteShares:
    """`store.Shares`."""

    def __init__(self, writer: Writer, readers: Readers) -> None:
        self._writer = writer
        self._readers = readers

    def of(self, row: MapRow) -> list[RobotShares]:
        """Use of its shares by every robot, and of the reserve, by name."""
        accounts = f"CASE WHEN {IS_RESERVE} THEN '{RESERVE}' ELSE robot END"
        authors = f"SELECT {accounts}, count(*), sum(intervals) FROM author WHERE map = ? GROUP BY 1 ORDER BY 1"  # noqa: S608 - our own clause
        much = f"SELECT account, max(part) FROM held WHERE map = ? AND part > {ALARM_PART} GROUP BY account"  # noqa: S608 - our own number
        with self._readers.transaction() as reader:
            found = rows(reader, authors, (row.number,))
            parts = dict(rows(reader, much, (row.number,)))
        return [
            RobotShares(robot=account, incarnations=count, intervals=intervals, sums=parts.get(account))
            for account, count, intervals in found
        ]

    def full_sums(self) -> list[UsedPart]:
        """Shares of the sums of which more than half is used, of all maps, along the index of these."""
        query = (
            "SELECT name, account, max(part) FROM held"  # noqa: S608 - our own number
            f" JOIN {MAPS} ON map.number = held.map"
            f" WHERE part > {ALARM_PART} GROUP BY map.number, account"
        )
        with self._readers.reading() as reader:
            return [UsedPart(name, account, "sums", part) for name, account, part in rows(reader, query)]

    def full_authors(self) -> list[UsedPart]:
        """The same of incarnations, intervals and robots."""
        accounts = f"CASE WHEN {IS_RESERVE} THEN '{RESERVE}' ELSE robot END"
        name, is_there = "map.name", f"JOIN {MAPS} ON map.number = author.map"
        authors = (
            f"SELECT {name}, {accounts} AS account, count(*), sum(intervals) FROM author {is_there}"  # noqa: S608 - our own clauses
            " GROUP BY author.map, account HAVING count(*) > ? OR sum(intervals) > ?"
        )
        robots = (
            f"SELECT {name}, count(DISTINCT robot) FROM author {is_there} WHERE NOT {IS_RESERVE}"  # noqa: S608 - our own clauses
            " GROUP BY author.map HAVING count(DISTINCT robot) > ?"
        )
        with self._readers.transaction() as reader:
            much = rows(reader, authors, LEAST_FULL)
            crowded = rows(reader, robots, (ROBOTS_MAX * ALARM_PART,))
        return full_authors(much, crowded)

    def regions(self, row: MapRow, robot: str) -> list[int]:
        """Regions in which a robot has evidence, pending or in the map, rising."""
        query = "SELECT region FROM held WHERE map = ? AND account = ? ORDER BY region"
        with self._readers.reading() as reader:
            return [int(region) for (region,) in rows(reader, query, (row.number, robot))]

    def close(self, row: MapRow, robot: str) -> ClosedRobot:
        """Close all authors of a robot, and move what they hold into the reserve. Durable on return."""

        def job(connection: apsw.Connection) -> ClosedRobot:
            check_lives(connection, row.number)
            return close_robot(connection, row, robot)

        return self._writer.run(job)


def _uses(connection: apsw.Connection, row: MapRow, robot: str) -> tuple[int, int, int]:
    """Authors and intervals of an account, and for a robot without any the count of the robots that have some."""
    if robot in SERVERS_OWN:
        return (*first(connection, f"{COUNTS} map = ? AND {IS_RESERVE}", (row.number,)), 0)
    authors, intervals = first(connection, f"{COUNTS} {OF_ROBOT}", (row.number, robot))
    robots = f"SELECT count(DISTINCT robot) FROM author WHERE map = ? AND NOT {IS_RESERVE}"  # noqa: S608 - our own clause
    return authors, intervals, 0 if authors else first(connection, robots, (row.number,))


def _held(connection: apsw.Connection, row: MapRow, account: str, regions: list[int]) -> dict[int, Tops]:
    """Numbers on an account in those of these regions in which it holds something."""
    query = "SELECT region, tops FROM held WHERE map = ? AND account = ? AND region IN (SELECT value FROM json_each(?))"
    found = connection.execute(query, (row.number, account, json.dumps(regions)))
    return {region: _unpacked(tops) for region, tops in found}


def _all_held(connection: apsw.Connection, row: MapRow, account: str) -> dict[int, Tops]:
    """Numbers on an account by region."""
    found = connection.execute("SELECT region, tops FROM held WHERE map = ? AND account = ?", (row.number, account))
    return {region: _unpacked(tops) for region, tops in found}


def _packed(numbers: Sequence[int]) -> bytes:
    return pack(f"<{len(numbers)}q", *numbers)


def _unpacked(numbers: bytes) -> Tops:
    return unpack(f"<{len(numbers) // 8}q", numbers)


def _check(connection: apsw.Connection, row: MapRow, account: str, totals: Mapping[int, Tops]) -> None:
    old = old_sums(connection, row.number)
    check_old_sums(old)
    for region, total in totals.items():
        # What came before there were accounts may be anywhere, and is the reserve's.
        check_sums(account, region, tuple(map(add, total, old)) if account == RESERVE else total, row.geometry)


def _put(connection: apsw.Connection, row: MapRow, account: str, totals: Mapping[int, Tops]) -> None:
    """Write what an account holds in some regions."""
    holding = [
        (row.number, account, region, _packed(total), used_part(account, total))
        for region, total in totals.items()
        if any(total)
    ]
    if holding:
        connection.executemany(
            "INSERT OR REPLACE INTO held (map, account, region, tops, part) VALUES (?, ?, ?, ?, ?)", holding
        )
    if len(holding) < len(totals):
        connection.executemany(
            "DELETE FROM held WHERE map = ? AND account = ? AND region = ?",
            [(row.number, account, region) for region, total in totals.items() if not any(total)],
        )
