"""Protocols of a store: all that the server needs of a database, so that every store passes one contract suite.

append    a validated commit, durable when it returns; touches no cell
pending   commits that are not folded yet, in order of arrival
fold      cells, log entries and the new head, all or nothing, only on top of the head that they were made from
snapshot  a view of one state of the map: header and frames of a reply come from one of these
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Protocol

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId, Incarnation
from cairn_map.commits.version_vector import VersionVector
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.access_messages import AuditEntry
from cairn_map.wire.messages import LogEntry
from cairn_server.map_refusals import GoneMap
from cairn_server.store.admission import OWN_WORD, Grounds, RobotKey
from cairn_server.store.attachments.attachments import Attachments
from cairn_server.store.branch_signs import BranchNotes
from cairn_server.store.replica_notes import ReplicaNotes
from cairn_server.store.store_age import StoreAge
from cairn_server.store.store_clock import StoreClock
from cairn_server.store.store_rows import (
    ALL_LINES,
    AuditChoice,
    Backlog,
    Branch,
    CellRow,
    ChainedEntry,
    ClosedRobot,
    Contribution,
    Fold,
    MapRow,
    MarkBox,
    MarkChange,
    NamedCommit,
    NewCommit,
    Robot,
    RobotShares,
    Selection,
    StoredCommit,
    StoreFigures,
    Token,
    Totals,
    Use,
    UsedPart,
)
from cairn_server.store.tiles import Box


class Snapshot(Protocol):
    """One state of one map, for reading; close it before anything is written to a network."""

    @property
    def head(self) -> Cursor:
        """The state."""
        ...

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        ...

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        ...

    def hold_cells(self, keys: Collection[CellKey]) -> None:
        """Read some of these cells at once, if a store does better so, for `cell` to find them in memory."""
        ...

    def cells(
        self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None, box: Box | None = None
    ) -> Iterator[CellRow]:
        """Cells changed after a log entry, in a box, of numbers above `after_key`, at most `limit`.

        Without bodies, rising. Reads the tiles that changed since, and their cells.
        """
        ...

    def cells_of(self, keys: Collection[CellKey]) -> list[CellRow]:
        """Those of these cells that are stored, without their bodies, by rising number."""
        ...

    def fingerprint_sum(self, box: Box | None = None) -> Fingerprint:
        """Sum of the fingerprints of all cells, or of those in a box; reads tiles, and cells at the box's border."""
        ...

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest.

        Those up to the cell's `gone_seq` may be missing.
        """
        ...

    def named(self, commits: Sequence[CommitId]) -> list[NamedCommit]:
        """State of each of these commits, folded or not, in the same order; no evidence is read."""
        ...

    def touched_cells(self, commits: Iterable[CommitId]) -> frozenset[CellKey]:
        """Cells in which these commits have evidence that is kept; none of it is read."""
        ...

    def diff(self, commit: CommitId, key: CellKey) -> bytes | None:
        """The bytes of a commit's evidence in a cell; None if they are not kept any more."""
        ...

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        ...

    def newest_captured_s(self) -> float | None:
        """Latest time at which a commit in the map says that it was captured; None: none says it.

        Commits that were taken out do not count, nor do those that came over `CAPTURED_AHEAD_MAX_S` before that time.
        """
        ...

    def commits_where(self, selection: Selection) -> list[CommitId]:
        """Every commit with evidence that fits and is not retracted, folded or not, in order of arrival."""
        ...

    def pending(self) -> VersionVector:
        """Commits that are durable but not folded, without those that are set aside as damaged."""
        ...

    def vector_at(self, seq: int) -> VersionVector:
        """Ids of the commits folded at or before a log entry, at most the head's."""
        ...

    def seq_before(self, age_s: float) -> int:
        """Newest log entry with a commit that was folded before an age of the store; 0: there is none."""
        ...

    def log(self, *, after_seq: int, limit: int, names_max: int | None = None) -> list[LogEntry]:
        """Log entries, oldest first: the first one, and as many more as name so many commits together at most."""
        ...

    def chained(self, *, after_seq: int, limit: int) -> list[ChainedEntry]:
        """Log entries, oldest first, without what they say."""
        ...

    def marks(self, *, after_seq: int | None, limit: int, box: MarkBox | None = None) -> list[MarkChange]:
        """Marks that changed after a log entry, by entry and number: whole entries, so `limit` of them or more.

        After None, those of the map. With a box those whose own boxes overlap it. Fewer than `limit` are the last ones.
        """
        ...

    def totals(self) -> Totals:
        """Sizes, without reading through cells or commits."""
        ...


