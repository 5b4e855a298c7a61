"""A pushed commit, from its bytes to the answer that it is kept: claims, quotas, check, store.

Only what is durable and fully validated is acknowledged. All of it is synchronous: routes call it on threads.
"""

from collections.abc import Callable
from dataclasses import replace

from cairn_map.commits.commit import Commit, CommitMeta
from cairn_map.commits.commit_reading import CommitReader, commit_reader
from cairn_map.commits.ids import Author
from cairn_map.commits.signature import (
    Signature,
    check_signatures,
    incarnation_of,
    signatures_from_text,
    signatures_to_text,
)
from cairn_map.errors import ConflictError, DeniedError, UnreachableError
from cairn_server.access.auth import UPSTREAM, Caller, Role
from cairn_server.access.quotas import Meter
from cairn_server.access.rate_limits import AuditLimit
from cairn_server.cell_room import check_geometry
from cairn_server.live.hub import Hub
from cairn_server.settings import Settings
from cairn_server.store.admission import Grounds
from cairn_server.store.numbering import EvidenceGoneError
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow, NewCommit
from cairn_server.sync.admissions import Admissions
from cairn_server.sync.checks.checking import new_commit
from cairn_server.sync.checks.commit_checks import CommitChecks
from cairn_server.sync.checks.push_policy import check_claims
from cairn_server.sync.clock_trust import ClockTrust
from cairn_server.sync.handing_over import speaker_of
from cairn_server.sync.held_commits import WantedCommits
from cairn_server.sync.retracting import is_sealed


