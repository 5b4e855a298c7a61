"""Admission of robots' keys to a map in memory."""

import time
from dataclasses import replace

from cairn_map.commits.ids import SERVERS_OWN, Author, Incarnation
from cairn_server.store.admission import Grounds, RobotKey, check_commit, check_registration

Keys = dict[Author, RobotKey]


def admit_commit(keys: Keys, author: Author, grounds: Grounds) -> None:
    """Admit the author of a new commit, or refuse it."""
    if author.robot in SERVERS_OWN:
        return
    check_commit(author, grounds, known(keys, author.robot))
    put_key(keys, author, is_proven=author.incarnation in grounds.signers, by=grounds.by)


def admit_registration(keys: Keys, author: Author, grounds: Grounds) -> None:
    """Admit a registration, or refuse it."""
    check_registration(author, grounds, known(keys, author.robot))
    put_key(keys, author, is_proven=author.incarnation in grounds.signers, by=grounds.by)
    for other, key in keys.items():
        if other.robot == author.robot:
            keys[other] = replace(key, may_return=False)


def known(keys: Keys, robot: str) -> dict[Incarnation, RobotKey]:
    """Admitted keys of a robot."""
    return {author.incarnation: key for author, key in keys.items() if author.robot == robot}


def put_key(keys: Keys, author: Author, *, is_proven: bool = False, may_return: bool = False, by: str) -> None:
    key = keys.get(author)
    if key is None:
        key = RobotKey(author=author, is_proven=is_proven, may_return=may_return, since_s=time.time(), by=by)
    keys[author] = replace(key, is_proven=key.is_proven or is_proven, may_return=key.may_return or may_return)