class FoldLeases(Protocol):
    """Claims of maps by processes that fold one store together.

    They save work and decide nothing: a fold is written only onto the state that it was made from.
    """

    def claim(self, maps: Sequence[MapRow], *, holder: str, new_max: int) -> list[MapRow]:
        """Claim maps for `LEASE_S` from now on: those that are claimed by this holder, and some that no other one has.

        Args:
            maps: wanted, in the order in which they are given.
            holder: name of the process, unlike all others.
            new_max: most maps that are claimed and were not before.
        """
        ...

    def release(self, *, holder: str) -> None:
        """End all claims of a holder."""
        ...


LEASE_S = 5.0
"""Seconds for which a claim of a map lasts: a process that was killed holds its maps up so long."""


class Uses(Protocol):
    """Use of quotas, read from the stored commits: nothing is counted twice or lost with the process."""

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """Use by each robot's commits that came after a time, and by what each relay handed over."""
        ...


class Shares(Protocol):
    """Accounts of what each robot holds of a map's bounds (`shares`)."""

    def of(self, row: MapRow) -> list[RobotShares]:
        """Use of its shares by every robot, and of the reserve, by name."""
        ...

    def full_sums(self) -> list[UsedPart]:
        """Shares of the sums of which more than half is used, of all maps; an idle map costs nothing."""
        ...

    def full_authors(self) -> list[UsedPart]:
        """The same of incarnations, intervals and robots, in few queries that read through all authors."""
        ...

    def regions(self, row: MapRow, robot: str) -> list[int]:
        """Regions (`shares.REGION_BITS`) in which a robot has evidence, pending or in the map, rising."""
        ...

    def close(self, row: MapRow, robot: str) -> ClosedRobot:
        """Close all authors of a robot, and move what they hold into the reserve. Durable on return.

        Raises:
            NotFoundError: kind `no_author`: it has none that is open.
            ConflictError: kind `reserve_full`; nothing was changed.
        """
        ...


class StoreHealth(Protocol):
    """State of a store, for administrators and probes."""

    def backlogs(self) -> list[Backlog]:
        """Commits that are not folded yet, or whose retract is under way, of the maps that have any."""
        ...

    def figures(self) -> StoreFigures:
        """Sizes now, and counts since the start."""
        ...

    def check_space(self, free_bytes_min: int) -> None:
        """Refuse pushes while less than this is free: folding what was accepted needs room, too.

        Raises:
            UnreachableError: kind `disk_full`.
        """
        ...

    def shrink(self) -> bool:
        """Give a bounded part of the file's unused room back to the disk; True while that is under way.

        It begins once much of the file is unused. A database does so itself, if at all.
        """
        ...

    def heal(self, row: MapRow, cell: CellRow) -> bool:
        """Replace a damaged cell by a sound one; False if the cell changed meanwhile. Durable on return."""
        ...

    def probe(self) -> None:
        """Write something that changes nothing, as durably as a commit.

        Raises:
            UnreachableError: it could not be written: `disk_full`, `store_failed`, `shutting_down`, `busy`.
        """
        ...


class Tokens(Protocol):
    """All tokens, by name and by the SHA-256 of their secrets."""

    def add(self, token: Token, secret_hash: bytes) -> None:
        """Store a new token, whose life begins at the present age of the store.

        Raises:
            ConflictError: kind `token_exists`.
        """
        ...

    def renew(self, name: str, secret_hash: bytes) -> Token:
        """Give a token another secret; the old one is invalid from then on.

        Raises:
            NotFoundError: kind `no_such_token`.
        """
        ...

    def remove(self, name: str) -> None:
        """Remove a token.

        Raises:
            NotFoundError: kind `no_such_token`.
        """
        ...

    def confirm(self, name: str) -> Token:
        """Let a restored token count again.

        Raises:
            NotFoundError: kind `no_such_token`.
        """
        ...

    def all(self) -> list[Token]:
        """All tokens, by name, ended ones included."""
        ...

    def of_hash(self, secret_hash: bytes) -> Token | None:
        """The token of a secret, ended or not."""
        ...

    def gone(self, secret_hash: bytes) -> GoneMap | None:
        """The deleted map with which the token of a secret ended; None: there was no such token."""
        ...

    def used(self, name: str) -> None:
        """Note that a token was shown just now; written some seconds later."""
        ...


