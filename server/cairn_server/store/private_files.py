"""Files that must not be read by other users of the machine: tokens, private keys, the store and what lies next to it.

The server's own files are made for its user alone, whatever the umask. Those of an administrator are read as they are,
and a warning has the command that closes them: a secret that a container is handed is often readable by all who are in
the container, which is one user.
"""

import logging
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)

PRIVATE = 0o600
"""Mode of a file that its user alone may read and write."""
OTHERS = stat.S_IRWXO
"""Bits of the mode of a file that other users than its owner and its group have."""


def make_private(path: Path) -> None:
    """Make a file for this user alone, or close one that is there to all others."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE)
    os.close(descriptor)
    close_to_others(path)


def close_to_others(path: Path) -> None:
    """Take the rights of all other users on a file away, if it is there; another user's file is left with a warning."""
    try:
        if path.stat().st_mode & (stat.S_IRWXG | OTHERS):
            path.chmod(PRIVATE)
    except FileNotFoundError:
        return
    except PermissionError:
        log.warning("%s may be read by other users, and belongs to one: chown it to the server's user", path)


def give_to_owner(paths: Iterable[Path]) -> None:
    """Give files that root has made to the owner of their folder, whose server could not open them otherwise.

    A link, or a file that has another name, too, stays root's: the owner may have put it there.
    """
    if os.geteuid():
        return
    for path in paths:
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                found, owner = os.fstat(descriptor), path.parent.stat()
                if stat.S_ISREG(found.st_mode) and found.st_nlink == 1 and found.st_uid == 0:
                    os.fchown(descriptor, owner.st_uid, owner.st_gid)
            finally:
                os.close(descriptor)


def warn_if_open(path: Path) -> None:
    """Warn of a secret's file that any user of this machine may read or write; a pipe is no file."""
    mode = path.stat().st_mode
    if stat.S_ISREG(mode) and mode & OTHERS:
        log.warning(
            "%s has a secret, and any user of this machine may get at it (mode %03o): chmod 600 %s",
            path,
            stat.S_IMODE(mode),
            path,
        )
