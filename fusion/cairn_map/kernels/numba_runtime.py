"""Numba at run time: progress while kernels compile, and Ctrl-C while one runs.

    compiling kernels, only this once: carve_window, 7 of 25, 12 s

The first start on a machine compiles for half a minute. On a terminal the progress is one line, which is removed when
the kernel is done; in a log it is a line every few seconds. Kernels that are read from Numba's cache show nothing.
"""

import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cairn_map.progress import StatusLine

if TYPE_CHECKING:
    from numba.core.dispatcher import Dispatcher

LOG_EVERY_S = 5.0
"""Seconds of compiling between two lines of a log."""
LOG_AFTER_S = 1.0
"""Seconds of compiling before the first line of a log: less is not worth a line."""
LOOKUP = "_numba_unpickle"
"""Numba's function that finds again an object which it has unpickled before."""


class CompileProgress:
    """Progress line: the kernel being compiled, how many of those imported are ready, and the seconds taken so far."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Write to a stream; None: to `sys.stderr`, whatever that is at the time."""
        self._line = StatusLine(stream)
        self._taken_s = 0.0
        self._logged_s = LOG_AFTER_S - LOG_EVERY_S

    def begin(self, kernel: str, *, ready: int, total: int) -> None:
        """Say that a kernel is being compiled, while `ready` of `total` are."""
        if not self._line.is_terminal:
            if self._taken_s < self._logged_s + LOG_EVERY_S:
                return
            self._logged_s = self._taken_s
        count = f"{min(ready + 1, total)} of {total}"
        self._line.show(f"compiling kernels, only this once: {kernel}, {count}, {self._taken_s:.0f} s")

    def end(self, seconds: float) -> None:
        """Add the seconds that the kernel took, and remove its line from a terminal."""
        self._taken_s += seconds
        self._line.clear()


@cache
def show_compiling() -> None:
    """Show on standard error, from now on, which kernel is being compiled; a second call does nothing."""
    progress = CompileProgress()

    def begin(kernel: str) -> None:
        kernels = list(known_kernels())
        progress.begin(kernel, ready=sum(bool(kernel.signatures) for kernel in kernels), total=len(kernels))

    report_compiling(begin, progress.end)


def report_compiling(on_begin: Callable[[str], None], on_end: Callable[[float], None] = lambda seconds: None) -> None:
    """Call with the name of each kernel that is being compiled, from now on, and with the seconds that it took.

    Numba is imported here and not above, so that commands without kernels start without it.
    """
    from numba.core.event import Event, Listener, register

    class Compiling(Listener):
        """Listener to every compilation, in any thread; a kernel that another one calls is compiled within that one."""

        def __init__(self) -> None:
            self.starts_s: list[float] = []

        def on_start(self, event: Event) -> None:
            self.starts_s.append(time.monotonic())
            if len(self.starts_s) == 1:
                details: Any = event.data
                on_begin(details["dispatcher"].py_func.__name__)

        def on_end(self, event: Event) -> None:
            start_s = self.starts_s.pop()
            if not self.starts_s:
                on_end(time.monotonic() - start_s)

    register("numba:compile", Compiling())  # type: ignore[no-untyped-call]


def known_kernels() -> "Iterator[Dispatcher]":
    """Every kernel of a `*_kernels` module that was imported and that Numba keeps on disk, once."""
    from numba.core.dispatcher import Dispatcher

    # Copies: other threads may import modules meanwhile.
    names = [name for name in list(sys.modules) if name.startswith("cairn_") and name.endswith("_kernels")]
    values = {id(value): value for name in names for value in list(vars(sys.modules[name]).values())}
    for value in values.values():
        if isinstance(value, Dispatcher) and value.stats.cache_path is not None:
            yield value


def is_compiled(kernel: "Dispatcher") -> bool:
    """True if a kernel is on disk for this Python: as an index file `FILE.NAME-LINE.pyVERSION.nbi` in Numba's cache."""
    code, version = kernel.py_func.__code__, f"py{sys.version_info.major}{sys.version_info.minor}"
    name = f"{Path(code.co_filename).stem}.{kernel.py_func.__qualname__}-{code.co_firstlineno}.{version}.nbi"
    return (Path(kernel.stats.cache_path or "") / name).is_file()


def keep_interrupts_out_of_kernels() -> None:
    """Let Ctrl-C raise KeyboardInterrupt before or after a kernel, never within; call this before the first kernel.

    For each array of a tuple that a kernel returns, Numba calls `_numba_unpickle`, which is Python, and does not check
    whether it raised. Ctrl-C raises at any line of Python: while a kernel ran it ended in "SystemError: CPUDispatcher
    returned a result with an exception set". That function only looks up an object made earlier; a `functools.cache`
    in front of it does the same without any Python, and Ctrl-C waits for the line behind the kernel. The very first
    result of a kind is still made in Python. A Numba without that function is left unchanged.
    """
    from numba.core import serialize

    lookup = getattr(serialize, LOOKUP, None)
    if lookup is not None and not hasattr(lookup, "cache_info"):
        setattr(serialize, LOOKUP, cache(lookup))
