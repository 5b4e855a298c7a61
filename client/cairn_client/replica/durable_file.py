"""Small file of a robot's folder that a power cut leaves as it was before, or whole."""

import os
from pathlib import Path

from cairn_map.errors import UnreachableError

COMING = ".coming"
"""Ending of the name of a file that is not whole yet."""


def write_durable_file(path: Path, data: bytes) -> None:
    """Write or replace a file in one step, and make its folder if it is missing; durable on return.

    Raises:
        UnreachableError: kind `store_failed`: the disk is full or broken.
    """
    folder, coming = path.parent, path.with_name(path.name + COMING)
    try:
        folder.mkdir(0o700, parents=True, exist_ok=True)
        with coming.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        coming.replace(path)
        # The new name is on the disk only with its folder.
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as exc:
        raise UnreachableError("store_failed", f"cannot write to {folder}: {exc.strerror}") from exc
