"""One robot for one folder: an advisory lock that the operating system lets go when the process ends.

Two robots would give two commits the same number. A glance (`sqlite_glance`) needs no lock.
"""

import fcntl
import time
from pathlib import Path
from typing import BinaryIO

from cairn_map.errors import BadInputError, ConflictError

LOCK_NAME = "robot.lock"
LOOK_AGAIN_S = 0.02


def make_folder(folder: Path, *, secret_file: str) -> None:
    """Make a folder with a file that only its user can read: the robot's token and keys are in it.

    A new folder is its user's alone, too; one that was there may hold other things, and stays as open as it is.

    Raises:
        BadInputError: kind `bad_folder`: it is not there and cannot be made.
    """
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
        (folder / secret_file).touch()
        (folder / secret_file).chmod(0o600)
    except OSError as exc:
        raise BadInputError("bad_folder", f"cannot make the folder {folder}: {exc.strerror}") from exc


def lock_folder(folder: Path, *, wait_s: float) -> BinaryIO:
    """The lock on a folder, held until it is closed; waits so long for a robot that is just closing.

    Raises:
        ConflictError: kind `folder_in_use`: another robot works in this folder.
        BadInputError: kind `bad_folder`: nothing can be written there.
    """
    try:
        lock = (folder / LOCK_NAME).open("ab")
    except OSError as exc:
        raise BadInputError("bad_folder", f"cannot write in the folder {folder}: {exc.strerror}") from exc
    end_s = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as exc:
            if time.monotonic() > end_s:
                lock.close()
                raise ConflictError(
                    "folder_in_use", f"another robot has {folder} open; stop it, or choose another folder"
                ) from exc
            time.sleep(LOOK_AGAIN_S)
        else:
            return lock


def is_locked(folder: Path) -> bool:
    """True if a robot works in a folder now."""
    try:
        lock = (folder / LOCK_NAME).open("rb")
    except OSError:
        return False
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False
