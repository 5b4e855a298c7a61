"""Streams of a cell as they stand in its bytes, taken out, changed and put back."""

from collections.abc import Callable

import zstandard

from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.octree.cell_head import decode_head
from cairn_map.codec.octree.streams import HEAD, StoredStream, join_streams

GROUPS = {1: [1, 2], 3: [3, 4], 16: [16, 17, 18, 19, 20], 24: [24, 25, 26], 32: [32, 33, 34, 35], 40: [40, 41, 42]}
"""Of `made.SMALL`: each group's streams by the first."""


def bodies_of(data: bytes) -> dict[int, StoredStream]:
    """The streams of a cell as they are stored."""
    return cell_reader(data).stored


def with_streams(data: bytes, *changed: StoredStream) -> bytes:
    """The cell with these streams in the place of those with their numbers."""
    _, head = decode_head(data)
    streams = bodies_of(data) | {stream.number: stream for stream in changed}
    return head + join_streams(list(streams.values()))


def garbled(data: bytes, keep: Callable[[int], bool]) -> bytes:
    """The cell with other bytes, as many, in all streams but those to keep."""
    others = [stream for number, stream in bodies_of(data).items() if not keep(number)]
    return with_streams(data, *(stream._replace(body=bytes(b ^ 0x5A for b in stream.body)) for stream in others))


def recoded(data: bytes, *, level: int | None) -> bytes:
    """The same cell with streams compressed at another level, or not at all."""
    _, out = decode_head(data)
    for number, stream in bodies_of(data).items():
        raw = stream.raw()
        packed = raw if level is None else zstandard.ZstdCompressor(level=level, write_checksum=True).compress(raw)
        out += HEAD.pack(number, level is not None, len(raw), len(packed)) + packed
    return out
