"""The server's cells as a robot holds them (their bases), and the view that it shows of them (SYNC.md rule 7).

    base     per cell the server's evidence at a cursor, and its coverage: the ids in it
    view     base + the commits in the outbox that the cell's coverage lacks, without what they take out

A retract changes the view as soon as it is made, with or without a link: what it names is left out where the server
does not have it yet, and subtracted where the server has it and not yet the retract.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from cairn_client.replica.outbox import Outbox
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import BaseCell, KeptCommit
from cairn_map.codec.cell_code import coding_of, decode_cell, encode_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key

log = logging.getLogger(__name__)

UNPROVEN = BaseCell(None, EMPTY, ZERO)
"""An empty base that is to be replaced by the server's whole cell."""


class ServerCells:
    """The server's cells as a robot holds them, and its view; called under the replica's lock."""

    def __init__(
        self,
        state: ReplicaState,
        outbox: Outbox,
        geometry: Geometry,
        *,
        admit: Callable[[CellKey, int], None],
        memory_bytes_max: int | None = None,
    ) -> None:
        """Show what is in the store; a cell whose bytes lost their fingerprint is to be fetched again (rule 15).

        Args:
            state: the robot's folder.
            outbox: its own commits.
            geometry: the map's grid.
            admit: called before a cell of so many bytes is held; raises if there is no room for it.
            memory_bytes_max: size of the view from which on no more cells are read; None: any. The others are to be
                fetched again where the robot is.
        """
        self._state = state
        self._store = state.store
        self._outbox = outbox
        self._geometry = geometry
        self._admit = admit
        self.view = EvidenceMap(geometry, coding=coding_of(geometry))
        """Evidence that the robot shows."""
        self.default_cursor = state.default_cursor
        """Cursor of every cell that is not held."""
        self.cells: dict[CellKey, BaseCell] = self._store.cells()
        """Cells that are held, without their bytes."""
        for key, cell in list(self.cells.items()):
            if memory_bytes_max is not None and self.view.size_bytes > memory_bytes_max:
                self.hold_nothing(key, UNPROVEN)
                continue
            body = self._store.body(key)
            base = self._decoded(key, body)
            if fingerprint(base, key) == cell.fingerprint:
                self._show(key, base, body)
            else:
                log.error("cell %s at rest is not what it was; asking for it again", cell_of_key(key))
                self.hold_nothing(key, UNPROVEN)
        for key in outbox.cells - self.cells.keys():
            self.refresh(key)

    def cursor(self, key: CellKey) -> Cursor | None:
        """Cursor at which a cell stands; None if it is not proven."""
        cell = self.cells.get(key)
        return cell.cursor if cell else self.default_cursor

    def coverage(self, key: CellKey) -> VersionVector:
        """Ids that are in a cell's base."""
        return self.cells[key].coverage if key in self.cells else EMPTY

    def evidence(self, key: CellKey) -> Evidence:
        """The server's evidence of a cell; empty if its bytes are damaged, which its fingerprint shows."""
        return self._decoded(key, self._store.body(key))

    def _decoded(self, key: CellKey, body: bytes | None) -> Evidence:
        try:
            return decode_cell(body).evidence if body else empty_evidence(self._geometry)
        except CairnError as exc:
            log.error("cell %s at rest is damaged: %s", cell_of_key(key), exc.message)
            return empty_evidence(self._geometry)

    def hold(self, key: CellKey, cell: BaseCell, evidence: Evidence, *, body: bytes | None = None) -> None:
        """Make a cell's base this evidence, with its cursor and coverage, in one transaction, and show it."""
        data = body or encode_cell(key, evidence, self._geometry).data
        if len(evidence):
            self._admit(key, len(data))
        with self._store.transaction():
            self._store.put_cell(key, cell, body=data)
        self.cells[key] = cell
        self._show(key, evidence, data)

    def hold_nothing(self, key: CellKey, cell: BaseCell) -> None:
        """Make a cell's base empty."""
        self.hold(key, cell, empty_evidence(self._geometry))

    def move(self, keys: Iterable[CellKey], *, to: Cursor | None, coverage: VersionVector | None) -> None:
        """Give held cells another cursor, and coverage unless None; their evidence stays."""
        moved = list(keys)
        shown = {key: changes(self._outbox, key, self.coverage(key)) for key in moved}
        with self._store.transaction():
            self._store.move_cells(moved, to=to, coverage=coverage)
        for key in moved:
            cell = self.cells[key]
            self.cells[key] = replace(cell, cursor=to, coverage=cell.coverage if coverage is None else coverage)
            if changes(self._outbox, key, self.coverage(key)) != shown[key]:
                self.refresh(key)

    def drop(self, keys: Iterable[CellKey]) -> None:
        """Hold nothing of some held cells; the view shows of them what the robot made itself."""
        gone = list(keys)
        with self._store.transaction():
            for key in gone:
                self._store.put_cell(key, UNPROVEN, body=b"")
        for key in gone:
            self.cells[key] = UNPROVEN
            self.refresh(key)

    def set_default_cursor(self, cursor: Cursor) -> None:
        """Set the cursor of every cell that is not held."""
        self._state.default_cursor = cursor
        self.default_cursor = cursor

    def forget(self) -> None:
        """Forget all cells, which the store does not hold any more, without a change of the view."""
        self.cells.clear()
        self.default_cursor = None

    def refresh(self, key: CellKey) -> None:
        """Make the view of a cell its base, changed by the commits that are kept (rule 7)."""
        body = self._store.body(key)
        self._show(key, self._decoded(key, body), body)

    def _show(self, key: CellKey, base: Evidence, body: bytes | None) -> None:
        shown = shown_evidence(self._outbox, key, base, self._geometry, coverage=self.coverage(key))
        self.view.replace(key, shown, body=body if shown is base else None, came_bytes=len(body or b""))

    def refresh_commits(self, commits: Iterable[CommitId]) -> None:
        """Make the view of all cells that some kept commits touch their base, changed by the commits that are kept."""
        for key in {key for commit in commits if (kept := self._outbox.kept(commit)) for key in kept.cells}:
            self.refresh(key)

    def show_commit(self, commit: Commit, diff: dict[CellKey, Evidence]) -> None:
        """Add a commit that was just kept to the view, and take out what it takes out."""
        self.view.merge(diff, bodies=commit.cells)
        for gone in taken_back(self._outbox, commit, self._geometry, coverage_of=self.coverage):
            self.view.unmerge(gone)


