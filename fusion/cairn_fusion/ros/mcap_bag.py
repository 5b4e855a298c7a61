"""Bags in MCAP files (mcap.dev), with messages of ROS 1 or ROS 2.

Found by the index at the file's end, chunk by chunk; a chunk is unpacked into no more than it states. A file whose
writer died has no index: `mcap recover` makes one.
"""

import heapq
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import TypeVar

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Header, Schema, Statistics
from mcap.stream_reader import StreamReader

from cairn_fusion.ros.bag import CHUNK_BYTES_MAX, BagMessage, BoundedFile, Topic, UnpackedBytes, Wire, translate_damage
from cairn_fusion.ros.messages import plain_type
from cairn_map.errors import DamagedDataError

ADVICE = "`mcap recover FILE -o FIXED` (github.com/foxglove/mcap) saves what is whole"
FOOTER_BYTES = 9 + 20 + 8
"""Record head, footer, and the magic at the end."""
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
MESSAGE = 0x05
WAITING_BYTES_MAX = 512 << 20
"""Largest size of unpacked chunks that overlap in time: a message that waits keeps its chunk in memory."""
RECORDS_MAX = 1_000_000
"""Largest number of records in a chunk, and of messages that wait; chunks of 1 MB have some thousand."""
LOG_NS_MAX = 2**63 - 1
"""Latest time of a message, ns since 1970: the year 2262."""
Record = TypeVar("Record")


