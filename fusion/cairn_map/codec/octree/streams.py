"""Numbered byte streams, each compressed on its own, and decompressed under a limit (FORMAT.md sections 5 and 6).

    stored stream    number u8 | coding u8 | raw length u32 | stored length u32 | bytes
    coding           0 raw, 1 zstd, 2 modelled: held by the stored bytes of its group's first stream (`small_profile`)

A column of integers becomes a stream of byte planes: `k u8`, then all lowest bytes, all second bytes, ... up to
the k-th; k is the least that holds the largest value, so a column has one form only.
"""

import struct
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import zstandard

from cairn_map.errors import BadInputError, DamagedDataError

ZSTD_LEVEL = 3
ZSTD_WINDOW_MAX = 1 << 23
HEAD = struct.Struct("<BBII")
STORED, ZSTD, MODELLED = 0, 1, 2
_idle: deque[zstandard.ZstdDecompressor] = deque(maxlen=4)
"""Decompressors for reuse, with their windows: making one takes longer than decompressing a small stream. Each serves
one reader at a time."""
RAW_BYTES_MAX = 1 << 28
"""Raw bytes of all streams of a cell together, at most: sixteen for each voxel of the largest cell."""


class StoredStream(NamedTuple):
    """A stream of a cell's bytes, not decoded yet; `raw_bytes` is only a claim."""

    number: int
    coding: int
    raw_bytes: int
    body: bytes

    def raw(self) -> bytes:
        """Raw bytes of the stream.

        Raises:
            DamagedDataError: an unknown coding, or not the stated length.
        """
        if self.coding == ZSTD:
            return bounded_zstd(self.body, size_bytes=self.raw_bytes)
        if self.coding != STORED or len(self.body) != self.raw_bytes:
            raise DamagedDataError(
                "bad_stream", f"stream {self.number} has an unknown coding {self.coding} or a false length"
            )
        return self.body


def stored_streams(streams: Mapping[int, bytes | memoryview]) -> list[StoredStream]:
    """Streams in the order given, compressed where that helps."""
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_content_size=False, write_checksum=False)
    stored: list[StoredStream] = []
    for number, raw in streams.items():
        packed = compressor.compress(raw) if len(raw) > 16 else b""
        is_shorter = 0 < len(packed) < len(raw)
        body = packed if is_shorter else bytes(raw)
        stored.append(StoredStream(number, ZSTD if is_shorter else STORED, len(raw), body))
    return stored


def join_streams(streams: list[StoredStream]) -> bytes:
    """Streams with their heads, one after the other."""
    heads = [HEAD.pack(s.number, s.coding, s.raw_bytes, len(s.body)) for s in streams]
    return b"".join(part for head, stream in zip(heads, streams, strict=True) for part in (head, stream.body))


def split_streams(data: bytes, *, count: int, raw_bytes_max: int = RAW_BYTES_MAX) -> dict[int, StoredStream]:
    """Exactly `count` streams that fill `data`, by number; the mirror of `join_streams`.

    Raises:
        DamagedDataError: cut off, left over, or not rising in number.
        BadInputError: kind `too_large`: together they would be larger than `raw_bytes_max`.
    """
    streams: dict[int, StoredStream] = {}
    at = total = 0
    last = -1
    for _ in range(count):
        if at + HEAD.size > len(data):
            raise DamagedDataError("bad_stream", "streams are cut off")
        number, coding, raw_bytes, stored_bytes = HEAD.unpack_from(data, at)
        at += HEAD.size
        body = data[at : at + stored_bytes]
        at += stored_bytes
        total += raw_bytes
        if number <= last or len(body) < stored_bytes:
            raise DamagedDataError("bad_stream", f"stream {number} is cut off or out of order")
        if total > raw_bytes_max:
            raise BadInputError("too_large", f"these streams can hold at most {raw_bytes_max} bytes, they claim more")
        last = number
        streams[number] = StoredStream(number, coding, raw_bytes, body)
    if at != len(data):
        raise DamagedDataError("bad_stream", f"{len(data) - at} bytes are left over after the last stream")
    return streams


def bounded_zstd(data: bytes, *, size_bytes: int) -> bytes:
    """Decompress exactly `size_bytes`, whatever the frame's own header claims.

    `ZstdDecompressor.decompress(max_output_size=...)` obeys the size that the frame declares instead of the
    limit, so a 33 kB body could become 1 GiB. Reading as a stream stops at the limit.

    Raises:
        DamagedDataError: not zstd, shorter, or longer.
    """
    raw = zstd_prefix(data, size_bytes=size_bytes + 1)
    if len(raw) != size_bytes:
        raise DamagedDataError("bad_zstd", f"a zstd stream must hold {size_bytes} bytes, got {len(raw)} or more")
    return raw


def zstd_prefix(data: bytes, *, size_bytes: int) -> bytes:
    """The first `size_bytes` of a zstd frame's content, or all of it if that is less.

    Raises:
        DamagedDataError: not zstd.
    """
    try:
        decompressor = _idle.pop()
    except IndexError:
        decompressor = zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW_MAX)
    try:
        with decompressor.stream_reader(data) as reader:
            return reader.read(size_bytes)
    except zstandard.ZstdError as exc:
        raise DamagedDataError("bad_zstd", f"not a zstd stream: {exc}") from exc
    finally:
        _idle.append(decompressor)


def required(streams: Mapping[int, bytes], number: int) -> bytes:
    """Stream of a number.

    Raises:
        DamagedDataError: the stream is missing.
    """
    try:
        return streams[number]
    except KeyError:
        raise DamagedDataError("bad_stream", f"stream {number} is missing") from None


def encode_column(words: npt.NDArray[np.uint64]) -> bytes:
    """Column of (N,) uint64: its byte planes, lowest first, as many as the largest number needs."""
    top = int(words.max()) if len(words) else 0
    planes = (top.bit_length() + 7) // 8
    return bytes([planes]) + b"".join((words >> np.uint64(8 * p)).astype(np.uint8).tobytes() for p in range(planes))


def column_planes(stream: bytes, *, rows: int) -> npt.NDArray[np.uint8]:
    """(k, rows) planes of a column, lowest first, k from 0 to 8; nothing is copied.

    Raises:
        DamagedDataError: the stream's length is not that of its planes.
    """
    planes = stream[0] if stream else 9
    if planes > 8 or len(stream) != 1 + planes * rows:
        raise DamagedDataError("bad_stream", f"a column of {rows} rows has {len(stream)} bytes for {planes} planes")
    return np.frombuffer(stream, np.uint8, offset=min(1, len(stream) - 1))[: planes * rows].reshape(planes, rows)


def words_of_planes(planes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint64]:
    """(rows,) numbers of the planes of `column_planes`; the mirror of `encode_column`."""
    words = np.zeros(planes.shape[1], np.uint64)
    for p, plane in enumerate(planes):
        words |= plane.astype(np.uint64) << np.uint64(8 * p)
    return words
