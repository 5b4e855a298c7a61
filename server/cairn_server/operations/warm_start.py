"""Warm start: kernels are compiled before the server says that it is ready, in processes of their own.

    2026-05-04 09:12:07,113 compiling kernels, once for this version: 31 of 64, 5 s kernel=encode_bricks
    2026-05-04 09:12:29,240 kernels are compiled seconds=27.3

Meanwhile the server answers: /healthz says that it lives, /readyz why it is not ready, and requests wait for the
kernels that they need. A server whose kernels are all kept, as after `cairn compile`, is ready at once.
"""

import logging
import threading
import time
from types import TracebackType
from typing import Self

from cairn_map.kernels.compilers import Compilers, CompilersError
from cairn_map.kernels.kernel_cache import drop_other_versions, forget_kernels, is_warm, kept_folder, mark_warm
from cairn_map.kernels.numba_runtime import is_compiled, known_kernels
from cairn_map.warm_up import SERVER_KERNELS, SERVER_PARTS
from cairn_server.http.middleware.log_format import fields

log = logging.getLogger(__name__)

LOG_EVERY_S = 5.0
PACKAGE = "cairn_map"
"""Package of all kernels that a server calls."""


class WarmStart:
    """Compiling of the kernels for the length of a `with`, unless they are kept."""

    def __init__(self) -> None:
        # A line that a server writes at each start is for its administrator, however quiet the log is to be.
        log.setLevel(logging.INFO)
        self._is_needed = not is_warm(PACKAGE)
        if self._is_needed and kept_folder() is None:
            self._is_needed = False
            log.warning("no folder takes compiled kernels: each process compiles its own, and first requests wait")
        self._is_closing = False
        self._start_s = time.monotonic()
        self._compilers: Compilers | None = None
        self._thread = threading.Thread(target=self._compile, name="warm-start", daemon=True)

    def __enter__(self) -> Self:
        if self._is_needed:
            forget_kernels(PACKAGE)
            self._compilers = Compilers(f"{PACKAGE}.warm_up", list(SERVER_PARTS))
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closing = True
        if self._compilers is not None:
            self._compilers.kill()
            self._thread.join()

    def complaint(self) -> str | None:
        """Reason why the server is not ready; None: all kernels are there, or cannot be kept."""
        return f"compiling: {self._progress()}" if self._is_needed else None

    def _progress(self) -> str:
        return f"{_count()} of {SERVER_KERNELS}, {time.monotonic() - self._start_s:.0f} s"

    def _compile(self) -> None:
        assert self._compilers is not None  # noqa: S101 - the thread is started after it was made
        text, logged_s = "compiling kernels, once for this version: %s", self._start_s
        try:
            log.info(text, self._progress())
            with self._compilers as compilers:
                for name in compilers.kernels():
                    if time.monotonic() >= logged_s + LOG_EVERY_S:
                        logged_s = time.monotonic()
                        log.info(text, self._progress(), extra=fields(kernel=name))
            drop_other_versions()
            # Fewer, if the disk is full: then the next start tries again.
            if _count() == SERVER_KERNELS:
                mark_warm(PACKAGE)
            log.info("kernels are compiled", extra=fields(seconds=round(time.monotonic() - self._start_s, 1)))
        except CompilersError as exc:
            if not self._is_closing:
                log.error("kernels are compiled when they are needed, for compiling them in advance failed: %s", exc)
        finally:
            self._is_needed = False


def _count() -> int:
    """Kernels of a server that are kept; a robot may have added others."""
    return min(sum(map(is_compiled, known_kernels())), SERVER_KERNELS)
