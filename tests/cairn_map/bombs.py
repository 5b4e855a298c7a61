"""Small bytes that ask for much: memory, time, or a place outside an array. What an attacker would send.

`python -m tests.cairn_map.bombs` opens all of them and prints the peak of its memory in MB.
"""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard
from tests.cairn_map.made import KEY, ROBOT, made_cursor, made_meta

from cairn_map.codec.cell_code import decode_cell, encode_cell
from cairn_map.codec.octree.cell_head import CellHead, encode_head
from cairn_map.codec.octree.streams import HEAD as STREAM_HEAD
from cairn_map.codec.octree.streams import MODELLED
from cairn_map.commits.commit import HEAD as COMMIT_HEAD
from cairn_map.commits.commit_reading import open_commit
from cairn_map.errors import CairnError
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.evidence import empty_evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire.frames import frames_of, start_of_reply

DEEP = Geometry(depth=8, channels=())
COLOURS = tuple(Channel(kind=ChannelKind.COLOUR, name=f"c{n}") for n in range(16))
FULL = 8**8
U32 = (1 << 32) - 1


def stream(number: int, raw: bytes) -> bytes:
    packed = zstandard.ZstdCompressor(level=3, write_content_size=False).compress(raw)
    return STREAM_HEAD.pack(number, 1, len(raw), len(packed)) + packed


def head(geometry: Geometry, voxels: int, leaves: int, streams: int) -> bytes:
    return encode_head(
        CellHead(key=KEY, geometry=geometry, voxels=voxels, leaves=leaves, streams=streams, signed=False)
    )


def zeros_in_zstd(size_bytes: int) -> bytes:
    """1 GiB becomes 33 kB."""
    compressor = zstandard.ZstdCompressor(level=3).compressobj()
    part = bytes(1 << 20)
    return b"".join(compressor.compress(part) for _ in range(size_bytes >> 20)) + compressor.flush()


def frame_that_declares(size_bytes: int) -> bytes:
    """A zstd frame of one empty block whose head declares a content of that size."""
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", size_bytes) + b"\x01\x00\x00"


def one_stream(stored: bytes, raw_bytes: int, *, voxels: int = 1, leaves: int = 1) -> bytes:
    return head(DEEP, voxels, leaves, 4) + STREAM_HEAD.pack(1, 1, raw_bytes, len(stored)) + stored


def air(depth: int) -> tuple[Geometry, list[bytes]]:
    """Streams of a cell that is full of equal air: 8 leaves, 8^depth voxels."""
    return Geometry(depth=depth, channels=()), [b"\xff", b"\xff", b"\x00", b"\x01" + b"\x01" * 8]


def cell_of_air(cell: tuple[int, int, int], depth: int = 8) -> bytes:
    geometry, raws = air(depth)
    start = CellHead(key=cell_key(cell), geometry=geometry, voxels=8**depth, leaves=8, streams=4, signed=False)
    return encode_head(start) + b"".join(stream(n + 1, raw) for n, raw in enumerate(raws))


