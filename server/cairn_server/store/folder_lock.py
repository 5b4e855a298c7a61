"""Lock of a data folder for one server: advisory, and released by the operating system when the process ends.

SQLite itself would let two servers share the file, but each would take its cache of cells for the newest.
"""

import fcntl
import logging
from pathlib import Path
from typing import BinaryIO

from cairn_map.errors import ConflictError

log = logging.getLogger(__name__)

LOCK_NAME = "cairn.lock"
"""Name of the lock file; its text is the port of the server that holds it, or held it last."""


def lock_folder(folder: Path) -> BinaryIO:
    """The lock on a folder, held until it is closed.

    Raises:
        ConflictError: kind `store_in_use`: another server works on this folder.
    """
    lock = (folder / LOCK_NAME).open("ab")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as exc:
        lock.close()
        raise ConflictError(
            "store_in_use", f"another server works on {folder}; stop it, or choose another --data folder"
        ) from exc
    return lock


def tell_port(folder: Path, port: int) -> None:
    """Write down the port of a locked folder's server, for health checks."""
    try:
        (folder / LOCK_NAME).write_text(f"{port}\n")
    except OSError as exc:  # a full disk
        log.warning("the health check cannot know the port: %s", exc)


def told_port(folder: Path) -> int | None:
    """Port of a folder's server; None if it is not written down."""
    try:
        return int((folder / LOCK_NAME).read_text())
    except (OSError, ValueError):
        return None
