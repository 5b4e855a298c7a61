"""Views of cells in a file beside the store, so that a server that was just started need not make them again.

    head     "cairn views 1" and a line feed; the number is that of the views' own coding
    each     name's length u16, view's length u32; name, view; CRC-32 of all these u32; little-endian

Nothing is lost with the file: what cannot be read of it is made anew from the store.
"""

import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from cairn_map.codec.view_code import VERSION

NAME = "views.cache"
HEAD = f"cairn views {VERSION}\n".encode()
LENGTHS = struct.Struct("<HI")
CHECKSUM = struct.Struct("<I")


def write_views(folder: Path, views: Mapping[str, bytes]) -> None:
    """Replace a folder's file.

    Raises:
        OSError: it cannot be written; the older one is as it was, and what was written is away: the disk may be full.
    """
    partial = folder / f"{NAME}.partial"
    try:
        with partial.open("wb") as file:
            file.write(HEAD)
            for name, data in views.items():
                text = name.encode()
                entry = LENGTHS.pack(len(text), len(data)) + text + data
                file.write(entry + CHECKSUM.pack(zlib.crc32(entry)))
        partial.replace(folder / NAME)
    except OSError:
        with suppress(OSError):
            partial.unlink()
        raise


def read_views(folder: Path) -> dict[str, bytes]:
    """What a folder's file has, up to the first byte that is not as it was written; nothing without a file."""
    try:
        data = (folder / NAME).read_bytes()
    except OSError:
        return {}
    views: dict[str, bytes] = {}
    at = len(HEAD)
    while data.startswith(HEAD) and at + LENGTHS.size <= len(data):
        name_bytes, view_bytes = LENGTHS.unpack_from(data, at)
        name_at = at + LENGTHS.size
        view_at = name_at + name_bytes
        end = view_at + view_bytes
        if data[end : end + CHECKSUM.size] != CHECKSUM.pack(zlib.crc32(data[at:end])):
            break
        views[data[name_at:view_at].decode()] = data[view_at:end]
        at = end + CHECKSUM.size
    return views
