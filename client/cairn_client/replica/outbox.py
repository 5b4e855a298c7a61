"""A robot's own commits: numbered without gaps, kept until no restore can lose them, renamed if an id is taken.

    add -> push_set -> acknowledge        the server has the bytes for good
                    -> rename             the server has other bytes under this id (SYNC.md rule 13)
    forget                                stable and covered everywhere (rule 12), and acknowledged for long enough by
                                          the robot's own clock: the SHA stays, the bytes go

All methods are called under the replica's lock.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cairn_client.replica.replica_state import (
    AmendRecord,
    AmendRecords,
    ReplicaState,
    RobotKeys,
    Successors,
    poses_to_text,
)
from cairn_client.replica.replica_store import KeptCommit
from cairn_map.codec.cell_code import Profile
from cairn_map.codec.layer_code import decode_row
from cairn_map.commits.commit import Commit, CommitMeta, ScanPose, make_commit, renamed_commit, split_commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, RobotName
from cairn_map.commits.mark import Mark
from cairn_map.commits.signature import Signature
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, first_error
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey
from cairn_map.wire.messages import ReplyHeader

log = logging.getLogger(__name__)

READ_LAST_BYTES_MAX = 8 << 20
"""Bytes of commits that stay in memory after they were read."""
MARKS_KEY = "marks"
"""First word of the key of what is remembered of a commit with marks."""
NO_NOTES: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class CommitFacts:
    """Statements of a commit about itself that its author makes; the outbox adds id, grid, parent and cursor."""

    captured_s: tuple[float, float] | None = None
    """Times of the first and the last scan, UTC seconds since 1970; None for a commit without scans."""
    epoch: Epoch | None = None
    """Epoch of the last scan, by the server's clock; None: it has no time by which others could order it."""
    scans: tuple[ScanPose, ...] = ()
    """Poses of the scans, in their order."""
    sensors: tuple[str, ...] = ()
    """Names of the rig's cameras."""
    rig: str | None = None
    """Digest of the rig, hex."""
    integrator: str = ""
    """Name, version and parameters of the integrator."""
    retracts: tuple[CommitId, ...] = ()
    """Own commits that this one takes back and stands for."""
    note: str = ""
    """Up to 1024 characters for the map's log."""
    marks: tuple[Mark, ...] = ()
    """Marks; then it has no evidence."""

    def meta(self, commit: CommitId, layer: MapLayer, *, parent: str | None, seen: Cursor | None) -> CommitMeta:
        """The commit's meta.

        Raises:
            BadInputError: kind `bad_meta`: a note that is too long, or more commits than one can take back.
        """
        # A commit with marks names the grid alone, whatever the map's epochs are.
        has_layers = layer.has_epochs and not self.marks
        try:
            return CommitMeta(
                id=str(commit),
                geometry=None if has_layers else layer.geometry.digest().hex(),
                layers=layer.identities if has_layers else (),
                epoch=self.epoch if has_layers and self.epoch != BASE else None,
                parent=parent,
                seen=None if seen is None else str(seen),
                captured_s=self.captured_s,
                scans=self.scans,
                sensors=self.sensors,
                rig=self.rig,
                integrator=self.integrator,
                retracts=tuple(str(target) for target in self.retracts),
                note=self.note,
                marks=self.marks,
            )
        except ValidationError as exc:
            raise BadInputError("bad_meta", f"the commit cannot say this of itself: {first_error(exc)}") from exc


NO_FACTS = CommitFacts()


