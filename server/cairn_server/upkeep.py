"""Upkeep of a store: duties of the thread that folds, each in bounded steps, so that no push waits long for one.

    forget    evidence that is older than it must be kept; some commits a step
    clear     rows of deleted maps; some megabytes a step
    sweep     attachments of marks that none names any more; some a step
    shrink    room in the store's file that nothing uses any more, given back to the disk

A duty with more to do rests after each step for a multiple of its length: most of the time is for pushes and folds.
"""

import logging
import threading
import time
from collections.abc import Callable

from cairn_map.errors import CairnError
from cairn_server.store.store import Store

log = logging.getLogger(__name__)

FORGET_MAX = 64
"""Most commits whose evidence is dropped in one transaction."""
CLEAR_BYTES = 4 << 20
"""Bytes of a deleted map that are removed in one transaction."""
LOOK_EVERY_S, LEAST_LOOK_S = 60.0, 0.2
"""Longest and shortest time between two looks: evidence that is kept for seconds is looked at as often."""
RETRY_S = 5.0
"""Time after which a duty that failed is tried again."""
REST_SHARE = 3.0
"""Length of the rest after a step, as a multiple of the step's."""


class Upkeep:
    """Duties of one store; for the thread that folds."""

    def __init__(
        self,
        store: Store,
        *,
        keep_evidence_s: float,
        may_forget_s: Callable[[str], float],
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Look at all duties at the first call.

        Args:
            store: that is looked after.
            keep_evidence_s: age at which a folded commit's evidence is dropped.
            may_forget_s: by a map's name, age of the store before which evidence may be dropped.
            steady_s: steady clock.
        """
        self._store = store
        self._keep_evidence_s = keep_evidence_s
        self._may_forget_s = may_forget_s
        self._steady_s = steady_s
        self._next_s = dict.fromkeys((self._forget, self._clear, self._sweep, self._shrink), float("-inf"))
        """Steady time at which each duty is due."""
        self._hurried = threading.Event()

    def wait_s(self) -> float:
        """Time until a duty is due."""
        if self._hurried.is_set():
            return 0.0
        return max(0.0, min(self._next_s.values()) - self._steady_s())

    def hurry(self) -> None:
        """Look for deleted maps at the next call; from any thread."""
        self._hurried.set()

    def work(self) -> bool:
        """Do a step of each duty that is due; False if one failed."""
        is_well = True
        if self._hurried.is_set():
            self._hurried.clear()
            self._next_s[self._clear] = float("-inf")
        for duty, next_s in list(self._next_s.items()):
            start_s = self._steady_s()
            if start_s < next_s:
                continue
            try:
                pause_s = duty()
            except Exception as exc:
                # Whatever it is: no duty is urgent, and the thread must live. A `CairnError` says all in its message.
                trace = None if isinstance(exc, CairnError) else exc
                log.error("upkeep of the store failed, to be tried again: %s", exc, exc_info=trace)
                is_well, pause_s = False, RETRY_S
            end_s = self._steady_s()
            self._next_s[duty] = end_s + (REST_SHARE * (end_s - start_s) if pause_s is None else pause_s)
        return is_well

    def _forget(self) -> float | None:
        """Drop evidence that need not be kept any longer; the time until the next look, None if there is more."""
        before_s = self._store.age.now_s() - self._keep_evidence_s
        most = 0
        for row in self._store.maps_with_evidence(before_s=before_s):
            # No evidence is dropped that the upstream server lacks.
            may_s = min(before_s, self._may_forget_s(row.name))
            most = max(most, self._store.forget_evidence(row, before_s=may_s, limit=FORGET_MAX))
        return None if most == FORGET_MAX else min(LOOK_EVERY_S, max(LEAST_LOOK_S, self._keep_evidence_s))

    def _clear(self) -> float | None:
        """Remove a part of what deleted maps left; as `_forget`."""
        if self._store.clear_deleted(size_bytes_max=CLEAR_BYTES):
            self._next_s[self._shrink] = float("-inf")
            return None
        return LOOK_EVERY_S

    def _sweep(self) -> float | None:
        """Remove some attachments that are out of use; as `_forget`."""
        return None if self._store.attachments.sweep(now_s=self._store.age.now_s()) else LOOK_EVERY_S

    def _shrink(self) -> float | None:
        """Give some room back to the disk; as `_forget`."""
        return None if self._store.health.shrink() else LOOK_EVERY_S
