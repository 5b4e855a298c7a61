"""MATLAB's MAT-files of level 5 (save -v6, -v7): numeric arrays, text, and cells of text, by name.

    128 bytes: text, version, byte order | element | element ...       element: type, size, data, to 8 bytes
    miCOMPRESSED holds another element; miMATRIX holds flags, dimensions, name, data

After "MAT-File Level 5 File Format" of The MathWorks. Objects, structures and sparse arrays are left out. Files of
-v7.3 are HDF5 and are refused.
"""

import struct
import zlib
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.generic]

HEADER_BYTES, VERSION_AT = 128, 124
COMPRESSED, MATRIX = 15, 14
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1", 17: "u2"}
"""NumPy's types of elements, by their number; 16 and 17 are text in UTF-8 and UTF-16."""
CELL, CHAR = 1, 4
NUMERIC = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""NumPy's types of arrays, by their class; data are often stored as a smaller type."""
COMPLEX = 0x0800
BYTES_MAX = 256 << 20
"""Largest element once it is decompressed."""
DIMENSIONS_MAX = 8
CELLS_MAX = 100_000


def read_mat(data: bytes) -> dict[str, Array | list[str]]:
    """Arrays as MATLAB shapes them, texts and cells of texts as lists, by name.

    Raises:
        ValueError: it is no such file, or is damaged; the message says what to do.
    """
    if data[:10] == b"MATLAB 7.3" or data[:8] == b"\x89HDF\r\n\x1a\n" or data[512:520] == b"\x89HDF\r\n\x1a\n":
        raise ValueError("it was saved with -v7.3: save it again with -v7")
    if len(data) < HEADER_BYTES or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is no MAT-file of level 5")
    order = "<" if data[126:128] == b"IM" else ">"
    found: dict[str, Array | list[str]] = {}
    try:
        for kind, body in _elements(data[HEADER_BYTES:], order):
            if kind == COMPRESSED:
                for inner, matrix in _elements(_inflated(body), order):
                    _add(found, inner, matrix, order)
            else:
                _add(found, kind, body, order)
    except (struct.error, IndexError, zlib.error, UnicodeDecodeError, TypeError) as exc:
        raise ValueError(f"it is damaged or cut off ({exc})") from exc
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            # A small element: type and size share four bytes, four of data follow.
            kind, size = kind & 0xFFFF, kind >> 16
            if size > 4:
                raise struct.error("a small element of more than four bytes")
            yield kind, data[at + 4 : at + 4 + size]
            at += 8
            continue
        body = data[at + 8 : at + 8 + size]
        if len(body) < size:
            raise struct.error(f"an element of {size} bytes has {len(body)}")
        yield kind, body
        # Compressed elements are not padded.
        at += 8 + size + (0 if kind == COMPRESSED else -size % 8)


def _inflated(body: bytes) -> bytes:
    inflater = zlib.decompressobj()
    data = inflater.decompress(body, BYTES_MAX)
    if inflater.unconsumed_tail:
        raise ValueError(f"a variable is larger than {BYTES_MAX >> 20} MiB")
    return data


def _add(found: dict[str, Array | list[str]], kind: int, body: bytes, order: str) -> None:
    if kind == MATRIX and body:
        name, value = _matrix(body, order)
        if value is not None:
            found[name] = value


def _matrix(body: bytes, order: str) -> tuple[str, Array | list[str] | None]:
    """Name and value of a variable; None for kinds that are left out."""
    parts = list(_elements(body, order))
    if len(parts) < 3:
        raise struct.error("an array without name")
    flags = int(np.frombuffer(parts[0][1], f"{order}u4")[0])
    shape = [int(side) for side in np.frombuffer(parts[1][1], f"{order}i4")]
    name, kind = parts[2][1].decode("latin-1"), flags & 0xFF
    if not 2 <= len(shape) <= DIMENSIONS_MAX or min(shape) < 0:
        raise struct.error(f"an array of shape {shape}")
    if kind == CELL and len(parts) - 3 <= CELLS_MAX:
        cells = [_matrix(inner, order)[1] for number, inner in parts[3:] if number == MATRIX and inner]
        texts = [each[0] for each in cells if isinstance(each, list) and len(each) == 1]
        return name, texts if len(texts) == len(cells) else None
    if kind != CHAR and (kind not in NUMERIC or flags & COMPLEX):
        return name, None
    stored, raw = parts[3] if len(parts) > 3 else (1, b"")
    values = np.frombuffer(raw, order + TYPES.get(stored, "u1"))
    if values.size != np.prod(shape, dtype=object):
        raise struct.error(f"{name} has {values.size} values of shape {shape}")
    if kind == CHAR:
        # A text is one row of characters; several rows are none here.
        return name, ["".join(map(chr, values.astype(np.uint32).tolist()))] if shape[0] <= 1 else None
    return name, values.astype(NUMERIC[kind]).reshape(shape, order="F")
