"""Bags of ROS 1 (.bag) and of ROS 2 in SQLite (.db3), read by `rosbags`."""

import bz2
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import apsw
import lz4.frame
import zstandard
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.interfaces.typing import RPath
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as Error1
from rosbags.rosbag1.reader import Chunk, decompressors
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as Error2

from cairn_fusion.ros.bag import CHUNK_BYTES_MAX, BagMessage, BoundedFile, Topic, Wire, translate_damage
from cairn_fusion.ros.mcap_bag import unpack
from cairn_fusion.ros.messages import plain_type

ADVICE = "`rosbag reindex FILE` (ROS 1) or `ros2 bag reindex DIR` saves what is whole"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""A message packed by `ros2 bag record --compression-mode message`; plain CDR begins with a zero."""


@dataclass(frozen=True, slots=True)
class BoundedPath:
    """Path with the methods that the reader of ROS 1 bags uses; its file is a `BoundedFile`."""

    path: Path

    def exists(self) -> bool:
        """True if the file exists."""
        return self.path.exists()

    def open(self, *_: Any) -> BinaryIO:
        """The file, opened for reading."""
        return BoundedFile(self.path)


class BoundedReader1(Reader1):
    """A reader of ROS 1 bags that unpacks a chunk into `CHUNK_BYTES_MAX` at most."""

    def read_chunk(self) -> Chunk:
        """The next chunk's place, and how to unpack it."""
        chunk = super().read_chunk()
        known = {decompressors["bz2"]: _from_bz2, decompressors["lz4"]: _from_lz4}
        return chunk._replace(decompressor=known.get(chunk.decompressor, chunk.decompressor))


class RosbagsBag:
    """A .bag or .db3 file; see `bag.Bag`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader: Reader1 | Reader2
        with translate_damage(path, Error1, Error2, apsw.Error, advice=ADVICE):
            if path.suffix == ".bag":
                self._reader = BoundedReader1(cast(RPath, BoundedPath(path)))
            else:
                self._reader = Reader2(path.resolve())
            self._reader.open()
            try:
                self.start_ns = self._reader.start_time
                self.topics = {topic.name: topic for topic in self._topics()}
            except BaseException:
                self._reader.close()
                raise

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages as `Bag.messages`."""
        connections = [connection for connection in self._reader.connections if connection.topic in topics]
        if not connections:
            return
        with translate_damage(self.path, Error1, Error2, apsw.Error, advice=ADVICE):
            for connection, log_ns, data in self._reader.messages(connections, start=start_ns):
                yield BagMessage(connection.topic, log_ns, _plain(data))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _topics(self) -> Iterator[Topic]:
        for name, info in self._reader.topics.items():
            wires = {self._wire(connection) for connection in info.connections}
            wire = wires.pop() if len(wires) == 1 else None
            yield Topic(name, plain_type(info.msgtype or ""), wire, info.msgcount)

    def _wire(self, connection: Connection) -> Wire | None:
        if not isinstance(connection.ext, ConnectionExtRosbag2):
            return Wire.ROS1
        return Wire.CDR if connection.ext.serialization_format == "cdr" else None


def _plain(data: bytes) -> bytes:
    """A message as it was published."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    size = zstandard.get_frame_parameters(data).content_size
    if size > CHUNK_BYTES_MAX:
        raise ValueError(f"a message of {size} bytes, at most {CHUNK_BYTES_MAX} are read")
    return unpack(data, "zstd", size)


def _from_bz2(data: bytes) -> bytes:
    return _bounded(bz2.BZ2Decompressor().decompress(data, max_length=CHUNK_BYTES_MAX + 1))


def _from_lz4(data: bytes) -> bytes:
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=CHUNK_BYTES_MAX + 1))


def _bounded(data: bytes) -> bytes:
    if len(data) > CHUNK_BYTES_MAX:
        raise ValueError(f"a chunk unpacks to more than {CHUNK_BYTES_MAX} bytes")
    return data
