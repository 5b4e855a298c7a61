"""Shares: the part of each bound of a map that one robot may take, so that no robot can take another's.

    bound of the map  =  ROBOTS_MAX shares of equal size, one for each robot's name
                      +  the reserve: the servers' own commits, and authors that an administrator closed

A bound that all robots drew from could be used up by one of them for all. A share is the robot's own, with all its
incarnations, and all shares and the reserve together fit the bound: so nothing that one robot pushes can make the
server refuse another's commit. What is taken out of the map again is given back to the share.

    sums         per region of 4^3 cells, and plane: the largest numbers of the robot's commits there that are in the
                 map, added up; no voxel can hold more of the robot's, and so no sum can overflow
    authors      incarnations of a robot, and the intervals of their numbers: what a version vector has to list

Closing a robot moves what it holds into the reserve; its name begins again with an empty share.
"""

from collections.abc import Iterable, Sequence
from operator import gt, truediv
from typing import Any

from cairn_map.commits.ids import SERVERS_OWN, CommitId
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_server.store.store_rows import NewCommit, RobotShares, UsedPart

Tops = tuple[int, ...]
"""(2 + P) largest number of each plane. No array: a commit has few regions, and the thread that writes little time."""
REGION_BITS = 6
"""Bits of a cell number below its region's: 4^3 cells. By cell the accounts would be as long as the lists of cells that
commits touch, and half of the store's work."""

ROBOTS_MAX = 256
"""Most robots with authors that are not closed, in one map."""
CARRIED_ROBOTS_MAX = 192
"""Number of such robots from which on a new one must come with a token of its own: who carries commits (a relay, the
upstream server) can invent names, and would take the last places from robots that come themselves."""
MARKS_OF_ROBOT_MAX = 16_384
"""Most marks of one robot on a map that are not taken out: with the largest texts some 60 MB."""
MARKS_OF_SERVERS_MAX = 65_536
"""The same of all operators together."""
INCARNATIONS_MAX = 16
"""Most incarnations of one robot that are not closed: disks lost or rolled back."""
INTERVALS_OF_ROBOT_MAX = 24
"""Most intervals of the numbers of one robot, all incarnations together. Robots push oldest first, so that each
incarnation has one interval, and one more for each commit that the server refused for good."""
RESERVE_MORE = 256
"""Room in the reserve for more than all robots at their most: the servers' own authors, and closings of before."""
INTERVALS_OF_RESERVE_MAX = ROBOTS_MAX * INTERVALS_OF_ROBOT_MAX + RESERVE_MORE
"""Most intervals of the servers' own and of closed authors: every place can be given back, however full its share."""
AUTHORS_OF_RESERVE_MAX = ROBOTS_MAX * INCARNATIONS_MAX + RESERVE_MORE
"""Most of these authors."""
INTERVALS_MAX = ROBOTS_MAX * INTERVALS_OF_ROBOT_MAX + INTERVALS_OF_RESERVE_MAX
"""Most intervals of the numbers of all authors of a map. Its vector is in every reply: with the longest name and
numbers an author takes 88 bytes, and each of its intervals beyond the first 34."""
AUTHORS_MAX = ROBOTS_MAX * INCARNATIONS_MAX + AUTHORS_OF_RESERVE_MAX
"""Most authors of a map."""
ALARM_PART = 0.5
"""Part of a share above which it is reported."""

RESERVE = ""
"""Account of what belongs to no robot's share; no robot has an empty name."""


def account_of(robot: str, *, is_closed: bool) -> str:
    """Account that bears an author's commits: its robot's name, or the reserve."""
    return RESERVE if is_closed or robot in SERVERS_OWN else robot


