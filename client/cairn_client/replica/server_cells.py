"""The server's cells as a robot holds them (their bases), and the view that it shows of them (SYNC.md rule 7).

    base     per cell the server's evidence at a cursor, and its coverage: the ids in it
    view     base + the commits in the outbox that the cell's coverage lacks, without what they take out

Most bases stand together at the map's own cursor (`standing_cells`), so that a round without news costs no cell.

A retract changes the view as soon as it is made, with or without a link: what it names is left out where the server
does not have it yet, and subtracted where the server has it and not yet the retract.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from cairn_client.replica.outbox import Addition, Outbox
from cairn_client.replica.replica_state import ReplicaState
from cairn_client.replica.replica_store import BaseCell, KeptCommit
from cairn_client.replica.standing_cells import StandingCells
from cairn_map.codec.cell_code import coding_of
from cairn_map.codec.layer_code import decode_layer_cell, encode_layer_cell, row_bodies
from cairn_map.codec.view_code import decode_view
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.cell_history import NOTHING, CellHistory, history_fingerprint, merged, unmerged
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import CairnError, DamagedDataError
from cairn_map.evidence.brick_cell import reading_cell
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.fingerprint import ZERO, Fingerprint
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import evidence_of_view

log = logging.getLogger(__name__)

UNPROVEN = BaseCell(None, EMPTY, ZERO)
"""An empty base that is to be replaced by the server's whole cell."""
DELTAS_MAX, DELTA_BYTES_MIN = 64, 1 << 18
"""Additions to a cell, and least bytes of them together, with which its bytes are written again."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A base as it is at rest."""

    history: CellHistory
    body: bytes
    """Bytes of just this evidence; empty: they lie in several parts."""
    size_bytes: int
    """Size of all parts."""


