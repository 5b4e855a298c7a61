"""Slow, obvious twins of commits, replies and version vectors (FORMAT.md 7, 9, 10)."""

import hashlib
import io
import struct
import zlib
from collections.abc import Iterable

from tests.naive.cell_code import decode_cell


def commit_parts(data: bytes) -> tuple[bytes, list[bytes], bytes]:
    """Meta, cell files and SHA-256 of a sound commit."""
    file = io.BytesIO(data)
    assert file.read(4) == b"CRCM"
    version = file.read(1)[0]
    assert version in (1, 2, 3)
    (meta_bytes,) = struct.unpack("<I", file.read(4))
    meta = file.read(meta_bytes)
    (count,) = struct.unpack("<I", file.read(4))
    cells = []
    for _ in range(count):
        if version == 2:
            assert file.read(1) == b"\0", "there is one layer"
        cells.append(file.read(*struct.unpack("<I", file.read(4))))
    assert not file.read()
    sha = hashlib.sha256(f"cairn-commit-{version}".encode() + struct.pack("<II", meta_bytes, count) + meta)
    for cell in cells:
        sha.update(decode_cell(cell)[0]["digest"])
    return meta, cells, sha.digest()


def frame_bodies(data: bytes) -> list[tuple[int, bytes]]:
    """(type, body) of each frame of a sound reply."""
    file = io.BytesIO(data)
    assert file.read(5) == b"CRNS\x01"
    frames: list[tuple[int, bytes]] = []
    while prefix := file.read(5):
        size, kind = struct.unpack("<IB", prefix)
        body = file.read(size)
        assert struct.unpack("<I", file.read(4)) == (zlib.crc32(prefix + body),)
        frames.append((kind, body))
    return frames


def ids_of_vector(value: dict[str, list[list[int]]]) -> set[tuple[str, int]]:
    """The plain set of (author, n) that a version vector in JSON stands for."""
    return {(author, n) for author, spans in value.items() for first, last in spans for n in range(first, last + 1)}


def vector_of_ids(ids: Iterable[tuple[str, int]]) -> dict[str, list[list[int]]]:
    """The version vector in JSON of a set of (author, n)."""
    vector: dict[str, list[list[int]]] = {}
    for author, n in sorted(ids):
        spans = vector.setdefault(author, [])
        if spans and spans[-1][1] == n - 1:
            spans[-1][1] = n
        else:
            spans.append([n, n])
    return vector