@dataclass(frozen=True, slots=True)
class Changes:
    """Difference between the view of a cell and its base: commits to add and to take out, oldest first."""

    added: tuple[CommitId, ...]
    taken: tuple[CommitId, ...]


def changes(outbox: Outbox, key: CellKey, coverage: VersionVector) -> Changes:
    """Changes that the commits in the outbox make to a cell whose base has this coverage."""
    lacking = [kept for kept in outbox.touching(key) if kept.id not in coverage]
    return Changes(
        added=tuple(kept.id for kept in lacking if not _is_taken_out(outbox, kept, coverage)),
        taken=tuple(kept.id for kept in outbox.touching(key) if _is_due(outbox, kept, coverage)),
    )


def shown_evidence(
    outbox: Outbox, key: CellKey, base: Evidence, geometry: Geometry, *, coverage: VersionVector
) -> Evidence:
    """Evidence of a cell in the view: its base, changed by the commits in the outbox that its coverage lacks."""
    found = changes(outbox, key, coverage)
    if not found.added and not found.taken:
        return base
    cell = brick_cell(geometry, [base])
    for commit in found.added:
        cell.merge(_sound_evidence(outbox, commit, key, geometry))
    for commit in found.taken:
        cell.unmerge(_sound_evidence(outbox, commit, key, geometry))
    return cell.packed()


def taken_back(
    outbox: Outbox, by: Commit, geometry: Geometry, *, coverage_of: Callable[[CellKey], VersionVector]
) -> Iterator[dict[CellKey, Evidence]]:
    """Evidence that leaves the view once a commit is in the outbox, for each commit that it takes out."""
    for target in by.meta.retracted_ids:
        kept = outbox.kept(target)
        if kept is not None and outbox.successors.of(target) == by.id:
            shown = [key for key in kept.cells if kept.acked or target not in coverage_of(key)]
            yield {key: _sound_evidence(outbox, target, key, geometry) for key in shown}


def is_to_be_taken(outbox: Outbox, commit: CommitId, *, coverage_of: Callable[[CellKey], VersionVector]) -> bool:
    """True if a kept commit is subtracted in some cell."""
    kept = outbox.kept(commit)
    return kept is not None and any(_is_due(outbox, kept, coverage_of(key)) for key in kept.cells)


def _is_taken_out(outbox: Outbox, kept: KeptCommit, coverage: VersionVector) -> bool:
    """True if a commit that a base lacks is taken out by one that is here, or that is in the base already."""
    by = outbox.successors.of(kept.id)
    if by is None:
        return False
    # The bytes of the robot's own amend may go before those of the first commit: then the server has it, for good.
    is_own = by.author.robot == kept.id.author.robot
    return by in coverage or outbox.kept(by) is not None or (is_own and outbox.knows(by))


def _is_due(outbox: Outbox, kept: KeptCommit, coverage: VersionVector) -> bool:
    """True if a base has a commit, and lacks the commit that takes it out.

    Only if the server acknowledged its very bytes: otherwise the base may have others under its id (rule 13).
    """
    by = outbox.successors.of(kept.id)
    is_there = kept.id in coverage and kept.acked
    return is_there and by is not None and by not in coverage and outbox.kept(by) is not None


def _sound_evidence(outbox: Outbox, commit: CommitId, key: CellKey, geometry: Geometry) -> Evidence:
    """Evidence of a kept commit for a cell; empty, with a line in the log, if the disk damaged it."""
    try:
        return outbox.evidence(commit, key)
    except DamagedDataError as exc:
        log.error("commit %s at rest is damaged and left out of cell %s: %s", commit, cell_of_key(key), exc.message)
        return empty_evidence(geometry)
