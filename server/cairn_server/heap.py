"""How the C library keeps the memory that threads gave back."""

import ctypes
from contextlib import suppress

M_ARENA_MAX = -8
ARENAS = 2


def keep_few_arenas() -> None:
    """Let all threads share two heaps: glibc gives each of forty its own, and what one gave back no other one uses.

    Other C libraries have nothing like it.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, ARENAS)
