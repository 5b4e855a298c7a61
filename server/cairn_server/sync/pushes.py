"""A commit from its bytes to the answer that it is kept: claims, quotas, check, store.

Acknowledge only what is durable and fully validated. Small ones are kept by the event loop, which does other things
while another process checks and while the store writes.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace

from cairn_map.commits.commit import Commit
from cairn_map.commits.commit_reading import CommitReader, commit_reader
from cairn_map.commits.signature import Signature, check_signatures, signatures_from_text, signatures_to_text
from cairn_map.errors import ConflictError
from cairn_map.evidence.grid import CellKey
from cairn_server.access.auth import Caller, Role
from cairn_server.access.quotas import Meter
from cairn_server.access.rate_limits import Refusals
from cairn_server.live.hub import Hub
from cairn_server.settings import Settings
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.checks.check_process import CheckProcess
from cairn_server.sync.checks.checking import Checked, new_commit
from cairn_server.sync.checks.commit_checks import CommitChecks
from cairn_server.sync.checks.push_policy import check_claims
from cairn_server.sync.handing_over import speaker_of
from cairn_server.sync.held_commits import WantedCommits
from cairn_server.sync.retracting import is_sealed


class Pushes:
    """What becomes of pushed bytes; called from many threads."""

    def __init__(
        self,
        store: Store,
        settings: Settings,
        live: Hub,
        wanted: WantedCommits,
        *,
        on_new: Callable[[], None],
        process: CheckProcess | None = None,
    ) -> None:
        self.checks = CommitChecks(settings, process)
        self.meter = Meter(store, settings.quotas)
        self._store = store
        self._settings = settings
        self._live = live
        self._wanted = wanted
        self._on_new = on_new
        self._refusals = Refusals()

    def keep(
        self,
        row: MapRow,
        caller: Caller,
        id_text: str,
        data: bytes,
        *,
        seal: str | None = None,
        signatures: str | None = None,
    ) -> bool:
        """Keep a commit; True if it is new. When this returns, no power cut can lose it.

        Raises:
            As `admitted`.
        """
        reader = commit_reader(data)
        with self.admitted(row, caller, id_text, reader, seal=seal, signatures=signatures) as admitted:
            return admitted.keep(self.checks.check(reader)).result()

    async def keep_soon(
        self,
        row: MapRow,
        caller: Caller,
        id_text: str,
        pushed: CommitReader,
        *,
        seal: str | None = None,
        signatures: str | None = None,
    ) -> bool:
        """`keep` for a quick one, while the event loop does other things.

        Raises:
            As `keep`.
        """
        with self.admitted(row, caller, id_text, pushed, seal=seal, signatures=signatures) as admitted:
            return await asyncio.wrap_future(admitted.keep(await self.checks.check_soon(pushed)))

    @contextmanager
    def admitted(
        self,
        row: MapRow,
        caller: Caller,
        id_text: str,
        pushed: CommitReader,
        *,
        seal: str | None,
        signatures: str | None,
    ) -> Iterator["_Admitted"]:
        """A commit that may be kept once it is checked; its room is taken for the length of the `with`.

        Anybody may push back a retract that bears this server's own seal; a relay, what robots signed.

        Raises:
            BadInputError: not a commit for this map, not by this caller, or against `push_policy` or `quotas`.
            UnreachableError: kind `quota`: more than the robot may push now; or `disk_full`.
            ConflictError: kind `id_taken`: the id is known with other bytes; or `evidence_gone`: of what it retracts,
                which is wanted from now on.
        """
        self._store.health.check_space(self._settings.disk_free_min_bytes)
        signed = signatures_from_text(signatures) if signatures else ()
        speaks_for = Caller(Role.ADMIN) if is_sealed(row, pushed.data, seal) else caller
        if speaks_for is caller:
            speaks_for = speaker_of(row, caller, pushed.meta, signed, self._settings.trusted_servers)
        cells = pushed.cells
        check_claims(row, speaks_for, id_text, pushed.meta, cells=len(cells))
        via = caller.name if speaks_for is not caller and caller.role is Role.RELAY else None
        with self.meter.spending(row, caller, size_bytes=len(pushed.data), cells=cells, via=via) as take:
            admitted = _Admitted(self._store, row, pushed, cells, signed, via)
            try:
                yield admitted
            except EvidenceGoneError as exc:
                self._wanted.note(row.name, exc.commits)
                raise
            if admitted.is_new():
                take()
        self._wanted.forget(row.name, pushed.meta.commit_id)
        if admitted.is_new():
            self._on_new()
        if caller.robot:
            self._store.seen(row, caller.robot, None)
            self._live.robot_heard(row, caller.robot)

    def check_room(self, row: MapRow, caller: Caller, *, size_bytes: int) -> None:
        """Refuse what `admitted` would refuse for its size alone, before it comes.

        Raises:
            UnreachableError: kind `quota` or `disk_full`.
        """
        self._store.health.check_space(self._settings.disk_free_min_bytes)
        with self.meter.spending(row, caller, size_bytes=size_bytes, cells=()):
            pass  # not kept: it counts when all of it is here

    def is_quick(self, row: MapRow, caller: Caller, pushed: CommitReader) -> bool:
        """Whether `keep_soon` may keep it: its check is done in a moment, and nothing else waits for anybody."""
        return self.checks.is_quick(pushed) and (caller.role is Role.ADMIN or self.meter.is_ready(row))

    def note_conflict(self, row: MapRow, caller: Caller, conflict: ConflictError) -> None:
        """A line in the audit log, now and then, for somebody who pushes what cannot be."""
        if self._refusals.is_worth_a_line(caller.name):
            self._store.audit_log.add(caller.name, conflict.kind, f"map {row.name}: {conflict.message}")

    def close(self) -> None:
        """End the workers that check."""
        self.checks.close()


class _Admitted:
    """A commit that nothing but its evidence can be refused for."""

    def __init__(
        self,
        store: Store,
        row: MapRow,
        pushed: CommitReader,
        cells: Mapping[CellKey, bytes],
        signed: tuple[Signature, ...],
        via: str | None,
    ) -> None:
        self._store = store
        self._row = row
        self._pushed = pushed
        self._cells = cells
        self._signed = signed
        self._via = via
        self._kept: Future[bool] | None = None

    def keep(self, checked: Checked) -> Future[bool]:
        """Keep it; some milliseconds later it is durable, and it is known whether it is new.

        Raises:
            BadInputError: kind `bad_signature`.
        """
        check_signatures(self._signed, self._row.name, checked.sha)
        commit = Commit(self._pushed.meta, self._cells, checked.sha, self._pushed.data)
        tops = checked.tops or (0,) * (2 + self._row.geometry.plane_count)
        signatures = signatures_to_text(self._signed) or None
        new = replace(new_commit(commit, tops), signatures=signatures, via=self._via)
        self._kept = self._store.submit(self._row, new)
        return self._kept

    def is_new(self) -> bool:
        """Whether it was, once it is durable."""
        return self._kept is not None and self._kept.result()
