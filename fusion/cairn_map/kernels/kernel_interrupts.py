"""^C while a kernel hands its results over.

For each array of a tuple numba calls a function of its own that is Python, and does not look whether an exception came
out of it. An interrupt is an exception at any line of Python: one that came while a kernel ran ended in "SystemError:
CPUDispatcher returned a result with an exception set". That function only looks up what it once made; a cache before it
does so without any Python, and ^C waits for the line behind the kernel.
"""

from functools import cache

LOOKUP = "_numba_unpickle"


def keep_interrupts_out_of_kernels() -> None:
    """From now on ^C is a KeyboardInterrupt before or after a kernel, never within; to be called before the first one.

    The very first result of a kind is still made in Python; a numba without that function is left as it is.
    """
    from numba.core import serialize

    lookup = getattr(serialize, LOOKUP, None)
    if lookup is not None and not hasattr(lookup, "cache_info"):
        setattr(serialize, LOOKUP, cache(lookup))
