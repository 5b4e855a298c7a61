"""Bags of ROS 1 (.bag), their records parsed by `rosbags`; the index and the messages are read here.

The index is an array of 20 bytes a message, made of no more bytes than the file has: many chunks may name one index.
"""

import bz2
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, cast

import lz4.frame
import numpy as np
import numpy.typing as npt
from rosbags.interfaces.typing import RPath
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Chunk, Header, IndexData, RecordType, decompressors, read_bytes, read_uint32

from cairn_fusion.ros.bag import (
    CHUNK_BYTES_MAX,
    MESSAGES_MAX,
    BagMessage,
    BoundedFile,
    Topic,
    UnpackedBytes,
    Wire,
    translate_damage,
)
from cairn_fusion.ros.messages import plain_type

ADVICE = "`rosbag reindex FILE` saves what is whole"
ENTRY = np.dtype([("log_ns", "i8"), ("chunk", "i8"), ("offset", "u4")])
"""Place of a message: its chunk's place in the file, and its own in the unpacked chunk."""
ENTRIES_AT_ONCE = 1 << 16
CONNECTIONS_BEFORE_MAX = 8
"""Records of connections between the place that the index names and the message; writers put one there, or none."""


@dataclass(frozen=True, slots=True)
class BoundedPath:
    """Path with the methods that the reader of ROS 1 bags uses; its file is a `BoundedFile`."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """True if the file exists."""
        return self.path.exists()

    def open(self, *_: Any) -> BinaryIO:
        """The file, opened for reading."""
        return BoundedFile(self.path)


class BoundedReader(Reader):
    """A reader of ROS 1 bags that keeps its index small, and unpacks a chunk into `CHUNK_BYTES_MAX` at most."""

    def __init__(self, path: Path) -> None:
        super().__init__(cast(RPath, BoundedPath(path)))
        self.file_bytes = path.stat().st_size
        self._entries: dict[int, list[npt.NDArray[np.void]]] = {}
        self._count = self._index_bytes = 0

    def read_chunk(self) -> Chunk:
        """The next chunk's place, and how to unpack it."""
        chunk = super().read_chunk()
        known = {decompressors["bz2"]: _from_bz2, decompressors["lz4"]: _from_lz4}
        return chunk._replace(decompressor=known.get(chunk.decompressor, chunk.decompressor))

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Places of one connection's messages in the chunk at `pos`; `indexes` stays empty."""
        assert self.bio is not None  # noqa: S101 - the library opened it
        start = self.bio.tell()
        header = Header.read(self.bio, RecordType.IDXDATA)
        count, version = header.get_uint32("count"), header.get_uint32("ver")
        size = read_uint32(self.bio)
        if version != 1 or size != 12 * count:
            raise ValueError(f"an index of version {version} has {size} bytes for {count} messages")
        numbers = np.frombuffer(read_bytes(self.bio, size), "<u4").reshape(-1, 3)
        self._count += count
        self._index_bytes += self.bio.tell() - start
        if self._index_bytes > self.file_bytes or self._count > MESSAGES_MAX:
            raise ValueError(f"its chunks name the same index, or more than {MESSAGES_MAX} messages")
        entries = np.empty(count, ENTRY)
        entries["log_ns"] = numbers[:, 0].astype(np.int64) * 10**9 + numbers[:, 1]
        entries["chunk"], entries["offset"] = pos, numbers[:, 2]
        self._entries.setdefault(header.get_uint32("conn"), []).append(entries)

    def messages_of(self, ids: dict[int, str], start_ns: int) -> Iterator[BagMessage]:
        """Messages of the connections `ids`, named by their topics, in order of time; of one time in that of `ids`."""
        blocks = [block for connection in ids for block in self._entries.get(connection, [])]
        entries = np.concatenate([np.empty(0, ENTRY), *blocks])
        entries = entries[entries["log_ns"] >= start_ns]
        entries = entries[np.argsort(entries["log_ns"], kind="stable")]
        unpacked, last = UnpackedBytes(self.file_bytes), -1
        for first in range(0, len(entries), ENTRIES_AT_ONCE):
            for log_ns, chunk, offset in entries[first : first + ENTRIES_AT_ONCE].tolist():
                records = self._records_of(chunk)
                if chunk != last:
                    unpacked.add(records.getbuffer().nbytes)
                    last = chunk
                yield _message_at(records, offset, log_ns, ids)

    def _records_of(self, chunk: int) -> BytesIO:
        """The records of a chunk; the last one stays unpacked."""
        assert self.bio is not None  # noqa: S101 - open as long as the bag is
        if self.current_chunk[0] != chunk:
            self.bio.seek(self.chunks[chunk].datapos)
            packed = read_bytes(self.bio, self.chunks[chunk].datasize)
            self.current_chunk = (chunk, BytesIO(self.chunks[chunk].decompressor(packed)))
        return cast(BytesIO, self.current_chunk[1])


class Ros1Bag:
    """A .bag file; see `bag.Bag`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with translate_damage(path, ReaderError, advice=ADVICE):
            self._reader = BoundedReader(path)
            self._reader.open()
            try:
                self.start_ns = self._reader.start_time
                self.topics = {
                    name: Topic(name, plain_type(info.msgtype or ""), Wire.ROS1, info.msgcount)
                    for name, info in self._reader.topics.items()
                }
            except BaseException:
                self._reader.close()
                raise

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages as `Bag.messages`."""
        ids = {each.id: each.topic for each in self._reader.connections if each.topic in topics}
        with translate_damage(self.path, ReaderError, advice=ADVICE):
            yield from self._reader.messages_of(ids, start_ns)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


def _message_at(records: BytesIO, offset: int, log_ns: int, ids: dict[int, str]) -> BagMessage:
    """The message at a place of an unpacked chunk."""
    records.seek(offset)
    header, data = _record(records)
    # Connections may stand before their first message.
    for _ in range(CONNECTIONS_BEFORE_MAX - 1):
        if header.get_uint8("op") != RecordType.CONNECTION:
            break
        header, data = _record(records)
    if (
        header.get_uint8("op") != RecordType.MSGDATA
        or header.get_time("time") != log_ns
        or header.get_uint32("conn") not in ids
    ):
        raise ValueError(f"the index names a message at {log_ns / 1e9:.6f} s that is not at its place")
    return BagMessage(ids[header.get_uint32("conn")], log_ns, data)


def _record(records: BytesIO) -> tuple[Header, bytes]:
    """Header and data of the next record."""
    header = Header.read(records)
    return header, read_bytes(records, read_uint32(records))


def _from_bz2(data: bytes) -> bytes:
    return _bounded(bz2.BZ2Decompressor().decompress(data, max_length=CHUNK_BYTES_MAX + 1))


def _from_lz4(data: bytes) -> bytes:
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=CHUNK_BYTES_MAX + 1))


def _bounded(data: bytes) -> bytes:
    if len(data) > CHUNK_BYTES_MAX:
        raise ValueError(f"a chunk unpacks to more than {CHUNK_BYTES_MAX} bytes")
    return data
