"""Cold bytes: cells and evidence that left the database for an object store.

    cells/MAP/CELL/LM.DIGEST.NONCE     stamps and bytes of a cell at rest
    segments/MAP/NONCE                 evidence of many commits, one piece after the other

An object is written once and never changed, and its name is never used again. So a reader that took a name from one
state of the map gets the bytes of that state, however long ago its transaction ended.
"""

import secrets
import struct
from typing import Protocol

from cairn_map.errors import UnreachableError

HEAD = struct.Struct("<Q")
"""Head of a cell's object: size of its bytes, which come before its stamps."""
MARK = "cairn-store"
"""Object that says which store's bytes are next to it."""
OWNER = "cairn-owner"
"""Object that says which database of this store works on them."""
NONCE_BYTES = 8
RETRY_S = 5.0
"""Seconds after which a client may ask again for what an object store did not give."""


class AwayError(UnreachableError):
    """Cold bytes that cannot be read or written now: the object store does not answer."""

    def __init__(self, message: str) -> None:
        super().__init__("objects_away", message, retry_after_s=RETRY_S)

    def __reduce__(self) -> tuple[type["AwayError"], tuple[str]]:  # type: ignore[override]
        return type(self), (self.message,)


class ColdReads(Protocol):
    """Reads of an object store; every method may be called from any thread."""

    def get(self, name: str) -> bytes | None:
        """An object's bytes; None: there is no such object.

        Raises:
            AwayError: the store does not answer.
        """
        ...

    def part(self, name: str, *, start: int, size_bytes: int) -> bytes | None:
        """Bytes of an object from `start` on; None: there is no such object, or it is shorter.

        Raises:
            AwayError: the store does not answer.
        """
        ...


class NoObjects:
    """`ColdReads` of a store without an object store; no row of it names an object."""

    def get(self, name: str) -> bytes | None:
        """Nothing.

        Raises:
            AwayError: in any case.
        """
        raise AwayError(f"this server was started without --objects, where {name} is")

    def part(self, name: str, *, start: int, size_bytes: int) -> bytes | None:
        """Nothing.

        Raises:
            AwayError: in any case.
        """
        return self.get(name)


def cell_name(map_number: int, key: int, *, lm: int, digest: bytes) -> str:
    """A fresh name for the object of a cell."""
    return f"cells/{map_number}/{key}/{lm}.{digest.hex()}.{secrets.token_hex(NONCE_BYTES)}"


def segment_name(map_number: int) -> str:
    """A fresh name for a segment."""
    return f"segments/{map_number}/{secrets.token_hex(2 * NONCE_BYTES)}"


def cell_object(body: bytes, stamps: bytes) -> bytes:
    """Bytes of a cell's object."""
    return HEAD.pack(len(body)) + body + stamps


def split_cell_object(data: bytes | None) -> tuple[bytes, bytes]:
    """Bytes and stamps of a cell, from its object; empty if that is lost or cut, which is found when they are read."""
    if data is None or len(data) < HEAD.size:
        return b"", b""
    end = HEAD.size + HEAD.unpack_from(data)[0]
    return data[HEAD.size : end], data[end:]
