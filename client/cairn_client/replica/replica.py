"""A robot's map without the network: its own commits, the server's cells as they are here, and the view of both.

    outbox   own commits, until no restore can lose them              (SYNC.md rule 12)
    base     per cell the server's state at a cursor, and its coverage: the ids in it
    view     base + the commits in the outbox that the cell's coverage lacks, without what they take out  (rule 7)

Every change is one local transaction. Any thread may call any method of `Replica`: it takes the lock. Several changes
that must not be parted are made inside `with replica.changing()`. Locks are taken in this order: replica, store.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cairn_client.replica.attachment_folder import ATTACHMENTS, AttachmentFolder
from cairn_client.replica.limits import KEEP_ACKED_S
from cairn_client.replica.mark_copy import MarkCopy
from cairn_client.replica.outbox import NO_FACTS, NO_NOTES, CommitFacts, Outbox
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import BaseCell, KeptCommit, ReplicaStore
from cairn_client.replica.server_cells import ServerCells, is_to_be_taken
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.commit import Commit, CommitMeta
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import OPERATOR, Author, CommitId, RobotName
from cairn_map.commits.mark import Mark
from cairn_map.commits.signature import Signature
from cairn_map.commits.version_vector import EMPTY
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, CairnError, ConflictError, NotFoundError, UnreachableError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import Cell, CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_at, snapshot_of
from cairn_map.wire.messages import ReplyHeader

log = logging.getLogger(__name__)

REST_S = 3600.0
"""Time after which a refused commit is tried again."""
EARLY_S = 60.0
"""The same of one that was refused for its time, if the server does not say when."""
IDLE_S = 60.0
"""Time without a change after which a cell of a map with epochs is held as bytes: opening one takes 5 ms."""
BAD_CLOCK = "bad_clock"
"""Kind of the refusal of a commit whose time the server cannot judge, or that is still to come for it."""
KINDS_OF_ALL = ("http", "unknown_protocol")
"""Kinds of refusals that say nothing about the commit: a portal's or proxy's, and those of every request."""
KINDS_OF_MARKS = ("too_many_marks", "older_servers")
"""Kinds of refusals of a commit for its marks: the robot has too many, or the server's store takes none yet."""
ATTACHMENTS_BYTES_MAX = 1 << 28
"""Most bytes of the attachments in a robot's folder: a server takes no more of one robot, either."""
FORGET_AT_ONCE = 32
"""Commits dropped at once for room: a few, so that no more go than must."""
RETRACTS_AT_ONCE = 1024
"""Most of the operator's retracts that one round fetches: the next one goes on."""


class StorageBudget(Protocol):
    """Bounds on what a replica keeps; asked while its lock is held."""

    def admit_cell(self, key: CellKey, size_bytes: int) -> None:
        """Raise if there is no room to hold a cell of so many bytes."""

    def make_room(self, size_bytes: int) -> None:
        """Drop what may be dropped for a commit of so many bytes; raise if that is not enough."""


class RefusedPushes:
    """Commits and cells of one robot that the server refused, and that are not sent again at once; for one thread.

    A refused commit stays in the outbox. Some refusals pass (an admin gives more room, a newer server takes more), and
    no server says so: after an hour, at the next start, and on another server a commit is tried again.
    """

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._commits: dict[CommitId, tuple[CairnError, float]] = {}
        self.cells: set[tuple[CellKey, str]] = set()
        """Cells, with their fingerprints, by which the server would not be healed."""

    def note(self, commit: CommitId, refusal: CairnError) -> None:
        """Note that the server refused a commit; it rests if that was for its bytes or its time."""
        if refusal.kind == BAD_CLOCK and isinstance(refusal, UnreachableError):
            self._commits[commit] = refusal, self._steady_s() + min(refusal.retry_after_s or EARLY_S, REST_S)
        elif refusal.kind in KINDS_OF_MARKS or (
            isinstance(refusal, BadInputError) and refusal.kind not in KINDS_OF_ALL
        ):
            self._commits[commit] = refusal, self._steady_s() + REST_S

    def of(self, commit: CommitId) -> CairnError | None:
        """The refusal for which a commit rests; None if it does not rest."""
        refusal, until_s = self._commits.get(commit, (None, 0.0))
        if refusal is not None and self._steady_s() >= until_s:
            del self._commits[commit]
            return None
        return refusal

    def of_marks(self) -> tuple[CommitId, CairnError] | None:
        """A commit that was refused for its marks, and not taken since, with the refusal; called by any thread."""
        found = self._commits.copy().items()
        return next(((commit, said) for commit, (said, _) in found if said.kind in KINDS_OF_MARKS), None)

    def forget_commits(self) -> None:
        """Try all commits again: another server may take them."""
        self._commits.clear()


