"""Numbering of commits: numbers that would tear a map's version vector apart are refused."""

from collections.abc import Sequence
from dataclasses import dataclass

from cairn_map.commits.ids import OPERATOR, SERVERS_OWN, CommitId
from cairn_map.errors import BadInputError, ConflictError
from cairn_server.store.shares import (
    CARRIED_ROBOTS_MAX,
    INCARNATIONS_MAX,
    INTERVALS_OF_ROBOT_MAX,
    ROBOTS_MAX,
    check_reserve,
)

AHEAD_MAX = 10_000
"""Most that a number may run ahead of its author's highest. An author's first number may be any: a robot that comes to
a new server may not have its oldest commits any more."""
NAMED_MAX = 5
"""Most ids that an error message names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbering:
    """Facts of an author's numbers, and of what its robot's share has left, before one more commit."""

    top: int | None
    """Highest number of the author; None before its first commit."""
    neighbours: int
    """Count of the numbers n - 1 and n + 1 that are known."""
    is_closed: bool = False
    """True if an administrator closed the author."""
    incarnations: int = 0
    """Count of the robot's authors that are not closed; of the reserve's for a server's own commit."""
    intervals: int = 0
    """Count of the intervals of their numbers."""
    robots: int = 0
    """Count of the robots with such authors; only counted for a robot that has none."""
    is_carried: bool = False
    """True if somebody else than the robot brings the commit."""


def check_number(commit: CommitId, known: Numbering) -> None:
    """Refuse a number that would tear the version vector apart.

    Raises:
        ConflictError: kind `author_closed`.
        BadInputError: kind `number_gap` or `too_many_authors`.
    """
    robot = commit.author.robot
    if known.is_closed:
        raise ConflictError(
            "author_closed",
            f"an administrator closed {commit.author}, which takes no new commits; the robot goes on with a new "
            "incarnation",
        )
    if known.top is not None and commit.n > known.top + AHEAD_MAX:
        raise BadInputError(
            "number_gap",
            f"{commit} runs more than {AHEAD_MAX} ahead of {known.top}, the highest of its author; push those before "
            "it first, or take a new incarnation",
        )
    if known.neighbours:
        return
    if robot in SERVERS_OWN:
        # A server's own retracts have an incarnation for each of its starts, and nothing can be in their way.
        if robot != OPERATOR:
            authors = known.incarnations + (known.top is None)
            check_reserve(authors=authors, intervals=known.intervals + 1, what=str(commit))
        return
    closing = f"an administrator can begin its numbers again with `cairn map robots close MAP {robot}`"
    is_new = known.top is None
    if is_new and not known.incarnations and known.is_carried and known.robots >= CARRIED_ROBOTS_MAX:
        raise BadInputError(
            "too_many_authors",
            f"{known.robots} robots have commits in this map: from {CARRIED_ROBOTS_MAX} on {robot} has to come with a "
            "token of its own, or an administrator closes some that do not come any more (`cairn map robots close MAP "
            "NAME`)",
        )
    if is_new and not known.incarnations and known.robots >= ROBOTS_MAX:
        raise BadInputError(
            "too_many_authors",
            f"{known.robots} robots have commits in this map, which has {ROBOTS_MAX} places: there is none for {robot} "
            "before an administrator closes one that does not come any more (`cairn map robots close MAP NAME`)",
        )
    if is_new and known.incarnations >= INCARNATIONS_MAX:
        raise BadInputError(
            "too_many_authors",
            f"robot {robot} has {known.incarnations} incarnations in this map, at most {INCARNATIONS_MAX}; {closing}",
        )
    if known.intervals >= INTERVALS_OF_ROBOT_MAX:
        raise BadInputError(
            "too_many_authors" if is_new else "number_gap",
            f"the numbers of robot {robot} have {known.intervals} intervals in all its incarnations, and may have "
            f"{INTERVALS_OF_ROBOT_MAX}: {commit} would begin another; push the commits between them first, or "
            f"{closing}",
        )


AGAIN_KEPT_S = 3600.0
"""Least time for which evidence is kept that was pushed again because a retract needs it, whatever the setting."""


class EvidenceGoneError(ConflictError):
    """A retract names commits whose evidence was dropped."""

    def __init__(self, commits: Sequence[CommitId]) -> None:
        names = ", ".join(map(str, commits[:NAMED_MAX])) + (" ..." if len(commits) > NAMED_MAX else "")
        super().__init__(
            "evidence_gone",
            f"the evidence of {len(commits)} of these commits is not kept any more ({names}); robots that have their "
            "bytes push them again when they sync, and then they can be retracted",
        )
        self.commits = tuple(commits)
