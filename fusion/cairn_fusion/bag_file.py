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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from io import BufferedReader, FileIO
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Protocol

from cairn_map.errors import BadInputError, CairnError, DamagedDataError

CHUNK_BYTES_MAX = 256 << 20
"""Of one unpacked chunk, so of one message too; bags are recorded in chunks of about 1 MB."""
SUFFIXES = (".bag", ".db3", ".mcap")
PACKED_SUFFIXES = (".zst", ".zstd")
FILES_MAX = 4096
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


@dataclass(frozen=True, slots=True)
class JoinedBag:
    """The files of one rosbag2 folder, each recorded after the one before."""

    path: Path
    files: tuple[Bag, ...]

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics by name, their messages counted over all files."""
        topics: dict[str, Topic] = {}
        for topic in chain.from_iterable(file.topics.values() for file in self.files):
            known = topics.get(topic.name)
            if known is not None and (known.type, known.wire) != (topic.type, topic.wire):
                raise DamagedDataError("bad_bag", f"{self.path}: {topic.name} is {known.type} and {topic.type}")
            count = topic.count + (known.count if known else 0)
            topics[topic.name] = Topic(topic.name, topic.type, topic.wire, count)
        return topics

    @property
    def start_ns(self) -> int:
        """When the first message was recorded."""
        return self.files[0].start_ns

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """As `Bag.messages`."""
        ends_ns = [*(file.start_ns for file in self.files[1:]), None]
        for file, end_ns in zip(self.files, ends_ns, strict=True):
            if end_ns is None or end_ns >= start_ns:
                yield from file.messages(topics, start_ns=start_ns)

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.close()


def is_bag(path: Path) -> bool:
    """Whether a path is a bag by its name, or a folder by the names in it."""
    return path.suffix in SUFFIXES if path.is_file() else path.is_dir() and bool(_files_of(path, SUFFIXES))


def open_bag(path: Path) -> Bag:
    """The bag in a file, or in a rosbag2 folder.

    Raises:
        BadInputError: no bag, packed as a whole, or the libraries that read bags are not installed.
        DamagedDataError: it cannot be read; the message says what may help.
    """
    if not path.is_dir():
        return _bag_of(path)
    if packed := _files_of(path, PACKED_SUFFIXES):
        raise BadInputError(
            "packed_bag", f"{packed[0]} is packed as a whole; unpack it with `zstd -d --rm`, and try again"
        )
    with ExitStack() as stack:
        files = [_open_file(file, stack) for file in _files_of(path, SUFFIXES)]
        if not files:
            raise BadInputError("no_bag", f"{path} has no file that ends in {', '.join(SUFFIXES)}")
        joined = JoinedBag(path, tuple(sorted(files, key=lambda file: file.start_ns)))
        _ = joined.topics
        stack.pop_all()
    return joined if len(files) > 1 else files[0]


def _open_file(path: Path, stack: ExitStack) -> Bag:
    """One file, which the stack closes."""
    bag = _bag_of(path)
    stack.callback(bag.close)
    return bag


def _bag_of(path: Path) -> Bag:
    if not path.is_file() or path.suffix not in SUFFIXES:
        raise BadInputError("no_bag", f"a bag's name must end in {', '.join(SUFFIXES)} and be there, got {path}")
    try:
        if path.suffix == ".mcap":
            from cairn_fusion.bag_mcap import McapBag

            return McapBag(path)
        from cairn_fusion.bag_rosbags import RosbagsBag

        return RosbagsBag(path)
    except ModuleNotFoundError as exc:
        raise BadInputError("missing_extra", f'bags need {exc.name}: pip install "cairn-robotics[robot]"') from exc


def _files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    found = sorted(file for file in folder.iterdir() if file.suffix in suffixes and file.is_file())
    if len(found) > FILES_MAX:
        raise BadInputError("no_bag", f"{folder} must have at most {FILES_MAX} files, has {len(found)}")
    return found


@contextmanager
def damage_told(path: Path, *foreign: type[Exception], advice: str) -> Iterator[None]:
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