def cell_of_samples() -> bytes:
    """All of 2 M voxels have 16 colours of weight 1: 48 kB that stand for 1.1 GB."""
    geometry = Geometry(depth=7, channels=COLOURS)
    leaves = 8**7
    masks = sum(8**d for d in range(7))
    raws = {1: b"\xff" * masks, 2: bytes(masks - 8**6), 3: b"\x00", 4: b"\x00"}
    for c in range(16):
        raws[16 + 8 * c] = b"\xff" * (leaves // 8)
        raws[17 + 8 * c] = b"\x01" + b"\x01" * leaves
        raws |= {18 + 8 * c + p: b"\x00" for p in range(3)}
    return head(geometry, leaves, leaves, len(raws)) + b"".join(stream(n, raw) for n, raw in raws.items())


def modelled(group: dict[int, int], body: bytes) -> bytes:
    """Streams of one group, modelled, by their stated raw lengths."""
    first = min(group)
    return b"".join(
        STREAM_HEAD.pack(n, MODELLED, size, len(body) if n == first else 0) + (body if n == first else b"")
        for n, size in group.items()
    )


def modelled_air(masks: bytes, counts: bytes) -> bytes:
    """16 M leaves: their masks, if none are given under zstd, and counts that a model says in so many bytes."""
    child, leaf = (8**8 - 1) // 7, (8**7 - 1) // 7
    plain = stream(1, b"\xff" * child) + stream(2, bytes(leaf))
    topology = modelled({1: child, 2: leaf}, masks) if masks else plain
    return head(DEEP, FULL, FULL, 4) + topology + modelled({3: 1 + FULL, 4: 1 + FULL}, counts)


def commit_of(cells: list[bytes], geometry: Geometry = DEEP, *, count: int | None = None) -> bytes:
    meta = made_meta(geometry).model_dump_json(exclude_defaults=True).encode()
    body = b"".join(struct.pack("<I", len(cell)) + cell for cell in cells)
    return (
        COMMIT_HEAD.pack(b"CRCM", 1, len(meta))
        + meta
        + struct.pack("<I", len(cells) if count is None else count)
        + body
    )


def commit_of_dust() -> bytes:
    """One voxel in each brick of five cells: 2 MB of evidence that would be 700 MB once merged."""
    places = np.arange(0, FULL, 512, dtype=np.uint32)
    counts = np.stack([np.arange(len(places)) % 2, np.ones(len(places), np.int64)], axis=1)
    evidence = packed_evidence(places, counts, np.zeros((len(places), 0), np.int64), DEEP)
    return commit_of([encode_cell(cell_key((n, 0, 0)), evidence, DEEP).data for n in range(5)])


def commit_meta(text: str) -> bytes:
    return COMMIT_HEAD.pack(b"CRCM", 1, len(text)) + text.encode() + bytes(4)


def reply(kind: int, body: bytes) -> bytes:
    framed = struct.pack("<IB", len(body), kind) + body
    return start_of_reply() + framed + struct.pack("<I", zlib.crc32(framed))


def header(vector: str) -> bytes:
    return reply(1, ('{"to":"' + str(made_cursor()) + '","stable":{},"vector":' + vector + "}").encode())


def decode_small_cell(data: bytes) -> object:
    """As a reader of strangers' cells does."""
    return decode_cell(data, evidence_bytes_max=1 << 28)


Bomb = tuple[Callable[[bytes], object], Callable[[], bytes]]

BOMBS: dict[str, Bomb] = {
    "cell: zstd declares 7e18 bytes": (decode_cell, lambda: one_stream(frame_that_declares(7 * 10**18), 8)),
    "cell: zstd declares 7e18 bytes, so does the raw length": (
        decode_cell,
        lambda: one_stream(frame_that_declares(7 * 10**18), U32, voxels=FULL, leaves=FULL),
    ),
    "cell: 1 GiB of zeros, stated as 9 bytes": (decode_cell, lambda: one_stream(zeros_in_zstd(1 << 30), 9)),
    "cell: 1 GiB of zeros, stated truly": (decode_cell, lambda: one_stream(zeros_in_zstd(1 << 30), 1 << 30)),
    "cell: 1 GiB of zeros, stated as the most": (
        decode_cell,
        lambda: one_stream(zeros_in_zstd(1 << 30), 1 << 28, voxels=FULL, leaves=FULL),
    ),
    "cell: 16 M leaves in a head alone": (decode_cell, lambda: head(DEEP, FULL, FULL, 4)),
    "cell: 4 G voxels": (decode_cell, lambda: encode_cell(KEY, empty_evidence(DEEP), DEEP).data[:24] + b"\xff" * 10),
    "cell: 255 streams of 4 GiB": (
        decode_cell,
        lambda: head(DEEP, 1, 1, 255) + b"".join(STREAM_HEAD.pack(n, 0, U32, U32) for n in range(255)),
    ),
    "cell: 255 channels": (decode_cell, lambda: head(DEEP, 1, 1, 4)[:32] + b"\xff\xff" + b"\x01\x01\x00a" * 2000),
    "cell: masks without end": (
        decode_cell,
        lambda: (
            head(DEEP, FULL, FULL, 4) + stream(1, b"\xff" * (1 << 24)) + b"".join(stream(n, b"") for n in (2, 3, 4))
        ),
    ),
    "cell: 16 M leaves of which a model tells in 2 bytes": (decode_cell, lambda: modelled_air(b"", b"\1\2")),
    "cell: 2 M masks of which a model tells in 2 bytes": (decode_cell, lambda: modelled_air(b"\1\2", bytes(16384))),
    "cell: 2 M masks of which a model tells in just enough bytes": (
        decode_cell,
        lambda: modelled_air(bytes(2700), bytes(16384)),
    ),
    "cell: modelled masks of 4 GiB": (decode_cell, lambda: head(DEEP, 1, 1, 2) + modelled({1: U32, 2: U32}, b"\1")),
    "cell: a gigabyte of samples": (decode_small_cell, cell_of_samples),
    "commit: a gigabyte of samples": (
        open_commit,
        lambda: commit_of([cell_of_samples()], Geometry(depth=7, channels=COLOURS)),
    ),
    "commit: 4096 cells of air": (
        open_commit,
        lambda: commit_of([cell_of_air((n, 0, 0)) for n in range(4096)]),
    ),
    "commit: a voxel in every brick": (open_commit, commit_of_dust),
    "commit: 4 G cells": (open_commit, lambda: commit_of([], count=U32)),
    "commit: 4096 cells of 4 GiB": (open_commit, lambda: commit_of([], count=4096) + struct.pack("<I", U32) * 4096),
    "commit: 4 GiB of meta": (open_commit, lambda: COMMIT_HEAD.pack(b"CRCM", 1, U32)),
    "commit: 130 000 unknown fields": (
        open_commit,
        lambda: commit_meta("{" + ",".join(f'"{n:x}":0' for n in range(110_000)) + "}"),
    ),
    "commit: deep nesting": (open_commit, lambda: commit_meta('{"scans":' + "[" * 1_000_000)),
    "commit: a million brackets in a text": (open_commit, lambda: commit_meta('{"note":"' + "[" * 1_000_000 + '"}')),
    "commit: half a million poses": (open_commit, lambda: commit_meta('{"scans":[' + "0," * 500_000 + "0]}")),
    "reply: a frame of 4 GiB": (frames_of, lambda: start_of_reply() + struct.pack("<IB", U32, 4)),
    "reply: 4 G blocks": (frames_of, lambda: reply(3, bytes(105) + struct.pack("<I", U32))),
    "reply: wrong intervals": (frames_of, lambda: header('{"a":[' + '["x"],' * 690_000 + "[]]}")),
    "reply: wrong authors": (frames_of, lambda: header("{" + ",".join(f'"{n:x}":0' for n in range(400_000)) + "}")),
    "reply: unknown fields": (
        frames_of,
        lambda: reply(1, ("{" + ",".join(f'"{n:x}":0' for n in range(420_000)) + "}").encode()),
    ),
    "reply: a number of a million digits": (
        frames_of,
        lambda: header('{"' + ROBOT + '":[[0,1' + "0" * 1_000_000 + "]]}"),
    ),
    "reply: 300 000 empty intervals": (frames_of, lambda: header('{"a":[' + "[]," * 1_000_000 + "[]]}")),
}
"""Each is refused."""


def largest_commit() -> bytes:
    """Two cells of air are the most that fits a commit: 400 MB of evidence in 500 bytes, and sound."""
    return commit_of([cell_of_air((n, 0, 0)) for n in range(2)])


def peak_mb() -> int:
    """The most memory that this process ever had; `ru_maxrss` would count that of its parent too."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) >> 10 for line in lines if line.startswith("VmHWM"))


def main() -> list[str]:
    """Open every bomb; the names of those that were not refused."""
    opened: list[str] = []
    for name, (decode, made) in BOMBS.items():
        try:
            decode(made())
            opened.append(name)
        except CairnError:
            pass
    return opened


if __name__ == "__main__":
    decode_cell(encode_cell(KEY, empty_evidence(DEEP), DEEP).data)
    opened = main()
    assert not opened, opened
    print(peak_mb())  # noqa: T201
