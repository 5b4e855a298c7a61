"""Clouds in PCD files (Point Cloud Library, version 0.7): text, binary, or compressed by LZF.

    FIELDS x y z intensity      COUNT 1 1 1 1      WIDTH 1024      POINTS 65536
    SIZE 4 4 4 4                TYPE F F F F       HEIGHT 64       DATA ascii | binary | binary_compressed

Compressed data has all values of one field before those of the next.
"""

import struct

import numpy as np

from cairn_fusion.clouds.cloud_columns import Column, bad_cloud, check_count, text_columns
from cairn_fusion.clouds.lzf_kernels import decompress_into

HEAD_BYTES_MAX = 1 << 14
FIELDS_MAX = 64
NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
SIZES = struct.Struct("<II")


def read_pcd(data: bytes, name: str) -> dict[str, Column]:
    """The columns of a PCD file.

    Raises:
        BadInputError: kind `bad_cloud`: no such file, cut off, or points seen from another place than the origin.
    """
    head, body = _head(data, name)
    dtype = _dtype(head, name)
    count = _integer(head, "POINTS", name) if "POINTS" in head else _size(head, name)
    check_count(count, name)
    if (viewpoint := head.get("VIEWPOINT")) and tuple(map(_number, viewpoint)) != NO_VIEWPOINT:
        raise bad_cloud(
            name,
            f"VIEWPOINT is {' '.join(viewpoint)[:80]}: points must be in the sensor's frame, which 0 0 0 1 0 0 0 says; "
            "its pose belongs into the pose file",
        )
    kind = (head.get("DATA") or [""])[0]
    if kind == "ascii":
        columns = text_columns(body, dtype, count, name)
        return {key: columns[key] for key in _single(dtype)}
    if kind == "binary_compressed":
        body = _decompressed(body, count * dtype.itemsize, name)
    elif kind != "binary":
        raise bad_cloud(name, f"DATA {kind[:40]!r}: ascii, binary or binary_compressed is read")
    if len(body) < count * dtype.itemsize:
        raise bad_cloud(name, f"it is cut off: {count} points of {dtype.itemsize} bytes, {len(body)} bytes are there")
    if kind == "binary_compressed":
        return _by_field(body, dtype, count)
    points = np.frombuffer(body, dtype, count)
    return {key: points[key] for key in _single(dtype)}


def _head(data: bytes, name: str) -> tuple[dict[str, list[str]], memoryview]:
    """Words by keyword, and what follows the line DATA."""
    head: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in head:
        end = data.find(b"\n", at, HEAD_BYTES_MAX)
        if end < 0:
            raise bad_cloud(name, "it has no head with FIELDS, SIZE, TYPE and DATA, so it is no PCD file")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            head[words[0].upper()] = words[1:]
    return head, memoryview(data)[at:]


def _dtype(head: dict[str, list[str]], name: str) -> np.dtype[np.void]:
    """One point, a field of several values as a sub-array; fields named `_` are padding."""
    fields, sizes, types = head.get("FIELDS", []), head.get("SIZE", []), head.get("TYPE", [])
    counts = head.get("COUNT", ["1"] * len(fields))
    if not 0 < len(fields) == len(sizes) == len(types) == len(counts) <= FIELDS_MAX:
        raise bad_cloud(name, f"FIELDS, SIZE, TYPE and COUNT must have as many words, 1 to {FIELDS_MAX}")
    parts: list[tuple[str, str, tuple[int, ...]]] = []
    for n, (field, size, letter, several) in enumerate(zip(fields, sizes, types, counts, strict=True)):
        known = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}.get(letter.upper(), ())
        if size not in known or not several.isdecimal() or not 1 <= int(several) <= FIELDS_MAX * 16:
            raise bad_cloud(name, f"field {field[:40]!r}: no type {letter[:8]} of size {size[:8]}, count {several[:8]}")
        unique = f"_{n}" if field == "_" or field in fields[:n] else field
        parts.append((unique, f"<{letter.lower()}{size}", () if several == "1" else (int(several),)))
    return np.dtype(parts)


def _single(dtype: np.dtype[np.void]) -> list[str]:
    """Names of the fields that hold one value a point."""
    return [key for key in dtype.names or () if not key.startswith("_") and not dtype[key].shape]


def _decompressed(body: memoryview, wanted: int, name: str) -> memoryview:
    """The bytes of an LZF block whose size must be that of the points."""
    packed, size = SIZES.unpack_from(body) if len(body) >= SIZES.size else (0, -1)
    if size != wanted or packed > len(body) - SIZES.size:
        raise bad_cloud(
            name,
            f"it is cut off, or damaged: {wanted} bytes of points, {size} announced; {packed} of them compressed, "
            f"{max(0, len(body) - SIZES.size)} are there",
        )
    out = np.empty(size, np.uint8)
    if decompress_into(np.frombuffer(body, np.uint8, packed, SIZES.size), out) != size:
        raise bad_cloud(name, "its compressed points are damaged")
    return memoryview(out.tobytes())


def _by_field(body: memoryview, dtype: np.dtype[np.void], count: int) -> dict[str, Column]:
    """Columns that lie one after the other."""
    columns: dict[str, Column] = {}
    at = 0
    for key in dtype.names or ():
        if key in _single(dtype):
            columns[key] = np.frombuffer(body, dtype[key], count, at)
        at += dtype[key].itemsize * count
    return columns


def _size(head: dict[str, list[str]], name: str) -> int:
    return _integer(head, "WIDTH", name) * _integer(head, "HEIGHT", name)


def _integer(head: dict[str, list[str]], key: str, name: str) -> int:
    word = (head.get(key) or [""])[0]
    if not (word.isascii() and word.isdecimal() and len(word) <= 12):
        raise bad_cloud(name, f"{key} must be a whole number, got {word[:40]!r}")
    return int(word)


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return float("nan")