class AdmittedKeys(Protocol):
    """Keys that robots' names are bound to, by map (`admission`); commits and registrations add to them."""

    def all(self, row: MapRow) -> list[RobotKey]:
        """All admitted keys, by robot and incarnation."""
        ...

    def of(self, row: MapRow, robot: str) -> dict[Incarnation, RobotKey]:
        """Admitted keys of a robot, by incarnation."""
        ...

    def admit(self, row: MapRow, author: Author, *, by: str) -> None:
        """Admit a key by an operator's word, with which the robot may register; durable on return."""
        ...


class AuditLog(Protocol):
    """Lines that are added and never changed, each with a hash over the one before; the newest are kept."""

    def add(self, who: str, what: str, detail: str, *, client: str = "") -> None:
        """Add a line, with the address that the request came from; durable on return."""
        ...

    def page(
        self, *, limit: int, after: int = 0, before: int | None = None, choice: AuditChoice = ALL_LINES
    ) -> list[AuditEntry]:
        """Lines of a choice numbered above `after`, oldest first; with `before` those below it, newest first."""
        ...


class Store(Protocol):
    """Store of maps; every method may be called from any thread."""

    @property
    def tokens(self) -> Tokens:
        """Tokens of the server."""
        ...

    @property
    def keys(self) -> AdmittedKeys:
        """Keys of the robots."""
        ...

    @property
    def audit_log(self) -> AuditLog:
        """Audit log of the server."""
        ...

    @property
    def health(self) -> StoreHealth:
        """State of the store."""
        ...

    @property
    def uses(self) -> Uses:
        """Use of the quotas."""
        ...

    @property
    def age(self) -> StoreAge:
        """Age of the store: the clock by which it forgets."""
        ...

    @property
    def clock(self) -> StoreClock:
        """Clock of the store: the time of day by which epochs are judged."""
        ...

    @property
    def shares(self) -> Shares:
        """Accounts of robots."""
        ...

    @property
    def attachments(self) -> Attachments:
        """Attachments of marks."""
        ...

    @property
    def leases(self) -> FoldLeases | None:
        """Claims of maps, if several processes may fold this store; None: one process has it."""
        ...

    @property
    def notes(self) -> BranchNotes:
        """Notes on branches."""
        ...

    @property
    def replicas(self) -> ReplicaNotes | None:
        """Notes that several servers of this store share; None: one process has it, and keeps such things itself."""
        ...

    def create_map(
        self, name: str, geometry: Geometry, sensor_model: SensorModel, epoch_s: int | None = None
    ) -> tuple[MapRow, bool]:
        """Create a map unless an equal one exists; the map, and whether it is new.

        Args:
            name: of the map.
            geometry: its grid and channels.
            sensor_model: constants by which its evidence is read.
            epoch_s: length of an epoch, seconds; None: one sum for all times.

        Raises:
            ConflictError: one of that name exists with another geometry, sensor model or length of epochs.
        """
        ...

    def map(self, name: str) -> MapRow:
        """The map of a name.

        Raises:
            NotFoundError: kind `no_map`: there is none, or `gone`: the last one of that name was deleted.
        """
        ...

    def delete_map(self, row: MapRow, *, by: str) -> GoneMap:
        """Take a map and its layers out of the store for good, and end their tokens; durable on return.

        Rows go later (`clear_deleted`). All that is asked of it later is `map_gone`; NotFoundError `gone`: it was gone.
        """
        ...

    def clear_deleted(self, *, size_bytes_max: int) -> bool:
        """Remove about so many bytes of what deleted maps left; False once nothing is left of them.

        A kill in between leaves the rest to the next call.
        """
        ...

    def maps(self) -> list[MapRow]:
        """All maps and all their further layers, by name."""
        ...

    def layers(self, row: MapRow) -> list[MapRow]:
        """Further layers of a map, by name."""
        ...

    def heads(self, numbers: Collection[int] | None = None) -> list[tuple[MapRow, Cursor]]:
        """All maps, or those of these numbers that there are, with their present states, by name; in one query."""
        ...

    def newest_epoch(self, row: MapRow) -> Epoch:
        """Newest epoch of the commits of a map, folded or not; `BASE` if none has one."""
        ...

    def waiting_maps(self) -> list[MapRow]:
        """Maps with commits to be folded, or with a retract under way, by name; an idle map costs nothing."""
        ...

    def next_waiting(self, *, after: int, limit: int) -> list[MapRow]:
        """Maps with commits to be folded whose numbers are above `after`, by number: the first `limit`."""
        ...

    def maps_with_evidence(self, *, before_s: float) -> list[MapRow]:
        """Maps with evidence of commits folded before an age of the store, by name; in one query."""
        ...

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """Keep a commit as `submit` does, and wait until it is durable."""
        ...

    def submit(self, row: MapRow, commit: NewCommit) -> Future[bool]:
        """Keep a commit; True if it is new, False if the same one is known already. Durable once that is known.

        One that was set aside as damaged is new again. Of a known one the evidence is kept again if it was gone.

        Raises:
            ConflictError: kind `id_taken`: the id is kept with other bytes; or `evidence_gone`: it retracts a commit
                whose evidence is not kept any more. Pushed again, with the same bytes, that is kept again. Or
                `other_layer` or `too_many_layers`: it defines one that the map cannot have.
            DeniedError: kind `not_admitted`: its author's name is bound to another key (`admission.check_commit`).
            BadInputError: kind `evidence_overflow`: its robot's share of the sums is taken; `too_many_marks`; or its
                number is refused by `numbering.check_number`.
        """
        ...

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""
        ...

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """Commits to be folded, in turn of their robots, with their diffs: at most `limit`, and one or within the size.

        First the oldest of each robot, then the second of each; none whose number is in `skip`. Folded ones whose
        retract is under way (`StoredCommit.due_from`) are among them, perhaps without their diffs.
        """
        ...

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        ...

    def kept_sha(self, row: MapRow, commit: CommitId) -> bytes | None:
        """SHA-256 of a commit whose bytes are not wanted, folded or not; None of any other. No evidence is read.

        They are kept, or its evidence is gone and it is taken out for good. Those of a damaged one are wanted.
        """
        ...

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        ...

    def forget_evidence(self, row: MapRow, *, before_s: float, limit: int) -> int:
        """Drop the evidence and the meta of up to `limit` commits folded, and last pushed, before an age; their count.

        Not of those that a pending commit retracts, or one whose retract is under way. Cells note the newest entry that
        this concerns (`gone_seq`).
        """
        ...

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """True if a retract of this id has taken effect, or waits for the commit to come."""
        ...

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if head and retracts are still where it begins; False (and nothing written) otherwise."""
        ...

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        """One state of the map."""
        ...

    def register(self, row: MapRow, branch: Branch, token_hash: bytes, grounds: Grounds = OWN_WORD) -> None:
        """Make a branch and its token (`registration_name`), or give an existing one another secret.

        Raises:
            DeniedError: kind `not_admitted`: the name is bound to another key (`admission.check_registration`).
        """
        ...

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note a sign of a branch, and its cursor if that is known; may be written later."""
        ...

    def deregister(self, row: MapRow, name: str) -> None:
        """Remove a branch and all tokens of its robot.

        Raises:
            NotFoundError: there is none of that name.
        """
        ...

    def branches(self, row: MapRow) -> list[Branch]:
        """All branches, by name."""
        ...

    def branch(self, row: MapRow, name: str) -> Branch | None:
        """One branch as it is stored: signs of the last seconds may be missing."""
        ...

    def keep_age(self) -> None:
        """Keep the age of the store, for the next start; may be written later."""
        ...

    def audit(self, what: str, detail: str, *, client: str = "") -> None:
        """Note something that an administrator may have to look into; may be written later."""
        ...

    def close(self) -> None:
        """Finish what was accepted and close."""
        ...
