"""Preview of a retract in a map: each voxel that would be shown otherwise, before anything is taken out.

    cell as it is          -->  its view
    cell less the commits  -->  its view      gone, appeared, warmer, colder, otherwise: exactly what differs

Views for a page are compared, not counts: a voxel of which hits go and which looks the same is no change to who looks.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from cairn_map.arrays import Ints
from cairn_map.commits.cursor import ENTRY_FOLD
from cairn_map.commits.ids import CommitId
from cairn_map.epochs.cell_history import CellHistory, unmerged
from cairn_map.epochs.present import shown_evidence
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.evidence.grid import CellKey, cell_of_key, centres_of_voxels
from cairn_map.evidence.view import View, view_of
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.wire.change_messages import CellVoxels, RetractChangeCounts, RetractChanges
from cairn_map.wire.messages import Retract
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.cell_room import DECODING, compared_bytes
from cairn_server.folding.cells import CellFaults, Cells
from cairn_server.folding.cells_at_rest import sound_cell, stored_history, sum_of_contributions
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import Contribution, MapRow
from cairn_server.sync.retracting import targets_of
from cairn_server.views.cell_views import page_reading
from cairn_server.views.map_changes import CHANGED_MAX, SEARCH_S
from cairn_server.views.readings import PAST_ENTRIES_MAX

WAYS = ("gone", "appeared", "warmer", "colder", "otherwise")
NO_HEAT = np.iinfo(np.int64).min
"""Temperature, or height of a level's surface, of a node that has none."""
NAMES_AT_ONCE = 256
"""Commits that are looked up in the store between two looks at the time."""


@dataclass(frozen=True, slots=True)
class _Bound:
    """End of a preview: by its time, or because its answer is not wanted any more."""

    end_s: float

    def check(self) -> None:
        """Go on, or end.

        Raises:
            BadInputError: kind `too_costly`: the time is over; `cut_off`: the client is gone.
            UnreachableError: kind `shutting_down`.
        """
        CANCELLATION.get().check()
        if time.monotonic() > self.end_s:
            raise BadInputError("too_costly", f"comparing takes more than {SEARCH_S:g} s; name fewer commits")


class RetractPreviews:
    """Previews of retracts in the maps of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells, *, turn: Callable[[], AbstractContextManager[None]]) -> None:
        """`turn` waits for the room that previews share with searches for changes."""
        self._store = store
        self._cells = cells
        self._turn = turn

    def asked(self, row: MapRow, request: Retract) -> RetractChanges:
        """Voxels that would look otherwise if a retract were folded now.

        Commits that are not folded, or are out already, change nothing.

        Raises:
            NotFoundError: kind `nothing_to_retract`.
            BadInputError: kind `not_retractable`; `too_large`: too many voxels change; `too_costly`: it takes too long,
                or a cell has too many of the commits.
            ConflictError: kind `evidence_gone`: evidence of a commit is not kept.
            UnreachableError: kind `busy`.
            DamagedCellError: kind `damaged_store`: a cell is damaged.
        """
        with self._turn(), self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            bound = _Bound(time.monotonic() + SEARCH_S)
            commits = _in_map(snapshot, targets_of(request, snapshot), bound)
            found: dict[str, list[CellVoxels]] = {way: [] for way in WAYS}
            counts: dict[str, int] = dict.fromkeys(WAYS, 0)
            for key in sorted(_touched_cells(snapshot, commits, bound)):
                bound.check()
                for way, voxels in _changes_of(snapshot, key, row, commits, faults, bound).items():
                    counts[way] += len(voxels)
                    if len(voxels):
                        found[way].append(_cell_voxels(key, voxels, row))
                if sum(counts.values()) > CHANGED_MAX:
                    raise BadInputError("too_large", f"more than {CHANGED_MAX} voxels change; name fewer commits")
            return RetractChanges(
                cursor=str(snapshot.head),
                commits=len(commits),
                counts=RetractChangeCounts.model_validate(counts),
                **found,
            )


def _parts(commits: Sequence[CommitId], bound: _Bound) -> Iterator[Sequence[CommitId]]:
    """Commits, a part at a time, each after a look at the time."""
    for start in range(0, len(commits), NAMES_AT_ONCE):
        bound.check()
        yield commits[start : start + NAMES_AT_ONCE]


def _in_map(snapshot: Snapshot, targets: list[CommitId], bound: _Bound) -> frozenset[CommitId]:
    """Those of the commits whose evidence is in the map."""
    looked_up = (each for part in _parts(targets, bound) for each in snapshot.named(part))
    named = [each for each in looked_up if each.is_folded and not each.is_retracted]
    gone = [str(each.id) for each in named if each.is_gone]
    if gone:
        raise ConflictError("evidence_gone", f"the evidence of {gone[0]} is not kept; who has it pushes it again first")
    return frozenset(each.id for each in named)


def _touched_cells(snapshot: Snapshot, commits: frozenset[CommitId], bound: _Bound) -> frozenset[CellKey]:
    """Cells in which these commits have evidence."""
    return frozenset(key for part in _parts(sorted(commits), bound) for key in snapshot.touched_cells(part))


def _changes_of(
    snapshot: Snapshot, key: CellKey, row: MapRow, commits: frozenset[CommitId], faults: CellFaults, bound: _Bound
) -> Mapping[str, Ints]:
    """Morton numbers of a cell's voxels that would be shown otherwise, by the way in which."""
    stored = sound_cell(snapshot, key, row.layer, faults.healed)
    if stored is None:
        return {}
    name, size_bytes = ",".join(map(str, cell_of_key(key))), compared_bytes(row.geometry, stored.voxels)
    if size_bytes > DECODING.limit_bytes:
        raise BadInputError("too_costly", f"cell {name} is too large to be compared")
    entries = _entries_of(snapshot, key, commits)
    if len(entries) > PAST_ENTRIES_MAX:
        raise BadInputError(
            "too_costly", f"in cell {name} are more than {PAST_ENTRIES_MAX} of the commits; name fewer commits"
        )
    with DECODING.of(size_bytes):
        # Decoding one after the other, 10 ms each; the cell itself after them, so that their sums are gone already.
        part = sum_of_contributions(snapshot, key, _while_wanted(entries, bound), row.layer).history()
        whole = stored_history(stored, row.layer)
        now, left = _view(whole, row), unmerged(whole, part, row.geometry)
        del whole, part
        return _differences(now, _view(left, row), has_heights=row.geometry.is_flat)


