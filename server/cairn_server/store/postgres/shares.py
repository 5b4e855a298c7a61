"""Accounts of what each robot holds of a map's bounds (`store.shares`), in rows of that robot alone.

A commit is charged in the statement that keeps it: totals are added up by the database, and a total beyond the share
breaks the table's constraint, so that no order of two pushes can get past it. The charge goes back when the log takes
the commit out again. So an account is, at any time, the sum over its commits that are pending or in the map.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain
from operator import add, sub
from typing import Any

from cairn_map.commits.ids import SERVERS_OWN, CommitId
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_server.store.numbering import Numbering, check_number
from cairn_server.store.postgres.connections import Connection, Connections, first, rows
from cairn_server.store.postgres.failures import lost_map
from cairn_server.store.postgres.schema import IS_RESERVE
from cairn_server.store.shares import (
    ALARM_PART,
    LEAST_FULL,
    RESERVE,
    ROBOTS_MAX,
    Tops,
    account_of,
    check_reserve,
    check_sums,
    full_authors,
    limits_of,
    used_part,
)
from cairn_server.store.store_rows import ClosedRobot, MapRow, RobotShares, UsedPart

Accounts = Mapping[tuple[str, int], Tops]
"""Totals by account and region."""
OF_ROBOT = "map = %s AND robot = %s AND NOT closed"
COUNTS = "SELECT count(*), coalesce(sum(intervals), 0)::bigint FROM author WHERE"
CHARGE = """
    INSERT INTO held (map, account, region, tops, room, part)
    SELECT %(map)s, %(account)s, charge.region, own.tops, own.room, own.part
    FROM {source} unnest(%(regions)s::bigint[]) WITH ORDINALITY AS charge (region, place),
        LATERAL (
            SELECT array_agg(top ORDER BY plane) AS tops, min(most - top) AS room, max(top::float8 / most) AS part
            FROM unnest(
                (%(tops)s::bigint[])[(charge.place - 1) * %(planes)s + 1 : charge.place * %(planes)s],
                %(limits)s::bigint[]
            ) WITH ORDINALITY AS p (top, most, plane)
        ) AS own
    ON CONFLICT (map, account, region) DO UPDATE SET (tops, room, part) = (
        SELECT array_agg(had + top ORDER BY plane), min(most - had - top), max((had + top)::float8 / most)
        FROM unnest(held.tops, excluded.tops, %(limits)s::bigint[]) WITH ORDINALITY AS p (had, top, most, plane)
    )"""
"""SQL that adds a commit's largest numbers to its account, region by region in rising order."""
COUNT_MARKS = """
    UPDATE author SET marks = marks + %(more)s FROM commits AS c
    WHERE c.map = %(map)s AND c.number = %(number)s
        AND author.map = c.map AND author.robot = c.robot AND author.incarnation = c.incarnation"""
"""SQL that counts the marks of a commit's author that are not taken out."""


def charge_of(commit: CommitId, tops: Mapping[int, Tops], planes: int) -> dict[str, Any]:
    """Values of `CHARGE`, but for the map."""
    account = account_of(commit.author.robot, is_closed=False)
    regions = sorted(tops)
    return {
        "account": account,
        "regions": regions,
        "tops": list(chain.from_iterable(tops[region] for region in regions)),
        "planes": planes,
        "limits": list(limits_of(account, planes)),
    }


def note_number(connection: Connection, row: MapRow, commit: CommitId, *, is_carried: bool) -> None:
    """Count the author's intervals as they are with this commit, if `numbering` lets it in; the head is locked.

    Raises:
        BadInputError, ConflictError: as `check_number`.
    """
    author = (row.number, *commit.author)
    # The robot's own fast pushes do not wait for the head: they wait for this row.
    query = (
        "SELECT top, intervals, closed FROM author WHERE map = %s AND robot = %s AND incarnation = %s FOR NO KEY UPDATE"
    )
    top, intervals, is_closed = first(connection, query, author) or (None, 0, False)
    query = "SELECT count(*) FROM commits WHERE map = %s AND robot = %s AND incarnation = %s AND n IN (%s, %s)"
    neighbours: int = first(connection, query, (*author, commit.n - 1, commit.n + 1))
    counted, spans, robots = 0, 0, 0
    if not neighbours:  # only then does anything grow but a number
        counted, spans, robots = _uses(connection, row, commit.author.robot)
    known = Numbering(
        top=top,
        neighbours=neighbours,
        is_closed=is_closed,
        incarnations=counted,
        intervals=spans,
        robots=robots,
        is_carried=is_carried,
    )
    check_number(commit, known)
    connection.execute(
        "INSERT INTO author (map, robot, incarnation, top, intervals) VALUES (%s, %s, %s, %s, %s)"
        " ON CONFLICT (map, robot, incarnation) DO UPDATE SET top = greatest(author.top, excluded.top),"
        " intervals = excluded.intervals",
        (*author, commit.n, intervals + 1 - neighbours),
    )


