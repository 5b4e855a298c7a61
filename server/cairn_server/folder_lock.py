"""One server for one data folder: an advisory lock that the operating system lets go when the process ends.

SQLite itself would let two servers share the file, but each believes that its cache of cells is the newest.
"""

import fcntl
from pathlib import Path
from typing import BinaryIO

from cairn_map.errors import ConflictError

LOCK_NAME = "cairn.lock"


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
