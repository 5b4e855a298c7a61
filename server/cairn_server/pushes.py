"""A commit from its bytes to the answer that it is kept: claims, quotas, check, store.

Acknowledge only what is durable and fully validated. Nobody needs to wait while the store writes: there is a future of
its answer.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager

from cairn_map.commit import Commit
from cairn_map.commit_reading import CommitReader, commit_reader
from cairn_map.errors import ConflictError
from cairn_server.auth import Caller, Role
from cairn_server.checking import new_commit
from cairn_server.commit_checks import CommitChecks
from cairn_server.live import Hub
from cairn_server.push_policy import EvidenceGoneError, check_claims
from cairn_server.quotas import Meter
from cairn_server.refusals import Refusals
from cairn_server.retracting import is_sealed
from cairn_server.settings import Settings
from cairn_server.store import Store
from cairn_server.store_rows import MapRow
from cairn_server.wanted_commits import WantedCommits


class Pushes:
    """What becomes of pushed bytes; called from many threads."""

    def __init__(
        self, store: Store, settings: Settings, live: Hub, wanted: WantedCommits, *, on_new: Callable[[], None]
    ) -> None:
        self.checks = CommitChecks(settings)
        self.meter = Meter(store, settings.quotas)
        self._store = store
        self._settings = settings
        self._live = live
        self._wanted = wanted
        self._on_new = on_new
        self._refusals = Refusals()

    def keep(self, row: MapRow, caller: Caller, id_text: str, data: bytes, *, seal: str | None = None) -> bool:
        """Keep a commit; True if it is new. When this returns, no power cut can lose it.

        Raises:
            As `keeping`.
        """
        with self.keeping(row, caller, id_text, commit_reader(data), seal=seal) as kept:
            return kept.result()

    @contextmanager
    def keeping(
        self, row: MapRow, caller: Caller, id_text: str, pushed: CommitReader, *, seal: str | None = None
    ) -> Iterator[Future[bool]]:
        """Keep a commit; what it gives says, some milliseconds later, that it is durable, and True if it is new.

        Anybody may push back a retract that bears this server's own seal.

        Raises:
            BadInputError: not a commit for this map, not by this caller, or against `push_policy` or `quotas`.
            UnreachableError: kind `quota`: more than the robot may push now; or `disk_full`.
            ConflictError: kind `id_taken`: the id is known with other bytes; or `evidence_gone`: of what it retracts,
                which is wanted from now on.
        """
        self._store.health.check_space(self._settings.disk_free_min_bytes)
        speaks_for = Caller(Role.ADMIN) if is_sealed(row, pushed.data, seal) else caller
        cells = pushed.cells
        check_claims(row, speaks_for, id_text, pushed.meta, cells=len(cells))
        with self.meter.spending(row, caller, size_bytes=len(pushed.data), cells=cells) as keep:
            checked = self.checks.check(pushed)
            commit = Commit(pushed.meta, cells, checked.sha, pushed.data)
            kept = self._store.submit(row, new_commit(commit, checked.tops or (0,) * (2 + row.geometry.plane_count)))
            try:
                yield kept
                is_new = kept.result()
            except EvidenceGoneError as exc:
                self._wanted.note(row.name, exc.commits)
                raise
            if is_new:
                keep()
        self._wanted.forget(row.name, commit.id)
        if is_new:
            self._on_new()
        if caller.robot:
            self._store.seen(row, caller.robot, None)
            self._live.robot_heard(row, caller.robot)

    def is_quick(self, row: MapRow, caller: Caller, pushed: CommitReader) -> bool:
        """Whether `keeping` will be done in a moment, and wait for nobody."""
        return self.checks.is_quick(pushed) and (caller.robot is None or self.meter.is_ready(row))

    def note_conflict(self, row: MapRow, caller: Caller, conflict: ConflictError) -> None:
        """A line in the audit log, now and then, for somebody who pushes what cannot be."""
        if self._refusals.is_worth_a_line(caller.name):
            self._store.audit_log.add(caller.name, conflict.kind, f"map {row.name}: {conflict.message}")

    def close(self) -> None:
        """End the workers that check."""
        self.checks.close()
