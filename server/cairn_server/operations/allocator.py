"""Memory that is freed goes back: how glibc's allocator is to work in a process with many threads and large arrays.

Each of the web server's forty threads would get an arena of its own, where pieces of answers long sent lie between
pieces of caches, and none can be given back; and each freed array of megabytes raises the size from which on memory
comes from the system and goes back to it. With two hundred robots on one map that was a third of all memory.
"""

import ctypes

ARENAS_MAX, MAPPED_FROM_BYTES = 2, 1 << 20
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8
"""Of glibc's `mallopt`."""


def keep_memory_small() -> None:
    """Once, before there are threads; without glibc it does nothing."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, ARENAS_MAX)
        mallopt(M_MMAP_THRESHOLD, MAPPED_FROM_BYTES)
