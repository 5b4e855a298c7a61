"""Rounds in the background: one after each wake-up, one every so often, and after a failure only after a wait."""

import logging
import threading
from collections.abc import Callable
from typing import Protocol

from cairn_client.http.backoff import Backoff
from cairn_map.errors import CairnError, UnreachableError

log = logging.getLogger(__name__)


ROUND_END_S = 2.0
"""How long a round may go on by itself when the thread is to stop, before it is cut."""


class OnFailure(Protocol):
    """Who is told of failures."""

    def __call__(self, exc: CairnError, /, *, again_s: float) -> None:
        """A round failed, and is tried again in so many seconds."""


class SyncThread:
    """A thread that calls `sync` until stopped; a failure is logged, told and tried again, never raised."""

    def __init__(self, sync: Callable[[], object], *, every_s: float, on_failure: OnFailure) -> None:
        self._sync = sync
        self._every_s = every_s
        self._on_failure = on_failure
        self._stopping = threading.Event()
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """There is something to push. It does not cut short the wait after a failure."""
        self._woken.set()

    def stop(self, cut: Callable[[], None]) -> None:
        """Stop: a wait at once, a round under way after its end, or when `cut` ended it after two seconds."""
        self._stopping.set()
        self._woken.set()
        self._thread.join(ROUND_END_S)
        if self._thread.is_alive():
            cut()
            self._thread.join()

    def _run(self) -> None:
        backoff = Backoff()
        while not self._stopping.is_set():
            self._woken.clear()
            try:
                self._sync()
            except UnreachableError as exc:
                wait_s = backoff.next_s(exc.retry_after_s)
                log.info("no link (%s); trying again in %.1f s", exc.message, wait_s)
                self._wait(exc, wait_s)
            except CairnError as exc:
                wait_s = backoff.next_s(None)
                log.error("sync failed: %s: %s; trying again in %.1f s", exc.kind, exc.message, wait_s)
                self._wait(exc, wait_s)
            except Exception as exc:  # a fault of ours; without it the robot would never sync again, and say nothing
                wait_s = backoff.next_s(None)
                log.exception("sync failed in a way that was not expected; trying again in %.1f s", wait_s)
                self._wait(CairnError("internal", f"{type(exc).__name__}: {exc}; the log says more"), wait_s)
            else:
                backoff.reset()
                if not self._stopping.is_set():
                    self._woken.wait(self._every_s)

    def _wait(self, exc: CairnError, wait_s: float) -> None:
        if not self._stopping.is_set():
            self._on_failure(exc, again_s=wait_s)
            self._stopping.wait(wait_s)
