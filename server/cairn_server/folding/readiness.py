"""Readiness of the server to take a push and fold it into the map: the answer to `GET /readyz`.

A map that waits for a damaged cell does not count: the other maps go on, and a balancer that took the server away
would stop those, too. Damage is a figure to watch instead (`cairn_fold_failures_total`).
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable

from cairn_map.errors import CairnError, DamagedDataError, UnreachableError
from cairn_server.metrics import ServerFigures
from cairn_server.settings import Settings
from cairn_server.store.objects.cold_bytes import AwayError
from cairn_server.store.store import StoreHealth

log = logging.getLogger(__name__)

KEEP_S = 1.0
"""Lifetime of an answer: any client may ask, and each look writes to the disk."""

REOPEN_FACTOR = 1.25
"""Room, in parts of `disk_free_min_bytes`, from which on a server whose disk was full is ready again: pushes and folds
move the free space by a cell's size or two, and a server at the bound would come and go with each."""
OF_ONE_MAP = DamagedDataError, AwayError
"""Errors of folding for which some commits of a map wait, while all else goes on."""


class FoldHealth:
    """Maps whose last fold failed, and the errors; counts folds for the metrics; thread-safe."""

    def __init__(self, figures: ServerFigures) -> None:
        self._figures = figures
        self._lock = threading.Lock()
        self._failing: dict[str, BaseException] = {}

    def folded(self, name: str, commits: int, seconds: float) -> None:
        """Note that a group of a map's commits was folded, or that none waits."""
        with self._lock:
            self._failing.pop(name, None)
        if commits:
            self._figures.fold_seconds.labels(name).observe(seconds)
            self._figures.folded.labels(name).inc(commits)

    def has_failures(self) -> bool:
        """True if the last fold of any map failed."""
        with self._lock:
            return bool(self._failing)

    def waiting(self, names: Iterable[str]) -> None:
        """Note which maps have commits to be folded: folding of the others does not fail."""
        known = set(names)
        with self._lock:
            self._failing = {name: error for name, error in self._failing.items() if name in known}

    def failed(self, name: str, error: BaseException) -> None:
        """Note that a map could not be folded."""
        with self._lock:
            self._failing[name] = error
        self._figures.fold_failures.labels(name).inc()

    def clock_jumped(self, jump_s: float) -> None:
        """Count a jump of the wall clock, ahead or (negative) back; a server is ready all the same."""
        self._figures.clock_jumps.labels("ahead" if jump_s > 0 else "back").inc()

    def held_up(self) -> frozenset[str]:
        """Maps with commits that wait for a damaged cell, or an object store: no fault of the server as a whole."""
        with self._lock:
            return frozenset(name for name, error in self._failing.items() if isinstance(error, OF_ONE_MAP))

    def complaint(self) -> str | None:
        """Reason why folding fails, what is of one map aside; None if it does not fail."""
        with self._lock:
            for error in self._failing.values():
                if not isinstance(error, OF_ONE_MAP):
                    return error.message if isinstance(error, CairnError) else type(error).__name__
        return None


class Readiness:
    """Reasons why the server is not ready, looked up at most every second; thread-safe."""

    def __init__(
        self,
        store: StoreHealth,
        folds: FoldHealth,
        settings: Settings,
        is_folding: Callable[[], bool],
        warming: Callable[[], str | None],
    ) -> None:
        """`is_folding` is True while the thread that folds is alive; `warming` is what the start still waits for."""
        self._store = store
        self._folds = folds
        self._settings = settings
        self._is_folding = is_folding
        self._warming = warming
        self._lock = threading.Lock()
        self._looked_s = float("-inf")
        self._reasons: list[str] = []
        self._codes: set[str] = set()
        self._is_closing = False
        self._is_short = False
        """True from the moment at which the disk had too little room until it has clearly enough."""

    @property
    def is_closing(self) -> bool:
        """True once the server got the signal to stop."""
        return self._is_closing

    def close(self) -> None:
        """Be not ready from now on: the server is stopping."""
        self._is_closing = True

    def reasons(self) -> list[str]:
        """Reasons, each as `code: what`; empty if the server is ready. They name no map: strangers may ask."""
        if self._is_closing:
            return ["shutting_down: the server is stopping"]
        with self._lock:
            if time.monotonic() - self._looked_s >= KEEP_S:
                self._reasons = list(self._look())
                self._looked_s = time.monotonic()
                self._tell()
            return list(self._reasons)

    def _tell(self) -> None:
        """Log that the server is ready no more, for another reason, or again: a probe's answers are not logged."""
        codes = {reason.partition(":")[0] for reason in self._reasons}
        if codes != self._codes:
            log.warning("not ready: %s", "; ".join(self._reasons)) if codes else log.warning("ready again")
        self._codes = codes

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
            self._check_space()
            self._store.probe()
            found += self._lag()
        except UnreachableError as exc:
            found.append(f"{exc.kind}: {exc.message}")
        if not self._is_folding():
            found.append("fold_dead: the thread that folds has ended; restart the server")
        complaint = self._folds.complaint()
        if complaint:
            found.append(f"fold_failing: {complaint}")
        warming = self._warming()
        if warming:
            found.append(warming)
        return found

    def _check_space(self) -> None:
        """Return if there is room, and clearly so if there was none at the last look; raises as the store."""
        least_bytes = self._settings.disk_free_min_bytes
        was_short, self._is_short = self._is_short, True
        self._store.check_space(least_bytes)
        if was_short:
            try:
                self._store.check_space(int(REOPEN_FACTOR * least_bytes))
            except UnreachableError as exc:
                text = f"pushes are taken again; ready with {REOPEN_FACTOR:g} times disk_free_min_bytes free"
                raise UnreachableError(exc.kind, text, exc.retry_after_s) from exc
        self._is_short = False

    def _lag(self) -> list[str]:
        limit_s, held_up = self._settings.fold_lag_max_s, self._folds.held_up()
        lag_s = max((b.waited_s for b in self._store.backlogs() if b.map not in held_up), default=0.0)
        return [f"fold_lag: a commit has waited for {lag_s:.0f} s (at most {limit_s:.0f})"] if lag_s > limit_s else []
