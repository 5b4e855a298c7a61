"""Numbering of commits: numbers that would tear a map's version vector apart are refused."""

from collections.abc import Sequence
from dataclasses import dataclass

from cairn_map.commits.ids import OPERATOR, CommitId
from cairn_map.errors import BadInputError, ConflictError

AUTHOR_INTERVALS_MAX = 1000
"""Most intervals of one author's numbers. A robot pushes oldest first, so an honest one has a handful."""


AHEAD_MAX = 10_000
"""Most that a number may run ahead of its author's highest. An author's first number may be any: a robot that comes to
a new server may not have its oldest commits any more."""


INCARNATIONS_MAX = 256
"""Most incarnations of one robot: disks lost or rolled back."""


AUTHORS_MAX = 8192
"""Most authors of one map. Its vector is in every reply: with the longest name and numbers an author takes 88 bytes."""


INTERVALS_MAX = 10_240
"""Most intervals of the numbers of all authors of a map: beyond the first of each author one takes 34 bytes at most."""


NAMED_MAX = 5
"""Most ids that an error message names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbering:
    """Facts of an author's numbers, and of the map's vector, before one more commit."""

    top: int | None
    """Highest number of the author; None before its first commit."""
    intervals: int
    neighbours: int
    """Count of the numbers n - 1 and n + 1 that are known."""
    incarnations: int
    """Count of the same robot's incarnations, this one included if it is known."""
    authors_in_map: int
    intervals_in_map: int


def check_number(commit: CommitId, numbering: Numbering) -> None:
    """Refuse a number that would tear the version vector apart.

    Raises:
        BadInputError: kind `number_gap` or `too_many_authors`.
    """
    known = numbering
    if known.top is not None and commit.n > known.top + AHEAD_MAX:
        raise BadInputError(
            "number_gap",
            f"{commit} runs more than {AHEAD_MAX} ahead of {known.top}, the highest of its author; push those before "
            "it first, or take a new incarnation",
        )
    if known.neighbours:
        return
    if known.intervals >= AUTHOR_INTERVALS_MAX:
        raise BadInputError(
            "number_gap",
            f"the numbers of {commit.author} have {known.intervals} gaps, {commit} would open another; fill some first",
        )
    is_new = known.top is None
    too_many = known.authors_in_map >= AUTHORS_MAX or known.intervals_in_map >= INTERVALS_MAX
    spent = is_new and known.incarnations >= INCARNATIONS_MAX
    # A server's own retracts have an incarnation for each of its starts, and no robot can be in their way.
    if (too_many or spent) and commit.author.robot != OPERATOR:
        raise BadInputError(
            "too_many_authors",
            f"{commit.author} has {known.incarnations} incarnations (at most {INCARNATIONS_MAX}), the map "
            f"{known.authors_in_map} authors and {known.intervals_in_map} intervals of their numbers (at most "
            f"{AUTHORS_MAX} and {INTERVALS_MAX}); keep the robots' folders, or begin a new map",
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
