"""Ids of commits: author and number, `(robot, incarnation, n)`, written `robot.incarnation.n`.

A new `incarnation` is drawn whenever a robot's commit store is created again, so that no number is used twice although
a disk was lost; `n` counts from 0 without gaps.
"""

import re
import secrets
from typing import NamedTuple, NewType

from cairn_map.errors import BadInputError

RobotName = NewType("RobotName", str)
Incarnation = NewType("Incarnation", str)
"""16 hex digits."""

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
INCARNATION = re.compile(r"[0-9a-f]{16}")
NUMBER = re.compile(r"0|[1-9][0-9]{0,14}")
NUMBER_LIMIT = 10**15
"""Exclusive upper bound of commit numbers: exact in a JSON reader that has only float64."""
INITIAL = RobotName("initial")
"""Author of the evidence that a map starts from."""
OPERATOR = RobotName("operator")
"""Author of the retracts that a server makes for its operators."""
SERVERS_OWN = frozenset({OPERATOR, INITIAL})
"""Authors in whose name servers speak."""


MAP_NAME = re.compile(r"(?P<map>[a-z0-9][a-z0-9_-]{0,31})(?:\.(?P<layer>[a-z][a-z0-9_]{0,31}))?")
"""Name of a map, or MAP.LAYER: of one of its further layers. No map's or robot's own name has a dot."""


class Author(NamedTuple):
    """A robot in one incarnation of its commit store."""

    robot: RobotName
    incarnation: Incarnation

    def __str__(self) -> str:
        return f"{self.robot}.{self.incarnation}"


class CommitId(NamedTuple):
    """The n-th commit of an author."""

    author: Author
    n: int

    def __str__(self) -> str:
        return f"{self.author}.{self.n}"


def new_incarnation() -> Incarnation:
    """A random incarnation; two are equal once in 2^64."""
    return Incarnation(secrets.token_hex(8))


def map_name(text: str) -> str:
    """A checked name of a map or, as MAP.LAYER, of one of its layers.

    Raises:
        BadInputError: it is none.
    """
    if not MAP_NAME.fullmatch(text):
        raise BadInputError(
            "bad_name",
            f"a map's name is 1 to 32 of a-z, 0-9, _ and -, beginning with a letter or digit, and a layer's is "
            f"MAP.LAYER, got {text[:80]!r}",
        )
    return text


def map_of_layer(name: str) -> str | None:
    """Name of the map of a layer's name MAP.LAYER; None for the name of a map."""
    whole, dot, _ = name.partition(".")
    return whole if dot else None


def robot_name(text: str) -> RobotName:
    """A checked name of a robot.

    Raises:
        BadInputError: not 1-32 of a-z, 0-9, `_`, `-`, or beginning with a sign.
    """
    if not NAME.fullmatch(text):
        raise BadInputError(
            "bad_name", f"a name is 1-32 of a-z 0-9 _ - and begins with a letter or digit, got {text[:64]!r}"
        )
    return RobotName(text)


def author_from_text(text: str) -> Author:
    """Author of a text `robot.incarnation`.

    Raises:
        BadInputError: the text is not of that form.
    """
    robot, _, incarnation = text[:80].partition(".")
    if not NAME.fullmatch(robot) or not INCARNATION.fullmatch(incarnation):
        raise BadInputError("bad_id", f"an author is written robot.incarnation (16 hex digits), got {text[:80]!r}")
    return Author(RobotName(robot), Incarnation(incarnation))


def commit_id_from_text(text: str) -> CommitId:
    """Commit id of a text `robot.incarnation.n`.

    Raises:
        BadInputError: the text is not of that form.
    """
    author, _, n = text[:96].rpartition(".")
    if not NUMBER.fullmatch(n):
        raise BadInputError("bad_id", f"a commit is written robot.incarnation.n, got {text[:96]!r}")
    return CommitId(author_from_text(author), int(n))