def check_charge(connection: Connection, row: MapRow, commit: CommitId, tops: Mapping[int, Tops]) -> None:
    """Refuse a charge that an account has no room for, in words.

    Raises:
        BadInputError: kind `evidence_overflow`.
    """
    account = account_of(commit.author.robot, is_closed=False)
    held = _held(connection, row, dict.fromkeys((account, region) for region in tops))
    for region, top in tops.items():
        had = held.get((account, region))
        check_sums(account, region, tuple(map(add, top, had)) if had else top, row.geometry)


def give_back_sums(connection: Connection, row: MapRow, commits: Sequence[int]) -> None:
    """Take commits off their accounts: the log has taken them out, and the head is locked."""
    query = (
        "SELECT robot, closed, regions, tops FROM commits JOIN author USING (map, robot, incarnation)"
        " WHERE map = %s AND number = ANY(%s)"
    )
    planes = 2 + row.geometry.plane_count
    less: defaultdict[tuple[str, int], Tops] = defaultdict(lambda: (0,) * planes)
    for robot, is_closed, regions, tops in rows(connection, query, (row.number, list(commits))):
        account = account_of(robot, is_closed=is_closed)
        for place, region in enumerate(regions):
            top = tops[place * planes : (place + 1) * planes]
            less[account, region] = tuple(map(add, less[account, region], top))
    held = _held(connection, row, less)
    _put(connection, row, {key: tuple(map(sub, held[key], less[key])) for key in less})


def close_robot(connection: Connection, row: MapRow, robot: str) -> ClosedRobot:
    """Close all authors of a robot, and move what they hold into the reserve; the head is locked.

    Raises:
        NotFoundError: kind `no_author`: it has none that is open.
        ConflictError: kind `reserve_full`; nothing was changed.
    """
    # Locked first: a push of the robot that is under way is on its account once this returns.
    query = f"SELECT intervals FROM author WHERE {OF_ROBOT} ORDER BY incarnation FOR NO KEY UPDATE"
    authors = rows(connection, query, (row.number, robot))
    if not authors or robot in SERVERS_OWN:
        raise NotFoundError("no_author", f"robot {robot!r} has no commits in map {row.name} that are its own to close")
    closed = ClosedRobot(authors=len(authors), intervals=sum(intervals for (intervals,) in authors))
    reserved = first(connection, f"{COUNTS} map = %s AND {IS_RESERVE}", (row.number,))
    query = "SELECT region, tops FROM held WHERE map = %s AND account = %s ORDER BY region FOR NO KEY UPDATE"
    own = {region: tuple(tops) for region, tops in rows(connection, query, (row.number, robot))}
    reserve = _held(connection, row, dict.fromkeys((RESERVE, region) for region in own))
    totals = {
        (RESERVE, region): tuple(map(add, top, reserve.get((RESERVE, region), (0,) * len(top))))
        for region, top in own.items()
    }
    try:
        check_reserve(authors=reserved[0] + closed.authors, intervals=reserved[1] + closed.intervals, what=robot)
        for (account, region), total in totals.items():
            check_sums(account, region, total, row.geometry)
    except BadInputError as exc:
        raise ConflictError("reserve_full", f"{robot} cannot be closed: {exc.message}") from exc
    _put(connection, row, totals)
    connection.execute("DELETE FROM held WHERE map = %s AND account = %s", (row.number, robot))
    connection.execute("UPDATE author SET closed = true WHERE map = %s AND robot = %s", (row.number, robot))
    return closed


def lock_head(connection: Connection, row: MapRow) -> None:
    """Lock a map's head: folds and all that may not overlap with them come one after the other."""
    if not connection.execute("SELECT 1 FROM head WHERE map = %s FOR NO KEY UPDATE", (row.number,)).rowcount:
        raise lost_map(connection, row.number)


def lock_names(connection: Connection, row: MapRow) -> None:
    """Lock the head by which the robots' names of a map and of its layers are bound; after the layer's own, if any.

    Two first keys of one name that come to two layers at the same time cannot both be first.
    """
    if row.of_map is not None:
        connection.execute("SELECT 1 FROM head WHERE map = %s FOR NO KEY UPDATE", (row.of_map,))


