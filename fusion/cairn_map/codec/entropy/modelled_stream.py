"""Numbers under a model, as bytes and back: the door between kernels that code and whoever wants bytes."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes
from cairn_map.codec.entropy.arithmetic_kernels import finish_decoding, finish_encoding, start_decoding, start_encoding
from cairn_map.errors import DamagedDataError

Coder = npt.NDArray[np.int64]
Code = Callable[[Coder, Bytes], bool]
"""Runs kernels, which read or write the numbers that it has; False if one that was read is out of range."""

NUMBERS_PER_BYTE = 1024
"""Leaves or masks that a stored byte may stand for: so a few bytes cannot keep a reader busy for minutes."""


def write_modelled(code: Code, *, room: int) -> bytes | None:
    """What a model writes, or None if it would be more than `room` bytes."""
    data, coder = np.empty(room, np.uint8), start_encoding()
    code(coder, data)
    size = finish_encoding(coder, data)
    return None if size < 0 else data[:size].tobytes()


def read_modelled(code: Code, data: bytes) -> None:
    """Let a model read what it has written.

    Raises:
        DamagedDataError: other bytes than it writes, or a number out of range.
    """
    # A copy that may be written: kernels that code read and write through the same argument.
    read = np.frombuffer(data, np.uint8).copy()
    coder = start_decoding(read)
    if not code(coder, read) or not finish_decoding(coder, read):
        raise DamagedDataError("bad_stream", "a modelled stream is cut off, left over or holds a number out of range")


def check_effort(numbers: int, data: bytes) -> None:
    """Refuse few bytes that claim to say much.

    Raises:
        DamagedDataError: more than NUMBERS_PER_BYTE numbers for each byte.
    """
    if numbers > NUMBERS_PER_BYTE * len(data):
        raise DamagedDataError("bad_stream", f"{len(data)} modelled bytes cannot say {numbers} masks or leaves")
