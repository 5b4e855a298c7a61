"""How folding does: what the folder notes as it works, for the figures and for `GET /readyz`."""

import threading

from cairn_map.errors import CairnError, DamagedDataError
from cairn_server.metrics import ServerFigures


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