class Outbox:
    """Own commits in a replica's store."""

    def __init__(
        self,
        state: ReplicaState,
        robot: RobotName,
        layer: MapLayer,
        *,
        make_room: Callable[[int], None],
        amendable: Callable[[], Iterable[CommitId]],
    ) -> None:
        """Read the commits that are kept, and draw an incarnation if the folder has none that can sign.

        Args:
            state: the robot's folder.
            robot: its name.
            layer: the map's grid and epochs.
            make_room: called before a commit of so many bytes is kept; raises if there is no room for it.
            amendable: returns commits that may still be amended: their bytes are kept, to subtract them at once.
        """
        self._state = state
        self._store = state.store
        self._robot = robot
        self._layer = layer
        self._make_room = make_room
        self._amendable = amendable
        # Key and incarnation are drawn in one transaction: one without the other makes commits that cannot be signed.
        self._keys = RobotKeys(state, robot)
        known = state.incarnation
        if known is None or not self._keys.has(known):  # a folder from before commits were signed
            with self._store.transaction():
                known = self._keys.draw()
                state.incarnation = known
                self._set_next(0, None)
        self._incarnation = known
        # In memory is every commit ever kept, oldest first, without its bytes.
        self._commits: dict[CommitId, KeptCommit] = {}
        self._touching: dict[CellKey, dict[CommitId, None]] = {}
        # Acknowledged since the newest header was made, which cannot name them yet.
        self._acked_since_header: set[CommitId] = set()
        self._retracts: dict[CommitId, tuple[CommitId, ...]] = {}
        """Commits that each kept commit takes out, as far as they were read."""
        self._read_last: dict[CommitId, tuple[int, dict[CellKey, bytes]]] = {}
        """Size, and bytes of the cells, of the commits read last, oldest first."""
        self.successors = Successors(self._store)
        self.amends = AmendRecords(self._store)
        for kept in self._store.commits():
            self._note(kept)

    def take_layer(self, layer: MapLayer) -> None:
        """Make commits of this layer from here on."""
        self._layer = layer

    def __iter__(self) -> Iterator[KeptCommit]:
        """Commits whose bytes are kept, oldest first."""
        return (kept for kept in self._commits.values() if kept.has_data)

    @property
    def author(self) -> Author:
        """The robot in its present incarnation."""
        return Author(self._robot, self._incarnation)

    @property
    def cells(self) -> set[CellKey]:
        """Cells that a kept commit touches."""
        return set(self._touching)

    def add(
        self,
        diff: Mapping[CellKey, Evidence],
        facts: CommitFacts = NO_FACTS,
        *,
        seen: Cursor | None,
        profile: Profile = Profile.FAST,
        notes: Mapping[str, str] = NO_NOTES,
        record: AmendRecord | None = None,
    ) -> Commit:
        """Keep evidence as the next commit; durable on return.

        Args:
            diff: packed evidence by cell.
            facts: what the commit states about itself.
            seen: cursor of the server's state that is here.
            profile: effort spent on the size of its bytes.
            notes: texts by key to remember in the same transaction.
            record: of an amend, whose place it takes.

        Raises:
            BadInputError: kind `not_own`: it retracts another robot's commit; only an operator may. Kind `bad_meta`:
                the facts are too many or too long.
        """
        # A robot speaks for itself alone: the server would refuse it, and it would wait here for ever.
        foreign = [target for target in facts.retracts if target.author.robot != self._robot]
        if foreign:
            raise BadInputError("not_own", f"{foreign[0]} is not {self._robot}'s own; an operator can retract it")
        # Number and parent continue the row of this incarnation, without a gap.
        n = self._next_n()
        meta = facts.meta(CommitId(self.author, n), self._layer, parent=self._state.tip_sha, seen=seen)
        commit = make_commit(meta, diff, self._layer, profile=profile)
        # Before the transaction, because making room drops things in transactions of its own.
        self._make_room(len(commit.data))
        # All of it or nothing: a commit kept without its number would share its id with the next one.
        with self._store.transaction():
            self._store.add_commit(commit)
            self._set_next(n + 1, commit)
            for key, text in notes.items():
                self._store.put(key, text)
            if record is not None:
                self.amends.put(commit.id, record)
            self._note_marks(commit)
            self._put_successor(commit)
        # Memory follows the disk, so that a transaction that failed leaves no trace.
        self._note(_kept(commit))
        self._read_successors(commit.meta.retracted_ids)
        self._retracts[commit.id] = commit.meta.retracted_ids
        return commit

    def amend(
        self,
        target: CommitId,
        diff: Mapping[CellKey, Evidence],
        facts: CommitFacts,
        *,
        seen: Cursor | None,
        profile: Profile,
        T_map_rig: npt.NDArray[np.float64] | None = None,
    ) -> Commit:
        """Keep evidence as a commit that takes the place of what stands for another one, with a record of it; as `add`.

        Args:
            target: commit to replace, or any that it replaced.
            diff: as for `add`.
            facts: as for `add`, but for what it retracts.
            seen: as for `add`.
            profile: as for `add`.
            T_map_rig: (N, 4, 4) poses of its scans; None: those that were observed.
        """
        # A retract takes effect once for each target (rule 11), so the newest form is named, not the first commit.
        latest = self.successors.latest(target)
        # The poses are kept as they are, because the commit states quaternions; after its bytes only this remains.
        record = AmendRecord(
            of=str(latest),
            rig=facts.rig,
            integrator=facts.integrator,
            scans=len(facts.scans),
            poses=None if T_map_rig is None else poses_to_text(T_map_rig),
        )
        # The scans are the same: they keep their epoch, even if the clock is known better by now (rule T2).
        epoch = self._commits[latest].epoch if latest in self._commits else facts.epoch
        facts = replace(facts, retracts=(latest,), epoch=epoch)
        return self.add(diff, facts, seen=seen, profile=profile, record=record)

    def keep_sealed(self, commit: Commit, seal: str) -> None:
        """Keep a server's own retract, to push it back if the server is restored to a time before it (rule 11)."""
        with self._store.transaction():
            self._store.add_commit(commit, seal=seal)
            self._put_successor(commit)
        # Acknowledged from the start: the server that sealed it has it.
        self._note(replace(_kept(commit), acked=True, seal=seal, acked_age_s=self._store.age_s()))
        self._read_successors(commit.meta.retracted_ids)

    def knows(self, commit: CommitId) -> bool:
        """True if a commit is here, or was."""
        return commit in self._commits

    def has_evidence(self, commit: CommitId) -> bool:
        """False if a commit is known to hold none, nor marks."""
        kept = self._commits.get(commit)
        return kept is None or bool(kept.cells) or self.has_marks(commit)

    def has_marks(self, commit: CommitId) -> bool:
        """True if a commit that was made here brought marks."""
        return self._store.get(f"{MARKS_KEY} {commit}") is not None

    def meta(self, commit: CommitId) -> CommitMeta | None:
        """Meta of a commit; None if its bytes are not kept any more."""
        data = self._store.commit_data(commit)
        return split_commit(data)[0] if data else None

    def seal(self, commit: CommitId) -> str | None:
        """The seal that a kept commit bears."""
        return self._commits[commit].seal

    def signatures(self, commit: Commit) -> str | None:
        """The robot's signatures on its own commit, as `Cairn-Signature` has them; None for a server's retract."""
        return self._keys.signatures(commit)

    def sign_bytes(self, message: bytes) -> tuple[Signature, ...]:
        """Signatures on a message by all keys of the robot, the present one first."""
        return self._keys.sign_bytes(self._incarnation, message)

    def push_set(self, header: ReplyHeader | None) -> list[CommitId]:
        """Commits that the server may lack, oldest first.

        All except those that the newest header covers (unless it wants them again), those that the server holds but has
        not folded yet, and those acknowledged since. A commit that was never acknowledged is pushed even if its id is
        covered: after a roll-back of this robot's disk another commit may have that id (rule 13).
        """
        covered = header.coverage if header else EMPTY
        pending = header.pending_vector if header else EMPTY
        wanted = set(header.wanted) if header else set()
        return [
            kept.id
            for kept in self._commits.values()
            if kept.has_data
            and kept.id not in self._acked_since_header
            and not (kept.acked and (kept.id in covered or kept.id in pending) and str(kept.id) not in wanted)
        ]

    def whole(self, commit: CommitId) -> Commit | None:
        """A commit with its bytes; None if they are not kept any more."""
        data = self._store.commit_data(commit)
        if data is None:
            return None
        meta, cells = split_commit(data)
        if meta.commit_id != commit:
            raise DamagedDataError("bad_commit", f"the bytes kept as {commit} are those of {meta.commit_id}")
        return Commit(meta, cells, self._commits[commit].sha, data)

    def acknowledge(self, commit: CommitId) -> None:
        """Note that the server has these bytes for good; only coverage states which commits a cell holds."""
        age_s = self._store.age_s()
        with self._store.transaction():
            self._store.set_acked(commit, age_s=age_s)
        self._commits[commit] = replace(self._commits[commit], acked=True, acked_age_s=age_s)
        self._acked_since_header.add(commit)

    def rename(self, commit: CommitId) -> Commit:
        """Give a commit whose id the server does not take a new one, in a new incarnation (rule 13)."""
        data = self._store.commit_data(commit)
        if data is None:
            raise BadInputError("no_bytes", f"the bytes of {commit} are not kept any more")
        # Other numbers of the present incarnation may be taken, too; an older one has nothing left to number.
        if commit.author == self.author:
            self.new_incarnation(f"the server takes these bytes under another id than {commit} only")
        # The renamed commit, and the commits that name it under its old id.
        n = self._next_n()
        renamed = renamed_commit(data, commit=CommitId(self.author, n), parent=self._state.tip_sha)
        amends = list(self._naming(commit, renamed.id))
        # All of them change on the disk at once, then in memory.
        with self._store.transaction():
            self._store.remove_commit(commit)
            self._store.add_commit(renamed)
            self._note_marks(renamed)
            self._set_next(n + 1, renamed)
            for amend in amends:
                self._store.replace_commit(amend)
            self.successors.rename(commit, renamed.id, takes_out=renamed.meta.retracted_ids)
            self.amends.rename(commit, renamed.id)
        for key in self._commits.pop(commit).cells:
            del self._touching[key][commit]
        for changed in (renamed, *amends):
            self._note(_kept(changed))
        self._read_successors(renamed.meta.retracted_ids)
        return renamed

    def named_attachments(self) -> frozenset[str]:
        """SHA-256, hex, of the attachments that marks of commits name whose bytes are kept."""
        noted = (self._store.get(f"{MARKS_KEY} {kept.id}") for kept in self if not kept.cells)
        return frozenset(sha for text in noted if text for sha in text.split())

    def _note_marks(self, commit: Commit) -> None:
        """Remember of a commit that it brought marks, and their attachments: it may be taken out without its bytes."""
        if commit.meta.marks:
            attached = (mark.attachment.sha256 for mark in commit.meta.marks if mark.attachment is not None)
            self._store.put(f"{MARKS_KEY} {commit.id}", " ".join(attached))

    def _naming(self, old: CommitId, new: CommitId) -> Iterator[Commit]:
        """Commits that retract a renamed one, with its new id in them; on the server the old id is another commit's.

        Commits are pushed oldest first, so none of these can have been pushed before the one they name.
        """
        for kept in self._commits.values():
            data = None if kept.acked else self._store.commit_data(kept.id)
            meta = split_commit(data)[0] if data else None
            if data is not None and meta is not None and old in meta.retracted_ids:
                targets = tuple(str(new if target == old else target) for target in meta.retracted_ids)
                yield renamed_commit(data, commit=kept.id, parent=meta.parent, retracts=targets)

    def new_incarnation(self, reason: str) -> None:
        """Number commits from 0 under a fresh incarnation: this robot's disk was rolled back or lost."""
        log.warning("robot %s takes a new incarnation: %s", self._robot, reason)
        # Older keys and commits stay: what waits under the old incarnation is still pushed under it.
        with self._store.transaction():
            fresh = self._keys.draw()
            self._state.incarnation = fresh
            self._set_next(0, None)
        self._incarnation = fresh

    def check_tip(self, header: ReplyHeader, *, asked_by: Author) -> None:
        """Note a newer header; a new incarnation if the server knows commits that this disk forgot (rule 13)."""
        # The header was asked for after those acknowledgements, so its vector and `pending` speak of them.
        self._acked_since_header.clear()
        # The tip is that of one author: asked for before a rename, it is the older incarnation's.
        if header.tip is None or asked_by != self.author:
            return
        n, sha = header.tip
        known = self._commits.get(CommitId(self.author, n))
        # Beyond the own numbers, or one of them with other bytes: this disk was rolled back.
        if n >= self._next_n() or (known is not None and known.sha.hex() != sha):
            self.new_incarnation(f"the server has commit {n} of it with bytes that are not here")

    def original_of(self, commit: CommitId, originals: Collection[CommitId]) -> CommitId | None:
        """Original of a commit: the one among `originals` that has the same successor; None if there is none.

        Raises:
            ConflictError: kind `taken_back`: it was taken back, and not by an amend.
        """
        # An original and its amends are one chain, so they share the commit that stands for them now.
        latest = self.successors.latest(commit)
        found = next((original for original in originals if self.successors.latest(original) == latest), None)
        found = commit if commit in originals else found
        # Unknown: it got a new id (SYNC.md rule 13). A kill right after an amend leaves its scans under the older id.
        if found not in (None, latest) and self.knows(found) and not self.amends.leads(latest, found):
            raise ConflictError("taken_back", f"{found} was taken back by {latest}: there is nothing to amend")
        return found

    def named(self) -> set[CommitId]:
        """Commits that a kept commit takes out, or may yet: an amend keeps the bytes of what it names (rule 11)."""
        amendable = {self.successors.latest(commit) for commit in self._amendable()}
        return amendable | {target for kept in self for target in self._retracts_of(kept.id)}

    def forget(self, gone: Iterable[CommitId]) -> None:
        """Drop the bytes of commits; their SHA stays."""
        commits = list(gone)
        if commits:
            with self._store.transaction():
                self._store.forget_data(commits)
        # The SHA-256 stays for `check_tip`, and the cells for `own_evidence`, which must notice that bytes are gone.
        for commit in commits:
            self._commits[commit] = replace(self._commits[commit], has_data=False)
            self._retracts.pop(commit, None)
            self._read_last.pop(commit, None)

    def reread(self) -> None:
        """Read again from the store which commits are acknowledged."""
        # For another server, which has acknowledged nothing.
        self._acked_since_header.clear()
        for kept in self._store.commits():
            self._note(kept)

    def touching(self, key: CellKey) -> list[KeptCommit]:
        """Commits with bytes that touch a cell, oldest first."""
        return [kept for commit in self._touching.get(key, ()) if (kept := self._commits[commit]).has_data]

    def kept(self, commit: CommitId) -> KeptCommit | None:
        """A commit, if its bytes are kept."""
        kept = self._commits.get(commit)
        return kept if kept is not None and kept.has_data else None

    def has_made(self, commit: CommitId) -> bool:
        """True if a commit was ever kept here."""
        return commit in self._commits

    def own_evidence(self, key: CellKey, news: VersionVector, author: Author) -> list[CellHistory] | None:
        """Evidence of a cell from an author's commits among `news`; None if the bytes of one are not kept any more."""
        mine = [commit for commit in self._touching.get(key, ()) if commit.author == author and commit in news]
        if not all(self._commits[commit].has_data for commit in mine):
            return None
        return [self.history(commit, key) for commit in mine]

    def history(self, commit: CommitId, key: CellKey) -> CellHistory:
        """Evidence of one commit for a cell that it touches, as the row of its epoch.

        Raises:
            DamagedDataError: its bytes at rest are not sound any more.
        """
        return cell_history({self._commits[commit].epoch: decode_row(self._bodies(commit)[key], key, self._layer)})

    def _bodies(self, commit: CommitId) -> dict[CellKey, bytes]:
        """Bytes of the cells of a commit; those of the commits read last stay, for a folder is read cell by cell."""
        if commit not in self._read_last:
            data = self._store.commit_data(commit) or b""
            self._read_last[commit] = len(data), split_commit(data)[1]
            # Those read longest ago go first, and the newest one too if it alone is too large.
            found = self._read_last[commit][1]
            while sum(size for size, _ in self._read_last.values()) > READ_LAST_BYTES_MAX:
                del self._read_last[next(iter(self._read_last))]
            return found
        return self._read_last[commit][1]

    def _note(self, kept: KeptCommit) -> None:
        # Its bytes may be new ones: a rename changes what an amend names.
        self._retracts.pop(kept.id, None)
        self._read_last.pop(kept.id, None)
        self._commits[kept.id] = kept
        for key in kept.cells:
            self._touching.setdefault(key, {})[kept.id] = None
        self.successors.read(kept.id)

    def _put_successor(self, commit: Commit) -> None:
        for target in commit.meta.retracted_ids:
            self.successors.put(target, commit.id)

    def _read_successors(self, commits: Iterable[CommitId]) -> None:
        for commit in commits:
            self.successors.read(commit)

    def _retracts_of(self, commit: CommitId) -> tuple[CommitId, ...]:
        # Read when first needed: opening a folder must not read the bytes of every commit.
        if commit not in self._retracts:
            data = self._store.commit_data(commit)
            self._retracts[commit] = split_commit(data)[0].retracted_ids if data else ()
        return self._retracts[commit]

    def _next_n(self) -> int:
        return self._state.next_n or 0

    def _set_next(self, n: int, tip: Commit | None) -> None:
        self._state.next_n = n
        self._state.tip_sha = tip.sha.hex() if tip else None


def _kept(commit: Commit) -> KeptCommit:
    return KeptCommit(commit.id, commit.sha, tuple(sorted(commit.cells)), epoch=commit.meta.row)