class ServerCells:
    """The server's cells as a robot holds them, and its view; called under the replica's lock."""

    def __init__(
        self,
        state: ReplicaState,
        outbox: Outbox,
        layer: MapLayer,
        *,
        admit: Callable[[CellKey, int], None],
        memory_bytes_max: int | None = None,
    ) -> None:
        """Show what is in the store; a cell whose bytes lost their fingerprint is to be fetched again (rule 15).

        Args:
            state: the robot's folder.
            outbox: its own commits.
            layer: the map's grid and epochs.
            admit: called before a cell of so many bytes is held; raises if there is no room for it.
            memory_bytes_max: size of the view from which on no more cells are read; None: any. The others are to be
                fetched again where the robot is.
        """
        self._state = state
        self._store = state.store
        self._outbox = outbox
        self._layer = layer
        self._admit = admit
        self.view = HistoryMap(layer, coding=coding_of(layer.geometry))
        """Evidence that the robot shows."""
        self.cells = StandingCells(self._store.cells(), state.default_cursor, state.default_coverage or EMPTY)
        """Cells that are held, without their bytes."""
        self._before: dict[CellKey, Fingerprint | None] = {}
        """Fingerprints of the cells that changed since `take_changes`, as they were then; None: not held."""
        for key, cell in list(self.cells.items()):
            if memory_bytes_max is not None and self.view.size_bytes > memory_bytes_max:
                self.hold_nothing(key, UNPROVEN)
                continue
            base = self._stored(key)
            if history_fingerprint(base.history, key, layer_word=layer.word) == cell.fingerprint:
                self._show(key, base)
            else:
                log.error("cell %s at rest is not what it was; asking for it again", cell_of_key(key))
                self.hold_nothing(key, UNPROVEN)
        for key in outbox.cells - self.cells.keys():
            self.refresh(key)

    @property
    def default_cursor(self) -> Cursor | None:
        """Cursor of every cell that is not held."""
        return self.cells.cursor

    def take_changes(self) -> list[CellKey]:
        """Cells whose fingerprint is not what it was at the last call, rising in number."""
        before, self._before = self._before, {}
        return sorted(key for key, sums in before.items() if sums != self._fingerprint(key))

    def _fingerprint(self, key: CellKey) -> Fingerprint | None:
        cell = self.cells.get(key)
        return None if cell is None else cell.fingerprint

    def cursor(self, key: CellKey) -> Cursor | None:
        """Cursor at which a cell stands; None if it is not proven."""
        cell = self.cells.get(key)
        return cell.cursor if cell else self.default_cursor

    def coverage(self, key: CellKey) -> VersionVector:
        """Ids that are in a cell's base; of a cell that is not held, since the server has none, those of its map."""
        return self.cells[key].coverage if key in self.cells else self._coverage_of_none(key)

    def _coverage_of_none(self, key: CellKey) -> VersionVector:
        # Of an own commit that was never acknowledged, the server may have other bytes under its id (rule 13).
        unproven = [kept.id for kept in self._outbox.touching(key) if not kept.acked]
        return self.cells.coverage.minus(EMPTY.with_commits(unproven))

    def history(self, key: CellKey) -> CellHistory:
        """The server's evidence of a cell; none if its bytes are damaged, which its fingerprint shows."""
        return self._stored(key).history

    def _stored(self, key: CellKey) -> Stored:
        body, deltas = self._store.body(key) or b"", self._store.deltas(key)
        size_bytes = len(body) + sum(map(len, deltas))
        try:
            parts = [decode_layer_cell(data, key, self._layer).history for data in (body, *deltas) if data]
            history = merged(parts, self._layer.geometry) if deltas else parts[0] if parts else NOTHING
        except CairnError as exc:
            log.error("cell %s at rest is damaged: %s", cell_of_key(key), exc.message)
            return Stored(NOTHING, b"", size_bytes)
        return Stored(history, b"" if deltas else body, size_bytes)

    def hold(self, key: CellKey, cell: BaseCell, history: CellHistory, *, body: bytes | None = None) -> None:
        """Make a cell's base this evidence, with its cursor and coverage, in one transaction, and show it."""
        data = body or encode_layer_cell(key, history, self._layer).data
        if len(history):
            self._admit(key, len(data))
        with self._store.transaction():
            self._store.put_cell(key, cell, body=data)
        self._put(key, cell)
        self._show(key, Stored(history, data, len(data)))

    def add(self, key: CellKey, cell: BaseCell, news: Sequence[Addition]) -> None:
        """Add evidence to a cell's base, with its cursor, coverage and fingerprint, in one transaction, and show it.

        Nothing of the whole cell is decoded or encoded: what is added lies next to its bytes until that is as much as
        they are, and in the view it is added to the sums.

        Raises:
            BadInputError: kind `evidence_overflow`; nothing was changed.
        """
        if key not in self.cells:
            body = news[0].data if len(news) == 1 else None
            self.hold(key, cell, merged([each.history for each in news], self._layer.geometry), body=body)
            return
        self._admit(key, sum(len(each.data) for each in news))
        shown = self._shown_by_adding(key, cell, news)
        with self._merging(key, shown or ()), self._store.transaction():
            self._store.put_deltas(key, cell, [each.data for each in news])
        self._put(key, cell)
        if shown is None:
            self.refresh(key)
        sizes = self._store.delta_sizes(key)
        if sizes.count > DELTAS_MAX or sizes.size_bytes > max(sizes.body_bytes, DELTA_BYTES_MIN):
            self._write_whole(key)

    def _shown_by_adding(self, key: CellKey, cell: BaseCell, news: Sequence[Addition]) -> list[Addition] | None:
        """Additions by which the view of a cell becomes that of its new base; None: it is to be made again."""
        before, after = (changes(self._outbox, key, coverage) for coverage in (self.coverage(key), cell.coverage))
        own = {each.commit for each in news}
        foreign = [each for each in news if each.commit is None]
        # Own commits that come into the base leave what is added to it: the view has them already.
        is_same = before.taken == after.taken and own - {None} <= set(before.added)
        is_same = is_same and tuple(commit for commit in before.added if commit not in own) == after.added
        # Where something was taken out voxels may become unknown, and whole rows empty.
        is_more = all((row.counts >= 0).all() for each in foreign for row in each.history.rows.values())
        return foreign if is_same and is_more and key in self.view else None

    @contextmanager
    def _merging(self, key: CellKey, news: Iterable[Addition]) -> Iterator[None]:
        """Context that has added evidence to the view; if it fails, the view is what it was."""
        with ExitStack() as undo:
            for each in news:
                bodies = row_bodies(each.data, key, self._layer)
                for epoch, row in each.history.rows.items():
                    self.view.merge({key: row}, epoch=epoch, bodies={key: bodies[epoch]})
                    undo.callback(self.view.unmerge, {key: row}, epoch=epoch)
            yield
            undo.pop_all()

    def _write_whole(self, key: CellKey) -> None:
        """Write a cell's bytes again, with all that was added to it."""
        history = self.history(key)
        if history_fingerprint(history, key, layer_word=self._layer.word) != self.cells[key].fingerprint:
            log.error("cell %s at rest is not what it was; asking for it again", cell_of_key(key))
            self.hold_nothing(key, UNPROVEN)
            return
        data = encode_layer_cell(key, history, self._layer).data
        with self._store.transaction():
            self._store.put_body(key, data)

    def hold_nothing(self, key: CellKey, cell: BaseCell) -> None:
        """Make a cell's base empty."""
        self.hold(key, cell, NOTHING)

    def _put(self, key: CellKey, cell: BaseCell) -> None:
        self._before.setdefault(key, self._fingerprint(key))
        self.cells.put(key, cell)

    def move(self, keys: Iterable[CellKey], *, to: Cursor | None, coverage: VersionVector | None) -> None:
        """Give held cells another cursor, and coverage unless None; their evidence stays."""
        moved = [key for key in keys if not self._stands_at(key, to, coverage)]
        if not moved:
            return
        # At rest, cells that stand together have no coverage of their own to keep.
        together = [key for key in moved if coverage is None and self.cells.is_together(key)]
        with self._view_of(self._outbox.cells_in_doubt.intersection(moved)):
            with self._store.transaction():
                self._store.move_cells(moved, to=to, coverage=coverage)
                self._store.move_cells(together, to=to, coverage=self.cells.coverage)
            for key in moved:
                self.cells.place(key, cursor=to, coverage=coverage)

    def _stands_at(self, key: CellKey, cursor: Cursor | None, coverage: VersionVector | None) -> bool:
        cell = self.cells[key]
        return cell.cursor == cursor and (coverage is None or cell.coverage == coverage)

    @contextmanager
    def _view_of(self, keys: Iterable[CellKey]) -> Iterator[None]:
        """Context in which the coverage of cells may change; after it, those of them are shown that look other now."""
        shown = {key: changes(self._outbox, key, self.coverage(key)) for key in keys}
        yield
        for key, before in shown.items():
            if changes(self._outbox, key, self.coverage(key)) != before:
                self.refresh(key)

    def drop(self, keys: Iterable[CellKey]) -> None:
        """Hold nothing of some held cells; the view shows of them what the robot made itself."""
        gone = list(keys)
        with self._store.transaction():
            for key in gone:
                self._store.put_cell(key, UNPROVEN, body=b"")
        for key in gone:
            self._put(key, UNPROVEN)
            self.refresh(key)

    def advance(
        self, to: Cursor, coverage: VersionVector, *, joining: Iterable[CellKey], staying: Iterable[CellKey]
    ) -> None:
        """Move the cells that stand together, and every cell that is not held, to a state, in one transaction.

        Of what is not held the server has no evidence then. What was taken out of all the server's cells is covered,
        too: else it would be shown again, once the commit that took it out need not be kept any more.

        Args:
            to: the state.
            coverage: commits in it.
            joining: held cells apart that move there, too; those that stand there already join without being named.
            staying: cells that stand together, and remain where they are.
        """
        cells, remaining = self.cells, list(staying)
        joined = list({*(key for key in joining if not cells.is_together(key)), *cells.standing_at(to, coverage)})
        has_changed = coverage != cells.coverage
        if not (joined or remaining or has_changed) and to == cells.cursor:
            return
        # Few cells can look other: those of own commits that wait. All others are not looked at one by one.
        moving = self._outbox.cells_in_doubt.difference(remaining)
        with self._view_of(key for key in moving if key not in cells.apart or key in joined):
            with self._store.transaction():
                if remaining:
                    self._store.move_cells(remaining, to=cells.cursor, coverage=cells.coverage)
                if joined:
                    self._store.join_cells(joined)
                self._state.default_cursor = to
                if has_changed:  # it may have thousands of authors
                    self._state.default_coverage = coverage
            cells.advance(to, coverage, joining=joined, staying=remaining)

    def forget(self) -> None:
        """Forget all cells, which the store does not hold any more, without a change of the view."""
        for key in self.cells:
            self._before.setdefault(key, self._fingerprint(key))
        self.cells.clear()

    def show_view(self, key: CellKey, data: bytes, model: SensorModel) -> None:
        """Show a cell that is not held as the server reads it, until its rows come (rule S6).

        Raises:
            DamagedDataError: the bytes are no view of this cell.
            BadInputError: they are of another version, too large, or of another style.
        """
        found, geometry = decode_view(data), self._layer.geometry
        if (found.key, found.voxel_edge_um, found.cell_depth) != (key, geometry.voxel_edge_um, geometry.depth):
            raise DamagedDataError("bad_view", f"expected a view of cell {cell_of_key(key)}, got another")
        reading = evidence_of_view(found.view, geometry, model)
        self.view.show(key, reading_cell(geometry, reading, model))

    def refresh(self, key: CellKey) -> None:
        """Make the view of a cell its base, changed by the commits that are kept (rule 7)."""
        self._show(key, self._stored(key))

    def _show(self, key: CellKey, base: Stored) -> None:
        shown = shown_history(self._outbox, key, base.history, self._layer, coverage=self.coverage(key))
        is_as_stored = base.body and len(base.history) and shown is base.history
        bodies = row_bodies(base.body, key, self._layer) if is_as_stored else {}
        self.view.replace(key, shown, bodies=bodies, came_bytes=base.size_bytes)

    def refresh_commits(self, commits: Iterable[CommitId]) -> None:
        """Make the view of all cells that some kept commits touch their base, changed by the commits that are kept."""
        for key in {key for commit in commits if (kept := self._outbox.kept(commit)) for key in kept.cells}:
            self.refresh(key)

    def show_commit(self, commit: Commit, diff: Diff) -> None:
        """Add a commit that was just kept to the view, and take out what it takes out."""
        self.view.merge(diff, epoch=commit.meta.row, bodies=commit.cells)
        for key, gone in taken_back(self._outbox, commit, coverage_of=self.coverage):
            # A retract takes evidence out of the rows in which it lies, those of its own epoch (rule T6).
            for epoch, evidence in gone.rows.items():
                self.view.unmerge({key: evidence}, epoch=epoch)


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


