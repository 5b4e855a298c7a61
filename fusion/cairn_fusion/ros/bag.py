"""Bag: messages that a robot with ROS recorded, one by one, from any file that ROS writes.

    FILE.bag                  ROS 1                              `ros1_bag`
    FILE.db3                  ROS 2, SQLite                      `db3_bag`
    FILE.mcap                 messages of ROS 1 or ROS 2         `mcap_bag`
    DIR with one or more .db3 or .mcap, as rosbag2 makes it      each file in turn

A bag may come from any source: no more bytes are read than the file has, no chunk is unpacked into more than
`CHUNK_BYTES_MAX`, and all chunks of one pass into no more than `UnpackedBytes` allows. The bag's own definitions of its
messages are not used (`messages`).
"""

import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from io import BufferedReader, FileIO
from pathlib import Path
from typing import NamedTuple, Protocol

from cairn_map.errors import BadInputError, CairnError, DamagedDataError

CHUNK_BYTES_MAX = 256 << 20
"""Largest unpacked chunk, and so the largest message; bags are recorded in chunks of about 1 MB."""
UNPACKED_PER_BYTE_MAX = 1000
UNPACKED_BYTES_MIN = 512 << 20
HELD_BYTES = 200
"""Memory that a message takes next to its data: objects of Python for itself, its bytes and its stamp."""
MESSAGES_MAX = 20_000_000
"""Largest number of messages; their times take 320 MB."""
FOREIGN_ERRORS: tuple[type[Exception], ...] = (
    *(struct.error, zlib.error, EOFError, OSError, AssertionError, MemoryError, RuntimeError),
    *(LookupError, TypeError, ValueError, OverflowError, AttributeError, RecursionError),
)
"""Errors that the libraries for bags raise on damaged files, in addition to their own."""


class Wire(StrEnum):
    """Serialisation of a message's fields."""

    ROS1 = "ros1"
    CDR = "cdr"
    """Serialisation of ROS 2."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str
    """`sensor_msgs/Image`, in this form for ROS 1 and ROS 2."""
    wire: Wire | None
    """Serialisation; None: neither of those of ROS."""
    count: int


class BagMessage(NamedTuple):
    """One message as it was recorded."""

    topic: str
    log_ns: int
    """Time of recording; the time of the measurement is in the message's header."""
    data: bytes | memoryview


class Bag(Protocol):
    """An open bag."""

    @property
    def path(self) -> Path:
        """The file or folder."""
        ...

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics by name."""
        ...

    @property
    def start_ns(self) -> int:
        """Time at which the first message was recorded."""
        ...

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages of some topics, recorded at a time or later, in order of recording.

        Raises:
            DamagedDataError: the file is damaged.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class UnpackedBytes:
    """Bytes unpacked in one pass over a file; a chunk counts each time that the pass comes to it.

    Chunks may name the same bytes, or take turns, so the size of one chunk bounds nothing. Images that hold nothing
    shrink to a hundredth; a file that names `UNPACKED_PER_BYTE_MAX` times its size was made to be slow.
    """

    def __init__(self, file_bytes: int) -> None:
        self._left = file_bytes * UNPACKED_PER_BYTE_MAX + UNPACKED_BYTES_MIN

    def add(self, size_bytes: int) -> None:
        """Count a chunk.

        Raises:
            ValueError: more than the file may unpack to.
        """
        self._left -= size_bytes
        if self._left < 0:
            raise ValueError(f"its chunks unpack to more than {UNPACKED_PER_BYTE_MAX} times the file's size")


class BoundedFile(BufferedReader):
    """File that refuses to read beyond its end, so that a false length costs no memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self.size_bytes = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes."""
        if size is not None and size > self.size_bytes - self.tell():
            raise EOFError(f"{size} bytes are expected at byte {self.tell()}, the file has {self.size_bytes}")
        return super().read(size)


@contextmanager
def translate_damage(path: Path, *foreign: type[Exception], advice: str) -> Iterator[None]:
    """Translate errors that a library raises on a damaged bag into `DamagedDataError` with the next step."""
    try:
        yield
    except CairnError:
        raise
    except PermissionError as exc:
        raise BadInputError("no_bag", f"{path} cannot be read: {exc.strerror}") from exc
    except (*foreign, *FOREIGN_ERRORS) as exc:
        said = str(exc) or type(exc).__name__
        raise DamagedDataError("bad_bag", f"{path} is damaged or ends early: {said[:300]}; {advice}") from exc