class Replica:
    """One robot's durable state and its view of the map."""

    def __init__(
        self,
        store: ReplicaStore,
        *,
        robot: RobotName,
        map_name: str,
        geometry: Geometry,
        epoch_s: int | None = None,
        amendable: Callable[[], Iterable[CommitId]] = tuple,
        memory_bytes_max: int | None = None,
        keep_acked_s: float = KEEP_ACKED_S,
    ) -> None:
        """Open or make the state.

        Args:
            store: file of the robot.
            robot: its name.
            map_name: name of the map on its server.
            geometry: grid of the map.
            epoch_s: length of its epochs, seconds; None: it has none.
            amendable: returns commits that may still be amended: their bytes are kept, to subtract them at once.
            memory_bytes_max: size of the view from which on no more cells of the server are read from the disk; None:
                any.
            keep_acked_s: least seconds, by the store's age, for which an acknowledged commit keeps its bytes.

        Raises:
            BadInputError: kind `other_replica`: the file is of another robot, map or grid.
        """
        self._lock = threading.RLock()
        self.store = store
        self.state = ReplicaState(store)
        self.marks = MarkCopy(store)
        """Marks of the server's map."""
        self.attachments = AttachmentFolder(store.file.parent / ATTACHMENTS, size_bytes_max=ATTACHMENTS_BYTES_MAX)
        """Bytes of the attachments of own marks, until no restore of the server can lose them."""
        self.layer = MapLayer(geometry=geometry, epoch_s=epoch_s)
        self._keep_acked_s = keep_acked_s
        self._memory_bytes_max = memory_bytes_max
        self.state.identify(robot=robot, map_name=map_name, layer=self.layer)
        self._budget: StorageBudget | None = None
        self.outbox = Outbox(self.state, robot, self.layer, make_room=self._make_room, amendable=amendable)
        self._base = self._opened_base()
        self.header: ReplyHeader | None = self.state.header
        """Newest state that the server reported."""
        self.refusals = RefusedPushes()
        self._snapshot: MapSnapshot | None = None
        self._rests_next_s = store.age_s() + IDLE_S

    def _opened_base(self) -> ServerCells:
        return ServerCells(
            self.state, self.outbox, self.layer, admit=self._admit, memory_bytes_max=self._memory_bytes_max
        )

    def take_epochs(self, layer: MapLayer) -> None:
        """Go on as a robot of a map with epochs, of the same grid, whose epochs it did not know.

        Its commits until now state no epoch: they are of the base there, as those of any robot that never learnt the
        server's time.

        Raises:
            BadInputError: kind `other_replica`: another grid, or it holds something of a server's map.
        """
        with self._lock:
            if self.header is not None or self.layer.has_epochs or layer.geometry != self.geometry:
                raise BadInputError("other_replica", f"the robot's folder is of a map with {self.layer}, not {layer}")
            self.state.epoch_s = layer.epoch_s
            self.layer = layer
            self.outbox.take_layer(layer)
            self._base, self._snapshot = self._opened_base(), None

    @contextmanager
    def changing(self) -> Iterator[ServerCells]:
        """The server's cells as they are held here, to read and change while no other thread does."""
        with self._lock:
            yield self._base

    def obey(self, budget: StorageBudget) -> None:
        """Keep to these bounds from here on."""
        with self._lock:
            self._budget = budget

    @property
    def author(self) -> Author:
        """The robot in its present incarnation."""
        with self._lock:
            return self.outbox.author

    @property
    def geometry(self) -> Geometry:
        """Grid of the map."""
        return self.layer.geometry

    @property
    def view(self) -> HistoryMap:
        """Evidence that the robot shows; it changes with each commit and each frame."""
        return self._base.view

    @property
    def default_cursor(self) -> Cursor | None:
        """Cursor of every cell that is not held."""
        with self._lock:
            return self._base.default_cursor

    @property
    def cells(self) -> dict[CellKey, BaseCell]:
        """Cells of the server that are held now, without their bytes."""
        with self._lock:
            return dict(self._base.cells)

    @property
    def commits(self) -> list[CommitId]:
        """Commits whose bytes are kept, oldest first."""
        with self._lock:
            return [kept.id for kept in self.outbox]

    def cell(self, key: CellKey) -> BaseCell | None:
        """A cell of the server, without its bytes; None if it is not held."""
        with self._lock:
            return self._base.cells.get(key)

    def fingerprints(self) -> dict[CellKey, Fingerprint]:
        """Fingerprints of the cells that are held now."""
        with self._lock:
            return {key: cell.fingerprint for key, cell in self._base.cells.items()}

    def base_history(self, key: CellKey) -> CellHistory:
        """The server's evidence of a cell; none if its bytes are damaged, which its fingerprint shows."""
        with self._lock:
            return self._base.history(key)

    def base_evidence(self, key: CellKey) -> Evidence:
        """`base_history`, all rows summed."""
        return self.base_history(key).total(self.geometry)

    def commit(
        self,
        diff: Mapping[CellKey, Evidence],
        facts: CommitFacts = NO_FACTS,
        *,
        profile: Profile = Profile.FAST,
        notes: Mapping[str, str] = NO_NOTES,
    ) -> Commit:
        """Keep evidence as the next commit, durably, and see it in the view.

        Args:
            diff: packed evidence by cell.
            facts: what the commit states about itself.
            profile: effort spent on the size of its bytes.
            notes: texts by key to remember in the same transaction.

        Raises:
            BadInputError: the commit would be too large, its note too long, or it retracts what is not this robot's.
            UnreachableError: there is no room for it.
        """
        with self._lock:
            commit = self.outbox.add(diff, facts, seen=self.default_cursor, profile=profile, notes=notes)
            self._base.show_commit(commit, {key: diff[key] for key in commit.cells})
            return commit

    def amend(
        self,
        target: CommitId,
        diff: Mapping[CellKey, Evidence],
        facts: CommitFacts,
        *,
        profile: Profile,
        T_map_rig: npt.NDArray[np.float64] | None = None,
    ) -> Commit:
        """Keep evidence as a commit that takes the place of what stands for another one; as `Outbox.amend`."""
        with self._lock:  # the sync may give the target another id, but not meanwhile
            commit = self.outbox.amend(
                target, diff, facts, seen=self.default_cursor, profile=profile, T_map_rig=T_map_rig
            )
            self._base.show_commit(commit, {key: diff[key] for key in commit.cells})
            return commit

    def retract(self, target: CommitId, facts: CommitFacts) -> Commit:
        """Keep a commit without evidence that takes out another one, or what stands for that; as `commit`.

        Raises:
            ConflictError: kind `taken_back`: it was taken out, and nothing stands for it.
        """
        with self._lock:
            return self.commit({}, replace(facts, retracts=(self._standing(target),)))

    def mark(self, mark: Mark, *, instead_of: CommitId | None, attached: bytes = b"") -> Commit:
        """Keep a mark, perhaps in the place of what stands for an own commit with marks; as `commit`.

        Raises:
            UnreachableError: kind `outbox_full`: there is no room for its attachment.
            NotFoundError: kind `no_mark`: the commit brought no marks.
            ConflictError: kind `taken_back`, as of `retract`; or the server refuses marks of this robot, by its kind.
        """
        with self._lock:
            # Each commit that is refused for good leaves a gap in the numbers, of which a map takes few.
            if (refusal := self.refusals.of_marks()) is not None:
                commit, said = refusal
                raise ConflictError(said.kind, f"no more marks until the server takes {commit}: {said.message}")
            target = None if instead_of is None else self._standing(instead_of)
            if target is not None and self.outbox.knows(target) and not self.outbox.has_marks(target):
                raise NotFoundError("no_mark", f"{target} brought no marks that another could take the place of")
            if attached:  # before the mark that names it, so that a mark on its way has its bytes
                self.attachments.keep(attached)
            return self.commit({}, CommitFacts(marks=(mark,), retracts=() if target is None else (target,)))

    def named_attachments(self) -> frozenset[str]:
        """SHA-256, hex, of the attachments that marks of commits name whose bytes are kept."""
        with self._lock:
            return self.outbox.named_attachments()

    def _standing(self, target: CommitId) -> CommitId:
        """Commit that stands for another one, or itself; it can be taken out."""
        latest = self.outbox.successors.latest(target)
        if latest != target and not self.outbox.has_evidence(latest):
            raise ConflictError("taken_back", f"{target} was taken back before, by {latest}; there is nothing left")
        return latest

    def has_made(self, commit: CommitId) -> bool:
        """True if a commit was made in this folder, even if its bytes are gone."""
        with self._lock:
            return self.outbox.has_made(commit)

    def original_of(self, commit: CommitId, originals: Collection[CommitId]) -> CommitId | None:
        """Original of a commit: the one among `originals` that has the same successor; None if there is none.

        Raises:
            ConflictError: kind `taken_back`: it was taken back, and not by an amend.
        """
        with self._lock:
            return self.outbox.original_of(commit, originals)

    def unreplaced_commits(self) -> list[CommitId]:
        """Commits with bytes and cells that no other commit took out, oldest first."""
        with self._lock:
            successor = self.outbox.successors.of
            return [kept.id for kept in self.outbox if kept.cells and successor(kept.id) is None]

    def own_cells(self) -> set[CellKey]:
        """Cells that a kept commit touches."""
        with self._lock:
            return self.outbox.cells

    def push_set(self) -> list[CommitId]:
        """Commits that the server may lack, oldest first."""
        with self._lock:
            return self.outbox.push_set(self.header)

    def waiting_metas(self) -> list[CommitMeta]:
        """Metas of the own commits without cells that the copy of the marks may not know yet, oldest first."""
        with self._lock:
            copied = self.marks.cursor
            # A copy that was left behind: what the header covers may not be in it.
            is_behind = (
                copied is None or self.header is None or cursor_from_text(copied).seq < self.header.to_cursor.seq
            )
            covered = EMPTY if is_behind or self.header is None else self.header.coverage
            ids = [kept.id for kept in self.outbox if not kept.cells and kept.seal is None and kept.id not in covered]
            return [meta for commit in ids if (meta := self.outbox.meta(commit)) is not None]

    def behind(self) -> tuple[int, int]:
        """Number of own commits that the server may lack, and of those that it has, but not in its map yet."""
        with self._lock:
            pending = self.header.pending_vector.of_robots((self.author.robot,)) if self.header else EMPTY
            return len(self.outbox.push_set(self.header)), len(pending)

    def backlog(self) -> tuple[int, int]:
        """Number of the commits that the server may lack, and the size of their bytes."""
        with self._lock:
            waiting = self.push_set()
            return len(waiting), self.store.data_bytes(waiting)

    def kept_bytes(self) -> int:
        """Size of the commits whose bytes are kept."""
        with self._lock:
            return self.store.data_bytes(self.commits)

    def commit_data(self, commit: CommitId) -> bytes | None:
        """Bytes of a commit of the outbox; None if they are not there any more."""
        with self._lock:
            return self.store.commit_data(commit)

    def kept_commit(self, commit: CommitId) -> Commit | None:
        """A commit of the outbox, whole; None if it is not there any more."""
        with self._lock:
            return self.outbox.whole(commit)

    def acknowledge(self, commit: CommitId) -> None:
        """Note that the server has this commit for good."""
        with self._lock:
            self.outbox.acknowledge(commit)
            if is_to_be_taken(self.outbox, commit, coverage_of=self._base.coverage):
                self._base.refresh_commits([commit])

    def lacking_retracts(self) -> list[CommitId]:
        """The operator's commits that a restore could still lose, and that are not kept here yet.

        They are retracts and marks, without evidence, so that all of them are fetched; `RETRACTS_AT_ONCE` at most.
        """
        with self._lock:
            if self.header is None:
                return []
            unstable = self.header.coverage.of_robots((OPERATOR,)).minus(self.header.stable_vector)
            return list(islice((commit for commit in unstable if not self.outbox.knows(commit)), RETRACTS_AT_ONCE))

    def keep_sealed(self, commit: Commit, seal: str) -> None:
        """Keep a server's own retract, to push it back if the server loses it."""
        with self._lock:
            if not self.outbox.knows(commit.id):
                self.outbox.keep_sealed(commit, seal)
                self._base.refresh_commits(commit.meta.retracted_ids)

    def seal(self, commit: CommitId) -> str | None:
        """The seal that a kept commit bears."""
        with self._lock:
            return self.outbox.seal(commit)

    def signatures(self, commit: Commit) -> str | None:
        """The robot's signatures on its own commit, as `Cairn-Signature` has them; None for a server's retract."""
        with self._lock:
            return self.outbox.signatures(commit)

    def sign_bytes(self, message: bytes) -> tuple[Signature, ...]:
        """Signatures on a message by all keys of the robot, the present one first."""
        with self._lock:
            return self.outbox.sign_bytes(message)

    def rename(self, commit: CommitId) -> CommitId:
        """Give a commit whose id is taken on the server a new one; its coverage there was another commit's."""
        with self._lock:
            renamed = self.outbox.rename(commit)
            for key in renamed.cells:
                self._base.refresh(key)
            return renamed.id

    def take_header(self, header: ReplyHeader, *, asked_by: Author) -> None:
        """Note the newest state that the server reported.

        Args:
            header: of a reply or an index.
            asked_by: the author whose tip it states.

        Raises:
            BadInputError: it holds a text that cannot be parsed; nothing of it is kept, or each later round would fail.
        """
        header.check()
        with self._lock:
            with self.store.transaction():
                self.state.header = header
                self.store.keep_age()
            self.header = header
            self.outbox.check_tip(header, asked_by=asked_by)

    def forget_server(self) -> None:
        """Forget a server whose log was replaced (HTTP 410): hold nothing of it, and offer the new one every commit."""
        with self._lock:
            with self.store.transaction():
                self.store.drop_cells()
                self.store.clear_acked()
                self.state.header = None
                self.state.default_cursor = None
                self.state.default_coverage = None
            self.header = None
            shown = {*self._base.cells, *self.outbox.cells}
            self._base.forget()
            self.outbox.reread()
            self.refusals.forget_commits()
            # Another server does not know the first one's seal.
            self.outbox.forget([kept.id for kept in self.outbox if kept.seal is not None])
            for key in shown:
                self._base.refresh(key)

    def forget_stable_commits(self, *, wanted: Callable[[Cell], bool] | None = None) -> int:
        """Drop the bytes of commits that are stable and covered in every cell they touch (rule 12); their number.

        All that is the server's word, and a hostile one, or one whose clock jumped, may give it at once. So bytes stay
        for a least time after the acknowledgement, which passes by this robot's own steady clock.

        A commit that another kept commit takes out keeps its bytes: the server may have forgotten its evidence, and
        asks for it again. So does one that was never acknowledged: after a roll-back of this robot's disk, the stable
        and covered commit may be another one under the same id.

        Args:
            wanted: the cells that this robot keeps at all; default every one.
        """
        with self._lock:
            return self._forget_stable(wanted, acked_before_s=self.store.age_s() - self._keep_acked_s, at_most=None)

    def make_room_of_stable_commits(self, *, wanted: Callable[[Cell], bool]) -> int:
        """Drop the bytes of a few stable commits, the oldest first, however short ago they were acknowledged."""
        with self._lock:
            return self._forget_stable(wanted, acked_before_s=self.store.age_s(), at_most=FORGET_AT_ONCE)

    def _forget_stable(
        self, wanted: Callable[[Cell], bool] | None, *, acked_before_s: float, at_most: int | None
    ) -> int:
        stable = self.header.stable_vector if self.header else EMPTY
        gone = [
            kept.id
            for kept in self.outbox
            if kept.acked
            and kept.acked_age_s <= acked_before_s
            and kept.id in stable
            and self._is_covered(kept, wanted)
        ]
        named = self.outbox.named() if gone else set()
        gone = [commit for commit in gone if commit not in named][:at_most]
        self.outbox.forget(gone)
        return len(gone)

    def drop_cells(self, keys: Iterable[CellKey]) -> None:
        """Hold nothing of some held cells; the view shows of them what the robot made itself."""
        with self._lock:
            self._base.drop(keys)
            self._snapshot = None

    def snapshot(self, model: SensorModel | None = None, *, at_s: float | None = None) -> MapSnapshot:
        """The view as it is now, unmoved by what comes later, under the map's own sensor model or another one.

        With `at_s`, UTC seconds since 1970, as what was captured up to the end of that time's epoch shows it.

        Raises:
            ConflictError: kind `not_known`: a map without epochs holds one sum, and knows nothing of earlier times.
        """
        with self._lock:
            model = self.state.map_model() if model is None else model
            if at_s is not None:
                return snapshot_at(self.view, model, at_s)
            if self._snapshot is not None and self._snapshot.model == model:
                self._snapshot = self._snapshot.refreshed(self.view)
            else:
                self._snapshot = snapshot_of(self.view, model)
            return self._snapshot

    def rest(self) -> None:
        """Hold cells that did not change for a minute or two in little memory; called as often as one likes."""
        with self._lock:
            age_s = self.store.age_s()
            if age_s >= self._rests_next_s:
                self._rests_next_s = age_s + IDLE_S
                self.view.rest()

    def memory_bytes(self) -> int:
        """Memory of the view, and of the last snapshot besides the cells that they share."""
        with self._lock:
            frozen_bytes = self._snapshot.frozen.size_bytes if self._snapshot else 0
            return self.view.size_bytes + self.view.reading_bytes + frozen_bytes

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self.store.close()

    def _make_room(self, size_bytes: int) -> None:
        if self._budget is not None:
            self._budget.make_room(size_bytes)

    def _admit(self, key: CellKey, size_bytes: int) -> None:
        if self._budget is not None:
            self._budget.admit_cell(key, size_bytes)

    def _is_covered(self, kept: KeptCommit, wanted: Callable[[Cell], bool] | None) -> bool:
        needed = [key for key in kept.cells if wanted is None or wanted(cell_of_key(key))]
        base = self._base
        return all(base.cursor(key) is not None and kept.id in base.coverage(key) for key in needed)