class WaitingMessages:
    """Messages of chunks that overlap in time, until no chunk can hold an earlier one."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, BagMessage]] = []
        self._count = 0
        self._waiting: dict[int, int] = {}
        """Messages that wait, by the place of their chunk."""
        self._size_bytes: dict[int, int] = {}

    def add(self, messages: Iterable[BagMessage], chunk: int, size_bytes: int) -> None:
        """Add the messages of the chunk at a place in the file.

        Raises:
            OverflowError: too much waits.
        """
        self._waiting[chunk], self._size_bytes[chunk] = 0, size_bytes
        for message in messages:
            heapq.heappush(self._heap, (message.log_ns, self._count, chunk, message))
            self._count += 1
            self._waiting[chunk] += 1
        self._forget(chunk)
        if len(self._heap) > RECORDS_MAX or sum(self._size_bytes.values()) > WAITING_BYTES_MAX:
            raise OverflowError("its messages lie too far out of order")

    def before(self, time_ns: int | None) -> Iterator[BagMessage]:
        """Messages recorded before a time, which wait no longer; None: all."""
        while self._heap and (time_ns is None or self._heap[0][0] < time_ns):
            _, _, chunk, message = heapq.heappop(self._heap)
            self._waiting[chunk] -= 1
            self._forget(chunk)
            yield message

    def _forget(self, chunk: int) -> None:
        """Forget a chunk that no message keeps."""
        if not self._waiting[chunk]:
            del self._waiting[chunk], self._size_bytes[chunk]


class McapBag:
    """MCAP file; see `bag.Bag`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, Topic] = {}
        self.start_ns = 0
        self._topic_of: dict[int, str] = {}
        self._chunks: list[ChunkIndex] = []
        self._unpacked = lru_cache(maxsize=2)(self._unpack)
        with translate_damage(path, McapError, advice=ADVICE):
            self._file = BoundedFile(path)
            try:
                self._read_index()
            except BaseException:
                self._file.close()
                raise

    def messages(self, topics: Collection[str], *, start_ns: int = 0) -> Iterator[BagMessage]:
        """Messages as `Bag.messages`; those of chunks that overlap in time are merged while they are read."""
        ids = {channel for channel, topic in self._topic_of.items() if topic in topics}
        waiting = WaitingMessages()
        unpacked, packed_left = UnpackedBytes(self._file.size_bytes), self._file.size_bytes
        for chunk in self._chunks:
            if chunk.message_end_time < start_ns or not _may_hold(chunk, ids):
                continue
            yield from waiting.before(chunk.message_start_time)
            with translate_damage(self.path, McapError, advice=ADVICE):
                data, packed = self._unpacked(chunk.chunk_start_offset)
                unpacked.add(len(data))
                packed_left -= packed
                if packed_left < 0:
                    raise ValueError("its chunks share their bytes")
                try:
                    waiting.add(self._messages_of(data, ids, start_ns), chunk.chunk_start_offset, len(data))
                except OverflowError as exc:
                    raise DamagedDataError("bad_bag", f"{self.path}: {exc}; `mcap sort FILE -o SORTED` helps") from exc
        yield from waiting.before(None)

    def close(self) -> None:
        """Close the file."""
        self._unpacked.cache_clear()
        self._file.close()

    def _read_index(self) -> None:
        self._file.seek(0)
        _first(Header, self._records(0, skip_magic=False))
        footer_at = self._file.seek(-FOOTER_BYTES, SEEK_END)
        summary_at = _first(Footer, self._records(footer_at)).summary_start
        if not 0 < summary_at < footer_at:
            raise EOFError("it has no index")
        channels: list[Channel] = []
        schemas: dict[int, Schema] = {}
        statistics: Statistics | None = None
        for record in self._records(summary_at).records:
            match record:
                case Channel():
                    channels.append(record)
                case Schema():
                    schemas[record.id] = record
                case ChunkIndex():
                    self._chunks.append(record)
                case Statistics():
                    statistics = record
                case Chunk():
                    raise ValueError("there is a chunk in the index")
                case _:
                    pass
        if statistics is None or (statistics.message_count and not self._chunks):
            raise EOFError("its index names no chunks")
        if len({chunk.chunk_start_offset for chunk in self._chunks}) < len(self._chunks):
            raise ValueError("its index names a chunk twice")
        self._chunks.sort(key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
        self.start_ns = statistics.message_start_time
        self._topic_of = {channel.id: channel.topic for channel in channels}
        for channel in channels:
            schema = schemas.get(channel.schema_id)
            count = statistics.channel_message_counts.get(channel.id, 0)
            self._add_topic(channel, plain_type(schema.name if schema else ""), count)

    def _add_topic(self, channel: Channel, name: str, count: int) -> None:
        wire = Wire(channel.message_encoding) if channel.message_encoding in list(Wire) else None
        known = self.topics.get(channel.topic)  # each publisher has a channel of its own
        if known is not None and (known.type, known.wire) != (name, wire):
            raise ValueError(f"{channel.topic} is {known.type} and {name}")
        self.topics[channel.topic] = Topic(channel.topic, name, wire, count + (known.count if known else 0))

    def _records(self, at: int, *, skip_magic: bool = True) -> StreamReader:
        self._file.seek(at)
        limit = CHUNK_BYTES_MAX
        return StreamReader(self._file, skip_magic=skip_magic, emit_chunks=True, record_size_limit=limit)

    def _messages_of(self, data: memoryview, ids: set[int], start_ns: int) -> Iterator[BagMessage]:
        at = count = 0
        while at < len(data):
            count += 1
            if count > RECORDS_MAX:
                raise ValueError(f"a chunk has more than {RECORDS_MAX} records")
            kind, size = RECORD_HEAD.unpack_from(data, at)
            at += RECORD_HEAD.size
            if size > len(data) - at:
                raise EOFError("a chunk ends within a record")
            if kind == MESSAGE:
                channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(data, at)
                if log_ns > LOG_NS_MAX:
                    raise ValueError(f"a message is of {log_ns} ns, later than any clock has")
                if channel in ids and log_ns >= start_ns:
                    yield BagMessage(self._topic_of[channel], log_ns, data[at + MESSAGE_HEAD.size : at + size])
            at += size

    def _unpack(self, at: int) -> tuple[memoryview, int]:
        """The records of the chunk at a place, and their size in the file."""
        chunk = _first(Chunk, self._records(at))
        size = chunk.uncompressed_size
        if size > CHUNK_BYTES_MAX:
            raise ValueError(f"a chunk of {size} bytes, at most {CHUNK_BYTES_MAX} are read")
        data = unpack(chunk.data, chunk.compression, size)
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError(f"the checksum of the chunk at byte {at} does not match")
        return memoryview(data), len(chunk.data)


def unpack(data: bytes, packing: str, size_bytes: int) -> bytes:
    """Unpack a chunk into exactly as many bytes as it states, never more than that in memory.

    Raises:
        ValueError: another packing, or another size.
    """
    if packing == "zstd":
        try:
            with zstandard.ZstdDecompressor().stream_reader(BytesIO(data)) as stream:
                whole = stream.read(size_bytes + 1)
        except zstandard.ZstdError as exc:
            raise ValueError(f"a chunk cannot be unpacked: {exc}") from exc
    elif packing == "lz4":
        whole = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size_bytes + 1)
    elif packing == "":
        whole = data
    else:
        raise ValueError(f"chunks are packed by {packing[:40]!r}; known are zstd and lz4")
    if len(whole) != size_bytes:
        raise ValueError(f"a chunk of {size_bytes} bytes unpacks to {len(whole)} or more")
    return whole


def _may_hold(chunk: ChunkIndex, ids: set[int]) -> bool:
    return not chunk.message_index_offsets or not ids.isdisjoint(chunk.message_index_offsets)


def _first(kind: type[Record], reader: StreamReader) -> Record:
    record = next(iter(reader.records), None)
    if not isinstance(record, kind):
        raise EOFError(f"a {kind.__name__.lower()} is expected, not {type(record).__name__}")
    return record