class PgShares:
    """`store.Shares`."""

    def __init__(self, connections: Connections) -> None:
        self._connections = connections

    def of(self, row: MapRow) -> list[RobotShares]:
        """Use of its shares by every robot, and of the reserve, by name."""
        accounts = f"CASE WHEN {IS_RESERVE} THEN '{RESERVE}' ELSE robot END"
        authors = (
            f"SELECT {accounts}, count(*), sum(intervals)::bigint FROM author WHERE map = %s GROUP BY 1 ORDER BY 1"
        )
        much = f"SELECT account, max(part) FROM held WHERE map = %s AND part > {ALARM_PART} GROUP BY account"
        with self._connections.snapshot() as connection:
            found = rows(connection, authors, (row.number,))
            parts = dict(rows(connection, much, (row.number,)))
        return [
            RobotShares(robot=account, incarnations=count, intervals=intervals, sums=parts.get(account))
            for account, count, intervals in found
        ]

    def full_sums(self) -> list[UsedPart]:
        """Shares of the sums of which more than half is used, of all maps, along the index of these."""
        query = (
            "SELECT name, account, part FROM"
            f" (SELECT map, account, max(part) AS part FROM held WHERE part > {ALARM_PART} GROUP BY 1, 2) AS much"
            " JOIN map USING (map)"
        )
        with self._connections.lent() as connection:
            return [UsedPart(name, account, "sums", part) for name, account, part in rows(connection, query)]

    def full_authors(self) -> list[UsedPart]:
        """The same of incarnations, intervals and robots."""
        accounts = f"CASE WHEN {IS_RESERVE} THEN '{RESERVE}' ELSE robot END"
        authors = (
            "SELECT name, account, authors, intervals FROM"
            f" (SELECT map, {accounts} AS account, count(*) AS authors, sum(intervals)::bigint AS intervals FROM author"
            "   GROUP BY 1, 2 HAVING count(*) > %s OR sum(intervals) > %s) AS much JOIN map USING (map)"
        )
        robots = (
            "SELECT name, robots FROM"
            f" (SELECT map, count(DISTINCT robot) AS robots FROM author WHERE NOT {IS_RESERVE}"
            "   GROUP BY 1 HAVING count(DISTINCT robot) > %s) AS much JOIN map USING (map)"
        )
        with self._connections.snapshot() as connection:
            much = rows(connection, authors, LEAST_FULL)
            crowded = rows(connection, robots, (ROBOTS_MAX * ALARM_PART,))
        return full_authors(much, crowded)

    def regions(self, row: MapRow, robot: str) -> list[int]:
        """Regions in which a robot has evidence, pending or in the map, rising."""
        query = "SELECT region FROM held WHERE map = %s AND account = %s ORDER BY region"
        with self._connections.lent() as connection:
            return [int(region) for (region,) in rows(connection, query, (row.number, robot))]

    def close(self, row: MapRow, robot: str) -> ClosedRobot:
        """Close all authors of a robot, and move what they hold into the reserve. Durable on return."""

        def job(connection: Connection) -> ClosedRobot:
            lock_head(connection, row)
            return close_robot(connection, row, robot)

        return self._connections.run(job)


def _uses(connection: Connection, row: MapRow, robot: str) -> tuple[int, int, int]:
    """Authors and intervals of an account, and for a robot without any the count of the robots that have some."""
    if robot in SERVERS_OWN:
        return (*first(connection, f"{COUNTS} map = %s AND {IS_RESERVE}", (row.number,)), 0)
    authors, intervals = first(connection, f"{COUNTS} {OF_ROBOT}", (row.number, robot))
    robots = f"SELECT count(DISTINCT robot) FROM author WHERE map = %s AND NOT {IS_RESERVE}"
    return authors, intervals, 0 if authors else first(connection, robots, (row.number,))


def _held(connection: Connection, row: MapRow, keys: Mapping[tuple[str, int], object]) -> dict[tuple[str, int], Tops]:
    """Totals on accounts in regions where they hold something; locked, by account and region."""
    query = (
        "SELECT account, region, tops FROM held WHERE map = %s AND (account, region) IN"
        " (SELECT * FROM unnest(%s::text[], %s::bigint[])) ORDER BY account, region FOR NO KEY UPDATE"
    )
    accounts, regions = [account for account, _ in keys], [region for _, region in keys]
    found = rows(connection, query, (row.number, accounts, regions))
    return {(account, region): tuple(tops) for account, region, tops in found}


def _put(connection: Connection, row: MapRow, totals: Accounts) -> None:
    """Write what accounts hold in some regions."""
    insert = (
        "INSERT INTO held (map, account, region, tops, room, part) VALUES (%s, %s, %s, %s, %s, %s)"
        " ON CONFLICT (map, account, region) DO UPDATE SET tops = excluded.tops, room = excluded.room,"
        " part = excluded.part"
    )
    delete = "DELETE FROM held WHERE map = %s AND account = %s AND region = %s"
    with connection.cursor() as cursor:
        for account, region in sorted(totals):
            total = totals[account, region]
            if any(total):
                room = min(map(sub, limits_of(account, len(total)), total))
                values = (row.number, account, region, list(total), room, used_part(account, total))
                cursor.execute(insert, values)
            else:
                cursor.execute(delete, (row.number, account, region))
