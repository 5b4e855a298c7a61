"""A disk of a few megabytes that can be filled, and emptied again (Linux, as root)."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

CHUNK = bytes(1 << 14)


class TinyDisk:
    """A file system in memory."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / "filler"

    def fill(self) -> None:
        """Take all space that is left."""
        with self._filler.open("ab", buffering=0) as filler, suppress(OSError):
            while filler.write(CHUNK) == len(CHUNK):
                pass

    def make_room(self) -> None:
        """Give it back."""
        self._filler.unlink()


@contextmanager
def tiny_disk(folder: Path, size_mb: int) -> Iterator[TinyDisk]:
    """A disk for the length of a `with`; the test is skipped where none can be mounted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, timeout=10, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if done.returncode:
        pytest.skip(f"no file system can be mounted: {done.stderr.decode().strip()}")
    try:
        yield TinyDisk(folder)
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], timeout=10, check=True)