def limits_of(account: str, planes: int) -> Tops:
    """Most that an account may hold in a voxel: half of the range is for all robots, half for the reserve."""
    shares = 1 if account == RESERVE else ROBOTS_MAX
    return (COUNT_MAX // 2 // shares,) * 2 + (SUM_MAX // 2 // shares,) * (planes - 2)


def region_of(key: CellKey) -> int:
    """Region in which a cell lies."""
    return int(key) >> REGION_BITS


def used_part(account: str, total: Tops) -> float:
    """Part of the account's share that is taken in a region, of the plane that is fullest."""
    return float(max(map(truediv, total, limits_of(account, len(total)))))


def check_sums(account: str, region: int, total: Tops, geometry: Geometry) -> None:
    """Refuse a total beyond an account's share.

    Raises:
        BadInputError: kind `evidence_overflow`.
    """
    most = limits_of(account, len(total))
    plane = next((plane for plane, number in enumerate(total) if number > most[plane]), None)
    if plane is None:
        return
    first_cell = region << REGION_BITS
    low, high = (cell_of_key(CellKey(cell)) for cell in (first_cell, first_cell + (1 << REGION_BITS) - 1))
    whose = f"robot {account}'s evidence" if account else "prior data and closed robots' evidence"
    remedy = (
        f"an operator can retract evidence of {account} there (`cairn map retract --robot {account}`), or an "
        f"administrator give it a new share (`cairn map robots close`)"
        if account
        else "retract some of it, or begin a new map"
    )
    raise BadInputError(
        "evidence_overflow",
        f"with this commit {whose} in a voxel of the cells {low} to {high} could sum up to {total[plane]} in "
        f"the plane {_plane_name(geometry, plane)}, and its share is {most[plane]}; {remedy}",
    )


def used_bounds(share: RobotShares) -> dict[str, float]:
    """Part that is used of each bound, by its name."""
    intervals_max = INTERVALS_OF_ROBOT_MAX if share.robot else INTERVALS_OF_RESERVE_MAX
    authors_max = INCARNATIONS_MAX if share.robot else AUTHORS_OF_RESERVE_MAX
    return {
        "sums": share.sums or 0.0,
        "incarnations": share.incarnations / authors_max,
        "intervals": share.intervals / intervals_max,
    }


LEAST_FULL = INCARNATIONS_MAX * ALARM_PART, INTERVALS_OF_ROBOT_MAX * ALARM_PART
"""Authors and intervals of an account above which more than half of any account's bound may be used."""


def full_authors(accounts: Iterable[Sequence[Any]], crowded: Iterable[Sequence[Any]]) -> list[UsedPart]:
    """Parts above a half of the bounds of authors and robots.

    Args:
        accounts: map's name, account, count of its authors and of their intervals; at least those above `LEAST_FULL`.
        crowded: map's name and count of its robots; at least those above a half.
    """
    found = [
        UsedPart(name, account, bound, part)
        for name, account, authors, intervals in accounts
        for bound, part in used_bounds(
            RobotShares(robot=account, incarnations=authors, intervals=intervals, sums=None)
        ).items()
    ]
    found += [UsedPart(name, RESERVE, "robots", robots / ROBOTS_MAX) for name, robots in crowded]
    return [used for used in found if used.part > ALARM_PART]


def check_reserve(*, authors: int, intervals: int, what: str) -> None:
    """Refuse authors and intervals beyond the reserve; `what` would add the last of them.

    Raises:
        BadInputError: kind `too_many_authors`.
    """
    if authors > AUTHORS_OF_RESERVE_MAX or intervals > INTERVALS_OF_RESERVE_MAX:
        raise BadInputError(
            "too_many_authors",
            f"with {what} the servers' own and closed authors would be {authors} with {intervals} intervals of "
            f"numbers, and may be {AUTHORS_OF_RESERVE_MAX} with {INTERVALS_OF_RESERVE_MAX}: begin a new map",
        )


def check_old_sums(old: Tops) -> None:
    """Refuse evidence for a map whose sums from before there were shares leave no room for them.

    Raises:
        BadInputError: kind `evidence_overflow`.
    """
    if any(map(gt, old, limits_of(RESERVE, len(old)))):
        raise BadInputError(
            "evidence_overflow",
            "this map took so much evidence before robots had shares of their own that its sums could overflow; "
            "retract what is too much of it and start the server again: it then measures what the cells hold",
        )


def _plane_name(geometry: Geometry, plane: int) -> str:
    if plane < 2:
        return ("hits", "misses")[plane]
    for channel in geometry.channels:
        planes = geometry.planes_of(channel.name)
        if plane - 2 < planes.stop:
            return f"{channel.name} {plane - 2 - planes.start}"
    return str(plane)


def check_marks(commit: NewCommit, held: int) -> None:
    """Refuse marks beyond those that a robot, or all operators, may have on a map.

    Args:
        commit: with marks.
        held: marks of its robot that are not taken out, nor to be taken out by it.

    Raises:
        BadInputError: kind `too_many_marks`.
    """
    robot = commit.id.author.robot
    most = MARKS_OF_SERVERS_MAX if robot in SERVERS_OWN else MARKS_OF_ROBOT_MAX
    if held + len(commit.marks) > most:
        raise BadInputError(
            "too_many_marks",
            f"{robot} has {held} marks on this map, of at most {most}: take old ones out (cairn map mark --remove), "
            "and push this again",
        )


def own_targets(commit: NewCommit) -> list[CommitId]:
    """Commits of its own robot that a commit takes out: their marks leave room for its own."""
    return [target for target in commit.retracts if target.author.robot == commit.id.author.robot]
