"""Bag files and rosbag2 folders, opened by their names; each kind of file with its library."""

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from cairn_fusion.ros.bag import Bag, BagMessage, Topic
from cairn_map.errors import BadInputError, DamagedDataError

SUFFIXES = (".bag", ".db3", ".mcap")
PACKED_SUFFIXES = (".zst", ".zstd")
FILES_MAX = 4096
"""Largest number of files in a rosbag2 folder."""


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
        """Time at which the first message was recorded."""
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
    """True if a path is a bag by its name, or a folder with bags by the names in it."""
    return path.suffix in SUFFIXES if path.is_file() else path.is_dir() and bool(_files_of(path, SUFFIXES))


def open_bag(path: Path) -> Bag:
    """Bag in a file, or in a rosbag2 folder.

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
    """Bag in one file, which the stack closes."""
    bag = _bag_of(path)
    stack.callback(bag.close)
    return bag


def _bag_of(path: Path) -> Bag:
    if not path.is_file() or path.suffix not in SUFFIXES:
        raise BadInputError("no_bag", f"a bag's name must end in {', '.join(SUFFIXES)} and be there, got {path}")
    try:
        if path.suffix == ".mcap":
            from cairn_fusion.ros.mcap_bag import McapBag

            return McapBag(path)
        if path.suffix == ".db3":
            from cairn_fusion.ros.db3_bag import Db3Bag

            return Db3Bag(path)
        from cairn_fusion.ros.ros1_bag import Ros1Bag

        return Ros1Bag(path)
    except ModuleNotFoundError as exc:
        raise BadInputError("missing_extra", f'bags need {exc.name}: pip install "cairn-robotics[robot]"') from exc


def _files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    found = sorted(file for file in folder.iterdir() if file.suffix in suffixes and file.is_file())
    if len(found) > FILES_MAX:
        raise BadInputError("no_bag", f"{folder} must have at most {FILES_MAX} files, has {len(found)}")
    return found