def shown_history(
    outbox: Outbox, key: CellKey, base: CellHistory, layer: MapLayer, *, coverage: VersionVector
) -> CellHistory:
    """Evidence of a cell in the view: its base, changed by the commits in the outbox that its coverage lacks."""
    found = changes(outbox, key, coverage)
    if not found.added and not found.taken:
        return base
    shown = merged([base, *(_sound_evidence(outbox, commit, key) for commit in found.added)], layer.geometry)
    for commit in found.taken:
        shown = unmerged(shown, _sound_evidence(outbox, commit, key), layer.geometry)
    return shown


def taken_back(
    outbox: Outbox, by: Commit, *, coverage_of: Callable[[CellKey], VersionVector]
) -> Iterator[tuple[CellKey, CellHistory]]:
    """Evidence that leaves the view once a commit is in the outbox, for each cell of each commit that it takes out."""
    for target in by.meta.retracted_ids:
        kept = outbox.kept(target)
        if kept is not None and outbox.successors.of(target) == by.id:
            for key in kept.cells:
                if kept.acked or target not in coverage_of(key):
                    yield key, _sound_evidence(outbox, target, key)


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


def _sound_evidence(outbox: Outbox, commit: CommitId, key: CellKey) -> CellHistory:
    """Evidence of a kept commit for a cell; none, with a line in the log, if the disk damaged it."""
    try:
        return outbox.history(commit, key)
    except DamagedDataError as exc:
        log.error("commit %s at rest is damaged and left out of cell %s: %s", commit, cell_of_key(key), exc.message)
        return NOTHING
