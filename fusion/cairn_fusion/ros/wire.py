"""The fields of a ROS message, one after the other, out of bytes that nobody vouches for.

    ROS 1    little-endian, packed
    ROS 2    CDR (OMG formal/02-06-51, 15.3): four bytes of header, then each number at a multiple of its size

Every length is held against the bytes that are left before anything is taken.
"""

import struct

import numpy as np
import numpy.typing as npt

from cairn_fusion.ros.bag import Wire

CDR_HEADER_BYTES = 4
TEXT_BYTES_MAX = 4096


class WireReader:
    """A place in a message; each call takes the next field.

    Raises:
        ValueError: the message ends before the field does, or a field cannot be what it says.
    """

    __slots__ = ("_at", "_data", "_is_aligned", "_order", "_origin")

    def __init__(self, data: bytes | memoryview, wire: Wire) -> None:
        self._data = memoryview(data)
        self._is_aligned = wire is Wire.CDR
        self._origin = self._at = CDR_HEADER_BYTES if self._is_aligned else 0
        self._order = "<"
        if self._is_aligned:
            kind = bytes(self._data[:2])
            if len(self._data) < CDR_HEADER_BYTES or kind not in (b"\0\0", b"\0\1"):
                raise ValueError(f"plain CDR (00 00 or 00 01) is expected, it begins with {kind.hex(' ')}")
            self._order = "<" if kind[1] else ">"

    def integer(self, code: str) -> int:
        """A number of the `struct` codes B, H, i, I."""
        number: int = struct.unpack_from(self._order + code, self._data, self._take(struct.calcsize(code), 1))[0]
        return number

    def floats(self, count: int) -> npt.NDArray[np.float64]:
        """(count,) float64."""
        start = self._take(8, count)
        return np.frombuffer(self._data, dtype=f"{self._order}f8", count=count, offset=start).astype(np.float64)

    def text(self) -> str:
        """A string; CDR counts its last zero."""
        size = self.integer("I")
        if size > TEXT_BYTES_MAX:
            raise ValueError(f"a text of {size} bytes, at most {TEXT_BYTES_MAX} are read")
        raw = bytes(self._data[(start := self._take(1, size)) : start + size])
        return (raw.removesuffix(b"\0") if self._is_aligned else raw).decode("utf-8", "replace")

    def octets(self) -> memoryview:
        """A sequence of bytes, not copied."""
        size = self.integer("I")
        start = self._take(1, size)
        return self._data[start : start + size]

    def length(self, element_bytes_min: int) -> int:
        """How many elements a sequence has, each of at least so many bytes."""
        count = self.integer("I")
        if count * element_bytes_min > len(self._data) - self._at:
            raise ValueError(f"{count} elements are announced, {len(self._data) - self._at} bytes are left")
        return count

    def _take(self, size: int, count: int) -> int:
        """Where the next field begins; the place moves behind it."""
        start = self._at
        if self._is_aligned and count:
            start += -(start - self._origin) % size
        if size * count > len(self._data) - start:
            raise ValueError(
                f"the message ends early: {size * count} bytes are expected at {start} of {len(self._data)}"
            )
        self._at = start + size * count
        return start
