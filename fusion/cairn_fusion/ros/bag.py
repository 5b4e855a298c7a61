"""A bag: what a robot that speaks ROS recorded, message by message, out of any file that ROS writes.

    FILE.bag                  ROS 1                              bag_rosbags.py
    FILE.db3                  ROS 2, SQLite                      bag_rosbags.py
    FILE.mcap                 messages of ROS 1 or ROS 2         bag_mcap.py
    DIR with one or more .db3 or .mcap, as rosbag2 makes it      each file in turn

A bag may come from anybody: a file is asked for no more bytes than it has, and unpacked into no more than
`CHUNK_BYTES_MAX`. What the bag says of its messages' layout is not used (`ros_messages.py`).
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
"""Of one unpacked chunk, so of one message too; bags are recorded in chunks of about 1 MB."""
FOREIGN_ERRORS: tuple[type[Exception], ...] = (
    *(struct.error, zlib.error, EOFError, OSError, AssertionError, MemoryError, RuntimeError),
    *(LookupError, TypeError, ValueError, OverflowError, AttributeError, RecursionError),
)
"""What the libraries that read bags raise on damaged ones, beside their own errors."""


class Wire(StrEnum):
    """How a message's fields are put into bytes."""

    ROS1 = "ros1"
    CDR = "cdr"
    """Of ROS 2."""


@dataclass(frozen=True, slots=True)
class Topic:
    """What a bag says of one topic."""

    name: str
    type: str
    """`sensor_msgs/Image`, in this form for ROS 1 and ROS 2."""
    wire: Wire | None
    """None: an encoding that is none of ROS."""
    count: int


class BagMessage(NamedTuple):
    """One message as it was recorded."""

    topic: str
    log_ns: int
    """When it was recorded; the time that it speaks of is in its header."""
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
        """When the first message was recorded."""
        ...

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages of some topics that were recorded at a time or later, in this order.

        Raises:
            DamagedDataError: the file is damaged.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class BoundedFile(BufferedReader):
    """A file that is never asked for more than it has, so that a false length costs no memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self._size_bytes = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes."""
        if size is not None and size > self._size_bytes - self.tell():
            raise EOFError(f"{size} bytes are expected at byte {self.tell()}, the file has {self._size_bytes}")
        return super().read(size)


@contextmanager
def translate_damage(path: Path, *foreign: type[Exception], advice: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged bag into `DamagedDataError` with the next step."""
    try:
        yield
    except CairnError:
        raise
    except PermissionError as exc:
        raise BadInputError("no_bag", f"{path} cannot be read: {exc.strerror}") from exc
    except (*foreign, *FOREIGN_ERRORS) as exc:
        said = str(exc) or type(exc).__name__
        raise DamagedDataError("bad_bag", f"{path} is damaged or ends early: {said[:300]}; {advice}") from exc
