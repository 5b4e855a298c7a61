"""What the server needs of a database: one protocol, so that every store passes one contract suite.

append    a validated commit, durable when it returns; touches no cell
pending   commits that are not folded yet, in order of arrival
fold      cells, log entries and the new head, all or nothing, only on top of the head that they were made from
snapshot  a view of one state of the map: header and frames of a reply come from one of these
"""

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Protocol

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import VersionVector
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.sensor_model import SensorModel
from cairn_map.wire.messages import LogEntry
from cairn_server.store.branch_notes import BranchNotes
from cairn_server.store.quota_store import Uses
from cairn_server.store.store_health import StoreHealth
from cairn_server.store.store_rows import (
    Branch,
    CellRow,
    Contribution,
    Fold,
    Head,
    MapRow,
    NewCommit,
    Selection,
    StoredCommit,
    Totals,
)
from cairn_server.store.token_store import AuditLog, Tokens


class Snapshot(Protocol):
    """One state of one map, for reading; close it before anything is written to a network."""

    @property
    def head(self) -> Head:
        """The state."""
        ...

    def chain_at(self, seq: int) -> bytes | None:
        """The chain after entry `seq` (0: of the empty log); None if there is no such entry."""
        ...

    def cell(self, key: CellKey) -> CellRow | None:
        """One cell with its body."""
        ...

    def cells(self, *, after_seq: int = -1, after_key: int = -1, limit: int | None = None) -> Iterator[CellRow]:
        """Cells changed after a log entry, of numbers above `after_key`, at most `limit`; without bodies, rising."""
        ...

    def contributions(self, key: CellKey, *, after_seq: int, newest: int | None = None) -> list[Contribution]:
        """Entries after `after_seq` that touch a cell, oldest first, at most so many of the newest.

        Those up to the cell's `gone_seq` may be missing.
        """
        ...

    def diff(self, number: int) -> bytes | None:
        """The bytes of a contribution; None if they are not kept any more."""
        ...

    def tip(self, author: Author) -> tuple[int, bytes] | None:
        """Highest folded number of an author and its SHA-256."""
        ...

    def commits_where(self, selection: Selection) -> list[CommitId]:
        """Every commit with evidence that fits and is not retracted, folded or not, in order of arrival."""
        ...

    def pending(self) -> VersionVector:
        """Commits that are durable but not folded, without those that are set aside as damaged."""
        ...

    def folded_before(self, time_s: float) -> VersionVector:
        """Commits folded before a time."""
        ...

    def retracting(self) -> list[CommitId]:
        """Commits that retract others."""
        ...

    def log(self, *, after_seq: int, limit: int) -> list[LogEntry]:
        """Log entries, oldest first."""
        ...

    def totals(self) -> Totals:
        """Sizes."""
        ...


class Store(Protocol):
    """A place for maps; every method may be called from any thread."""

    @property
    def tokens(self) -> Tokens:
        """Who may do what."""
        ...

    @property
    def audit_log(self) -> AuditLog:
        """Who did what."""
        ...

    @property
    def health(self) -> StoreHealth:
        """How it does."""
        ...

    @property
    def uses(self) -> Uses:
        """How much was pushed."""
        ...

    @property
    def notes(self) -> BranchNotes:
        """What else is kept of branches."""
        ...

    def create_map(self, name: str, geometry: Geometry, sensor_model: SensorModel) -> tuple[MapRow, bool]:
        """The map and whether it is new; an equal one may exist already.

        Raises:
            ConflictError: one of that name exists with another geometry or sensor model.
        """
        ...

    def map(self, name: str) -> MapRow:
        """The map of a name.

        Raises:
            NotFoundError: there is none.
        """
        ...

    def maps(self) -> list[MapRow]:
        """All maps, by name."""
        ...

    def append(self, row: MapRow, commit: NewCommit) -> bool:
        """`submit`, and wait."""
        ...

    def submit(self, row: MapRow, commit: NewCommit) -> Future[bool]:
        """Keep a commit; True if it is new, False if the same one is known already. Durable once that is known.

        One that was set aside as damaged is new again. Of a known one the evidence is kept again if it was gone.

        Raises:
            ConflictError: kind `id_taken`: the id is kept with other bytes; or `evidence_gone`: it retracts a commit
                whose evidence is not kept any more. Pushed again, with the same bytes, that is kept again.
            BadInputError: kind `evidence_overflow`: a sum could leave its range; or its number is refused by
                `push_policy.check_number`.
        """
        ...

    def append_built(self, row: MapRow, author: Author, build: Callable[[int], NewCommit]) -> NewCommit:
        """Keep a commit that `build(n)` makes for the author's next number n."""
        ...

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        """Commits to be folded, in order of arrival, with their diffs: at most `limit`, and one or within the size.

        None whose number is in `skip`.
        """
        ...

    def commit(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A commit with its diff, folded or not; None if there is none."""
        ...

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        """A folded commit with its diff, or None."""
        ...

    def forget_evidence(self, row: MapRow, *, before_s: float, limit: int) -> int:
        """Drop the evidence and the meta of up to `limit` commits folded, and last pushed, before a time; how many.

        Not of those that a pending commit retracts. Cells note the newest entry that this concerns (`gone_seq`).
        """
        ...

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        """Whether a retract of this id has taken effect, or waits for it to come."""
        ...

    def fold(self, row: MapRow, fold: Fold) -> bool:
        """Write a fold if the head is still its base; False (and nothing written) otherwise."""
        ...

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        """One state of the map."""
        ...

    def register(self, row: MapRow, branch: Branch, token_hash: bytes) -> None:
        """Make a branch and its token (`registration_name`), or give an existing one another secret."""
        ...

    def seen(self, row: MapRow, name: str, cursor: Cursor | None) -> None:
        """Note that a branch was heard of, and where it stands; may be written later."""
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

    def audit(self, what: str, detail: str) -> None:
        """Note something that an administrator may have to look into; may be written later."""
        ...

    def close(self) -> None:
        """Finish what was accepted and close."""
        ...
