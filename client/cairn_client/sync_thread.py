"""Rounds in the background: one after each wake-up, one every so often, and after a failure only after a wait."""

import logging
import threading
from collections.abc import Callable

from cairn_client.backoff import Backoff
from cairn_map.errors import CairnError, UnreachableError

log = logging.getLogger(__name__)


class SyncThread:
    """A thread that calls `sync` until stopped; a failure is logged and tried again, never raised."""

    def __init__(self, sync: Callable[[], object], *, every_s: float) -> None:
        self._sync = sync
        self._every_s = every_s
        self._stopping = threading.Event()
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cairn-sync", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """There is something to push. It does not cut short the wait after a failure."""
        self._woken.set()

    def stop(self) -> None:
        """Stop after the round under way."""
        self._stopping.set()
        self._woken.set()
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
                self._stopping.wait(wait_s)
            except CairnError as exc:
                wait_s = backoff.next_s(None)
                log.error("sync failed: %s: %s; trying again in %.1f s", exc.kind, exc.message, wait_s)
                self._stopping.wait(wait_s)
            else:
                backoff.reset()
                if not self._stopping.is_set():
                    self._woken.wait(self._every_s)
