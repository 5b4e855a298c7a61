"""Whether the server can take a push and bring it into the map: what `GET /readyz` answers.

A map that waits for a damaged cell does not count: the others go on, and a balancer that took the server away would
stop those, too. It is a figure to watch instead (`cairn_fold_failures_total`).
"""

import threading
import time
from collections.abc import Callable

from cairn_map.errors import CairnError, DamagedDataError, UnreachableError
from cairn_server.metrics import ServerFigures
from cairn_server.settings import Settings
from cairn_server.store.store import StoreHealth

KEEP_S = 1.0
"""An answer is good for so long: anybody may ask, and each look writes to the disk."""


class FoldHealth:
    """Which maps could not be folded the last time, and why; thread-safe."""

    def __init__(self, figures: ServerFigures) -> None:
        self._figures = figures
        self._lock = threading.Lock()
        self._failing: dict[str, BaseException] = {}

    def folded(self, name: str, commits: int, seconds: float) -> None:
        """A map has nothing to fold, or a group of it was folded."""
        with self._lock:
            self._failing.pop(name, None)
        if commits:
            self._figures.fold_seconds.labels(name).observe(seconds)
            self._figures.folded.labels(name).inc(commits)

    def failed(self, name: str, error: BaseException) -> None:
        """A map could not be folded."""
        with self._lock:
            self._failing[name] = error
        self._figures.fold_failures.labels(name).inc()

    def damaged(self) -> frozenset[str]:
        """Maps of which something waits for a damaged cell to be healed: their own trouble, not the server's."""
        with self._lock:
            return frozenset(name for name, error in self._failing.items() if isinstance(error, DamagedDataError))

    def complaint(self) -> str | None:
        """Why folding fails, other than for damage; None if it does not."""
        with self._lock:
            for error in self._failing.values():
                if not isinstance(error, DamagedDataError):
                    return error.message if isinstance(error, CairnError) else type(error).__name__
        return None


class Readiness:
    """Looks, at most every second."""

    def __init__(
        self, store: StoreHealth, folds: FoldHealth, settings: Settings, folder_is_alive: Callable[[], bool]
    ) -> None:
        self._store = store
        self._folds = folds
        self._settings = settings
        self._folder_is_alive = folder_is_alive
        self._lock = threading.Lock()
        self._looked_s = float("-inf")
        self._reasons: list[str] = []
        self._is_closing = False

    def close(self) -> None:
        """Count as not ready from now on: the server stops."""
        self._is_closing = True

    def reasons(self) -> list[str]:
        """Why it is not ready, each as `code: what`; empty if it is. Names no map: strangers may ask."""
        if self._is_closing:
            return ["shutting_down: the server is told to stop"]
        with self._lock:
            if time.monotonic() - self._looked_s >= KEEP_S:
                self._reasons = list(self._look())
                self._looked_s = time.monotonic()
            return list(self._reasons)

    def check(self) -> None:
        """Return if the server is ready.

        Raises:
            UnreachableError: kind `not_ready`; the message is the reasons.
        """
        reasons = self.reasons()
        if reasons:
            raise UnreachableError("not_ready", "; ".join(reasons), retry_after_s=5.0)

    def _look(self) -> list[str]:
        found: list[str] = []
        try:
            self._store.check_space(self._settings.disk_free_min_bytes)
            self._store.probe()
            found += self._lag()
        except UnreachableError as exc:
            found.append(f"{exc.kind}: {exc.message}")
        if not self._folder_is_alive():
            found.append("fold_dead: the thread that folds has ended; start the server anew")
        complaint = self._folds.complaint()
        if complaint:
            found.append(f"fold_failing: {complaint}")
        return found

    def _lag(self) -> list[str]:
        limit_s, damaged = self._settings.fold_lag_max_s, self._folds.damaged()
        oldest = [b.oldest_s for b in self._store.backlogs() if b.oldest_s is not None and b.map not in damaged]
        lag_s = time.time() - min(oldest) if oldest else 0.0
        return [f"fold_lag: a commit waits since {lag_s:.0f} s (at most {limit_s:.0f})"] if lag_s > limit_s else []
