"""Admission of keys: a robot's name on a map is bound to its first key, and another one needs a word for it.

    a name that is new                     nothing: the name is bound to the key
    a key that is admitted                 nothing else
    any other key                          a signature by an admitted key of the same name, an operator's word
                                           (`cairn map robots admit`), or an enrolment token that names the robot

One rule for commits, from any caller, and for registrations. A key goes by its incarnation, which follows from it
(`commits.signature`). A name of which no incarnation has proven a key yet is bound to its token alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.errors import DeniedError


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotKey:
    """An admitted incarnation of a robot, and the key that it follows from."""

    author: Author
    is_proven: bool
    """True once it signed something here: it is a key, and no mere number."""
    may_return: bool
    """True from an operator's word until the robot has registered by it."""
    since_s: float
    by: str
    """Name of the token that brought it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grounds:
    """Grounds on which somebody speaks for a robot."""

    signers: frozenset[Incarnation] = frozenset()
    """Incarnations whose valid signatures are shown."""
    is_own: bool = False
    """True if the caller shows the robot's own token."""
    has_word: bool = False
    """True if an admin, this server itself, or an enrolment token for this robot speaks."""
    is_return: bool = False
    """True if the caller shows no token, but a key that may return: that counts once."""
    by: str = ""
    """Name of the token that is shown."""


OWN_WORD = Grounds(has_word=True, by="server")
"""Grounds of what this server makes itself."""


def check_commit(author: Author, grounds: Grounds, known: Mapping[Incarnation, RobotKey]) -> None:
    """Refuse a commit by an author that is not admitted under a name that is known.

    Args:
        author: its author.
        grounds: what the caller shows.
        known: admitted keys of the author's robot.

    Raises:
        DeniedError: kind `not_admitted`.
    """
    if author.incarnation not in known:
        check_registration(author, grounds, known)


def check_registration(author: Author, grounds: Grounds, known: Mapping[Incarnation, RobotKey]) -> None:
    """Refuse a registration under a known name for which nothing speaks; arguments as of `check_commit`.

    Raises:
        DeniedError: kind `not_admitted`; kind `no_token`: the key returned already.
    """
    if grounds.is_return:
        if author.incarnation in known and known[author.incarnation].may_return:
            return
        raise DeniedError("no_token", f"{author} came back by its key already; an operator's word counts once")
    if not known or grounds.has_word or grounds.signers & known.keys():
        return
    if grounds.is_own and not any(key.is_proven for key in known.values()):
        return
    raise DeniedError(
        "not_admitted",
        f"{author.robot} is known on this map by another key. If {author} is the same robot with a new disk, an "
        f"operator says so: cairn map robots admit MAP_URL {author}",
    )