class Pushes:
    """Pushes to all maps of a store; called from many threads."""

    def __init__(
        self,
        store: Store,
        settings: Settings,
        hub: Hub,
        wanted: WantedCommits,
        admissions: Admissions,
        clock: ClockTrust,
        *,
        on_new: Callable[[], None],
    ) -> None:
        """`on_new` is called after each commit that is new."""
        self.checks = CommitChecks(settings)
        self.meter = Meter(store, settings.quotas)
        self._store = store
        self._settings = settings
        self._hub = hub
        self._wanted = wanted
        self._admissions = admissions
        self._clock = clock
        self._on_new = on_new
        self._audit_limit = AuditLimit()

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

        Any robot may push back a retract that bears this server's own seal; a relay may push what robots signed.

        Raises:
            DamagedDataError: the bytes are no sound commit.
            BadInputError: not a commit for this map, not by this caller, or against `push_policy` or `quotas`.
            UnreachableError: kind `quota`: more than the robot may push now; `disk_full`; or `bad_clock`.
            DeniedError: kind `not_admitted`: its author's name is bound to another key (`store.admission`).
            ConflictError: kind `id_taken`: the id is known with other bytes; or `evidence_gone`: the commits that it
                retracts are wanted from now on; or `other_layer` or `too_many_layers`.
        """
        # Parsed once, decoded nowhere yet: claims and quotas refuse by the heads alone.
        commit = commit_reader(data)
        self._store.health.check_space(self._settings.disk_free_min_bytes)

        # Whose commit it is, by token, seal or signatures; and what it claims.
        signed = signatures_from_text(signatures) if signatures else ()
        speaker = self._speaker(row, caller, commit, signed, seal)
        check_claims(row, speaker, id_text, commit.meta, cells=len(commit.cells))
        if commit.meta.layer is not None:
            check_geometry(commit.meta.layer.geometry, self._settings.memory)
        self._check_time(row, commit.meta)
        via = caller.name if speaker is not caller and caller.role is Role.RELAY else None

        # The quota is taken while the commit is checked and written, and given back unless it is new.
        author = commit.meta.commit_id.author
        with self.meter.spending(
            row, caller, size_bytes=len(data), cells=commit.cells, author=author.robot, via=via
        ) as spending:
            grounds = _grounds(caller, speaker, author, signed)
            checked = self._checked(row, commit, signed, caller)
            # What only the check knows; a commit that is known costs nothing, as the append gives it back.
            spending.charge_bricks(checked.bricks)
            is_new = self._append(row, replace(checked, via=via, grounds=grounds), caller)
            if is_new:
                spending.keep()

        # Durable from here on: tell those that wait for it.
        self._wanted.forget(row.name, commit.meta.commit_id)
        if is_new:
            self._clock.note_push(row, commit.meta.row)
            self._on_new()
        if caller.robot:
            self._store.seen(row, caller.robot, None)
            self._hub.robot_heard(row, caller.robot)
        return is_new

    def check_room(self, row: MapRow, caller: Caller, *, size_bytes: int) -> None:
        """Refuse what `keep` would refuse for its size alone, before its bytes come.

        Raises:
            UnreachableError: kind `quota` or `disk_full`.
        """
        self._store.health.check_space(self._settings.disk_free_min_bytes)
        with self.meter.spending(row, caller, size_bytes=size_bytes, cells=()):
            pass  # not taken: it counts when all of it is here

    def note_conflict(self, row: MapRow, caller: Caller, conflict: ConflictError) -> None:
        """Add a line to the audit log for a refused push, within a bound for each token."""
        # A robot that meets a conflict tries again, so without a bound one token could push out the older lines.
        if self._audit_limit.is_worth_a_line(caller.name):
            detail = f"map {row.name}: {conflict.message}"
            self._store.audit_log.add(caller.name, conflict.kind, detail, client=caller.address)

    def close(self) -> None:
        """End the workers that check."""
        self.checks.close()

    def _speaker(
        self, row: MapRow, caller: Caller, commit: CommitReader, signed: tuple[Signature, ...], seal: str | None
    ) -> Caller:
        """Caller whose rights the push has: this server itself by its seal, the signers of a relay's, or `caller`."""
        # The seal first: any robot may bring back the server's own retract, whatever its token allows (rule 11).
        if is_sealed(row, commit.data, seal):
            return Caller(Role.ADMIN)
        return speaker_of(row, caller, commit.meta, signed, self._settings.trusted_servers)

    def _check_time(self, row: MapRow, meta: CommitMeta) -> None:
        """Refuse a commit from the future, except one that is here already.

        Raises:
            UnreachableError: kind `bad_clock`.
        """
        commit = meta.commit_id
        try:
            self._clock.check_push(row, commit.author, meta.row)
        except UnreachableError:
            if self._store.kept_sha(row, commit) is None:
                raise

    def _checked(self, row: MapRow, commit: CommitReader, signed: tuple[Signature, ...], caller: Caller) -> NewCommit:
        """Decode the evidence and check all of it, and the signatures over it.

        Raises:
            DamagedDataError, BadInputError, UnreachableError: as `CommitChecks.check`.
            BadInputError: kind `bad_signature`.
        """
        # Each request of an admin counts for itself.
        checked = self.checks.check(commit, object() if caller.role is Role.ADMIN else caller.name)
        # Signatures are over the SHA-256 of the decoded evidence, which only the check knows.
        check_signatures(signed, row.name, checked.sha)
        found = Commit(commit.meta, commit.cells, checked.sha, commit.data)
        new = new_commit(found, checked.tops, bricks=checked.bricks)
        return replace(new, signatures=signatures_to_text(signed) or None)

    def _append(self, row: MapRow, new: NewCommit, caller: Caller) -> bool:
        """Write a commit; True if it is new. Durable on return."""
        try:
            return self._store.append(row, new)
        except EvidenceGoneError as exc:
            # Refused now and wanted from now on: robots that hold the evidence push it, and the retract succeeds later.
            self._wanted.note(row.name, exc.commits, asker=new.id.author.robot)
            raise
        except DeniedError:
            self._admissions.refused(row, new.id.author, by=caller)
            raise


def _grounds(caller: Caller, speaker: Caller, author: Author, signed: tuple[Signature, ...]) -> Grounds:
    """Grounds of a push: what it is signed by, once that is checked, and the token of the one who brings it."""
    signers = frozenset(incarnation_of(signature.key) for signature in signed)
    is_own = speaker is caller and caller.robot == author.robot
    # What comes from the upstream was admitted there, by operators that this server's own administrator trusts.
    has_word = caller.role is Role.ADMIN or caller == UPSTREAM
    return Grounds(signers=signers, is_own=is_own, has_word=has_word, by=caller.name)
