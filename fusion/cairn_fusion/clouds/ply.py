"""Clouds in PLY files (Stanford): the element `vertex` of a text or binary file; what follows it is not read."""

from dataclasses import dataclass, field

import numpy as np

from cairn_fusion.clouds.cloud_columns import Column, bad_cloud, check_count, text_columns

HEAD_BYTES_MAX = 1 << 14
PROPERTIES_MAX = 128
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    """Name and NumPy type."""
    has_list: bool = False


def read_ply(data: bytes, name: str) -> dict[str, Column]:
    """The columns of a PLY file's vertices.

    Raises:
        BadInputError: kind `bad_cloud`: no such file, cut off, or vertices of no fixed size.
    """
    order, elements, at = _head(data, name)
    before = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise bad_cloud(name, "it has no element vertex")
    if element.has_list or any(one.has_list for one in before):
        raise bad_cloud(name, "lists in, or before, its vertices are not read")
    check_count(element.count, name)
    dtype = _dtype(element, order, name)
    body = memoryview(data)[at:]
    if order == "=":
        return text_columns(body, dtype, element.count, name, skipped=sum(one.count for one in before))
    skipped = sum(_dtype(one, order, name).itemsize * one.count for one in before)
    if len(body) < skipped + element.count * dtype.itemsize:
        raise bad_cloud(
            name,
            f"it is cut off: {element.count} points of {dtype.itemsize} bytes are announced, "
            f"{max(0, len(body) - skipped)} bytes are there",
        )
    points = np.frombuffer(body, dtype, element.count, skipped)
    return {key: points[key] for key in dtype.names or ()}


def _head(data: bytes, name: str) -> tuple[str, list[_Element], int]:
    """Byte order (`=` for text), elements, and the place where the first begins."""
    end = data.find(b"end_header", 0, HEAD_BYTES_MAX)
    stop = data.find(b"\n", end, HEAD_BYTES_MAX) if end >= 0 else -1
    if not data.startswith(b"ply") or stop < 0:
        raise bad_cloud(name, "it has no head from ply to end_header, so it is no PLY file")
    order = ""
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", kind, *_] if kind in ORDERS:
                order = ORDERS[kind]
            case ["element", element, count] if count.isdecimal() and len(count) <= 12:
                elements.append(_Element(element, int(count)))
            case ["property", "list", *_] if elements:
                elements[-1].has_list = True
            case ["property", kind, key] if elements and kind in TYPES:
                elements[-1].properties.append((key, TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise bad_cloud(name, f"its head has the line {line[:80]!r}, which is not read")
    if not order:
        raise bad_cloud(name, f"its head names no format: {', '.join(ORDERS)} are read")
    return order, elements, stop + 1


def _dtype(element: _Element, order: str, name: str) -> np.dtype[np.void]:
    names = [key for key, _ in element.properties]
    if len(set(names)) != len(names) or len(names) > PROPERTIES_MAX:
        raise bad_cloud(name, f"properties of {element.name[:40]} must have different names, at most {PROPERTIES_MAX}")
    return np.dtype([(key, order + letter) for key, letter in element.properties])