def _entries_of(snapshot: Snapshot, key: CellKey, commits: frozenset[CommitId]) -> list[Contribution]:
    """Entries of these commits that are in a cell."""
    entries = [each for each in snapshot.contributions(key, after_seq=0) if each.commit in commits]
    # A commit is folded again only after it was taken out, so what is in the cell is its last entry.
    last = {each.commit: each for each in entries}
    return [each for each in last.values() if each.kind == ENTRY_FOLD]


def _while_wanted(entries: list[Contribution], bound: _Bound) -> Iterator[Contribution]:
    """Entries, each after a look at the time."""
    for entry in entries:
        bound.check()
        yield entry


def _view(history: CellHistory, row: MapRow) -> View:
    evidence = shown_evidence(history, row.layer, row.sensor_model)
    shown, style = page_reading(row, evidence, row.geometry.depth)
    del evidence
    return view_of(shown, row.geometry, row.sensor_model, style)


def _differences(now: View, then: View, *, has_heights: bool) -> dict[str, Ints]:
    """Nodes that are in one of two views alone, or look different in them; another height is no other warmth."""
    mine, theirs = now.nodes.astype(np.int64), then.nodes.astype(np.int64)
    both, rows, other_rows = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
    before, after = _heats(now)[rows], _heats(then)[other_rows]
    are_warm = (before != NO_HEAT) & (after != NO_HEAT) & (not has_heights)
    warmer, colder = are_warm & (after > before), are_warm & (after < before)
    is_other = (_looks(now)[rows] != _looks(then)[other_rows]).any(axis=1) | (before != after)
    return {
        "gone": np.setdiff1d(mine, theirs, assume_unique=True),
        "appeared": np.setdiff1d(theirs, mine, assume_unique=True),
        "warmer": both[warmer],
        "colder": both[colder],
        "otherwise": both[is_other & ~warmer & ~colder],
    }


def _heats(view: View) -> Ints:
    """(V,) mean temperatures, or heights of a level, of a view's nodes, in its steps; `NO_HEAT`: none."""
    heats = np.full(len(view), NO_HEAT, np.int64)
    if len(view.scalar_rows):
        heats[view.scalar_rows] = view.scalar_steps.reshape(len(view.scalar_rows), -1)[:, 0]
    return heats


def _looks(view: View) -> Ints:
    """(V, 4) probabilities and colours of a view's nodes; -1: no colour."""
    looks = np.full((len(view), 4), -1, np.int64)
    looks[:, 0] = view.chances
    if len(view.coloured):
        looks[view.coloured, 1:] = view.rgb
    return looks


def _cell_voxels(key: CellKey, nodes: Ints, row: MapRow) -> CellVoxels:
    voxels = deinterleave(nodes.astype(np.uint64)) + np.array(cell_of_key(key)) * row.geometry.side
    centres_m = np.round(centres_of_voxels(voxels, row.geometry), 6)
    return CellVoxels(cell=cell_of_key(key), centres_m=[(x, y, z) for x, y, z in centres_m.tolist()])
