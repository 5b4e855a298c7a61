"""Named byte streams, each compressed on its own, and read back under a cap.

    stream on disk:  id u8 | coding u8 (0 as it is, 1 zstd) | raw length u32 | stored length u32 | bytes

A column of integers becomes a stream of byte planes: `k u8`, then all lowest bytes, all second bytes, ... up to
the k-th; k is the least that holds the largest value, so a column has one form only.
"""

import struct
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import zstandard

from cairn_map.errors import BadInputError, DamagedDataError

ZSTD_LEVEL = 3
ZSTD_WINDOW_MAX = 1 << 23
HEAD = struct.Struct("<BBII")
STORED, ZSTD = 0, 1
RAW_BYTES_MAX = 1 << 28
"""Of all streams of a cell together: sixteen bytes for each voxel of the largest cell."""


def pack_streams(streams: Mapping[int, bytes]) -> bytes:
    """Streams in the order given, each with its head, compressed where that helps."""
    parts: list[bytes] = []
    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_content_size=False, write_checksum=False)
    for number, raw in streams.items():
        packed = compressor.compress(raw) if len(raw) > 16 else raw
        coding, body = (ZSTD, packed) if len(packed) < len(raw) else (STORED, raw)
        parts += [HEAD.pack(number, coding, len(raw), len(body)), body]
    return b"".join(parts)


def unpack_streams(data: bytes, *, count: int, raw_bytes_max: int = RAW_BYTES_MAX) -> dict[int, bytes]:
    """Exactly `count` streams that fill `data`; the mirror of `pack_streams`.

    Raises:
        DamagedDataError: cut off, left over, not rising in number, or not of the stated length.
        BadInputError: kind `too_large`: together they would be larger than `raw_bytes_max`.
    """
    streams: dict[int, bytes] = {}
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
        streams[number] = _raw(body, coding, raw_bytes, number)
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
    try:
        with zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW_MAX).stream_reader(data) as reader:
            raw = reader.read(size_bytes + 1)
    except zstandard.ZstdError as exc:
        raise DamagedDataError("bad_zstd", f"not a zstd stream: {exc}") from exc
    if len(raw) != size_bytes:
        raise DamagedDataError("bad_zstd", f"a zstd stream must hold {size_bytes} bytes, got {len(raw)} or more")
    return raw


def encode_column(words: npt.NDArray[np.uint64]) -> bytes:
    """Byte planes of (N,) uint64, lowest plane first, as many as the largest needs."""
    top = int(words.max()) if len(words) else 0
    planes = (top.bit_length() + 7) // 8
    columns = words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :planes]
    return bytes([planes]) + np.ascontiguousarray(columns.T).tobytes()


def decode_column(stream: bytes, *, rows: int) -> npt.NDArray[np.uint64]:
    """(rows,) uint64; the mirror of `encode_column`.

    Raises:
        DamagedDataError: the stream's length is not that of its planes.
    """
    planes = stream[0] if stream else 9
    if planes > 8 or len(stream) != 1 + planes * rows:
        raise DamagedDataError("bad_stream", f"a column of {rows} rows has {len(stream)} bytes for {planes} planes")
    columns = np.zeros((rows, 8), np.uint8)
    columns[:, :planes] = np.frombuffer(stream, np.uint8, offset=1).reshape(planes, rows).T
    words: npt.NDArray[np.uint64] = columns.view("<u8").reshape(rows).astype(np.uint64)
    return words


def _raw(body: bytes, coding: int, raw_bytes: int, number: int) -> bytes:
    if coding == ZSTD:
        return bounded_zstd(body, size_bytes=raw_bytes)
    if coding != STORED or len(body) != raw_bytes:
        raise DamagedDataError("bad_stream", f"stream {number} has an unknown coding {coding} or a false length")
    return body
