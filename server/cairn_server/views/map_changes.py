"""Changes of a map between two times, found cell by cell: rule R3 of `cairn_map.epochs.changes`.

    cell, and those around it that changed, too  -->  candidates of each  -->  those in the cell that stand together

Candidates are kept while their neighbours are looked at, within a bound of memory, and made again beyond it.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from cairn_map.arrays import Floats, Ints
from cairn_map.codec.layer_code import row_bodies
from cairn_map.epochs.changes import REACH, CellChanges, cell_changes, joined_changes, voxels_within
from cairn_map.epochs.epoch import BASE, Epoch, begin_s, epoch_of
from cairn_map.epochs.moment import time_from_text
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import CELL_LIMIT, CellKey, cell_key, cell_of_key, centres_of_voxels
from cairn_map.files.export_request import ExportRequest, cell_may_have
from cairn_map.wire.change_messages import CellVoxels, ChangeCounts, ChangesAnswer
from cairn_server.access.cancellation import CANCELLATION
from cairn_server.cell_room import DECODING
from cairn_server.folding.cells import CellFaults, Cells
from cairn_server.folding.cells_at_rest import sound_cell
from cairn_server.store.store import Snapshot, Store
from cairn_server.store.store_rows import CellRow, MapRow
from cairn_server.views.readings import rows_around

CHANGED_MAX = 1 << 16
"""Most voxels in an answer: some 3 MB."""
PARTS_BYTES = 64 << 20
"""Memory for the candidates of cells whose neighbours are still to be looked at."""
SEARCH_S = 10.0
SEARCHES_AT_ONCE = 2
WAIT_S = 5.0
"""Longest wait for another search."""
WAYS = ("appeared", "gone", "moved", "warmer", "colder")
AROUND = [step for step in product((-1, 0, 1), repeat=3) if any(step)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """The two times that are compared."""

    since_s: float
    until_s: float | None
    since: Epoch
    until: Epoch | None


def span_of(row: MapRow, since: str, until: str | None) -> Span:
    """Span of times as a request states them.

    Raises:
        BadInputError: kind `bad_time`: malformed, or the wrong way round; `bad_epoch`.
    """
    since_s, until_s = time_from_text(since), None if until is None else time_from_text(until)
    if until_s is not None and until_s < since_s:
        raise BadInputError("bad_time", f"changes are from an earlier time to a later one, got {since} to {until}")
    if row.epoch_s is None:
        return Span(since_s=since_s, until_s=until_s, since=BASE, until=None)
    first, last = epoch_of(since_s, row.epoch_s), None if until_s is None else epoch_of(until_s, row.epoch_s)
    # Time is known to an epoch: the answer says which times it really compared.
    return Span(
        since_s=begin_s(Epoch(first + 1), row.epoch_s),
        until_s=None if last is None else begin_s(Epoch(last + 1), row.epoch_s),
        since=first,
        until=last,
    )


class MapChangesSearch:
    """Searches for changes in the maps of a store; thread-safe."""

    def __init__(self, store: Store, cells: Cells) -> None:
        self._store = store
        self._cells = cells
        self._room = threading.BoundedSemaphore(SEARCHES_AT_ONCE)

    def asked(self, row: MapRow, since: str, until: str | None, box: str | None) -> ChangesAnswer:
        """Changes of a map after a time.

        Args:
            row: the map.
            since: end of the time before.
            until: end of the time after; None: now.
            box: x0,y0,z0,x1,y1,z1, metres; None: everywhere.

        Raises:
            BadInputError: kind `bad_time`, `bad_epoch`, `bad_box`; `too_large`: too many voxels changed; `too_costly`:
                it takes too long.
            ConflictError: kind `not_known`: evidence of that time is not kept apart any more.
            UnreachableError: kind `busy`.
            DamagedCellError: kind `damaged_store`: a cell is damaged.
        """
        span, asked = span_of(row, since, until), ExportRequest(box=box)
        bounds_m = asked.bounds_m()
        with self.turn(), self._cells.reading(row) as faults, self._store.snapshot(row) as snapshot:
            listed = {cell.key: cell for cell in snapshot.cells() if cell.voxels}
            search = _Search(snapshot, row, span, listed, faults, bounds_m, end_s=time.monotonic() + SEARCH_S)
            for key in listed:
                if cell_may_have(key, row.geometry, asked):
                    search.look(key)
            return search.answer()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Room for one search, or for a preview of a retract, for the length of a `with`.

        Raises:
            UnreachableError: kind `busy`: it did not come in time.
        """
        if not self._room.acquire(timeout=WAIT_S):
            raise UnreachableError("busy", "others are looking for changes", retry_after_s=1.0)
        try:
            yield
        finally:
            self._room.release()


@dataclass(slots=True)
class _Search:
    """One search under way."""

    snapshot: Snapshot
    row: MapRow
    span: Span
    listed: dict[CellKey, CellRow]
    """Cells of the snapshot that hold something."""
    faults: CellFaults
    bounds_m: tuple[Floats, Floats]
    end_s: float
    """Steady time at which it ends."""
    parts: OrderedDict[CellKey, CellChanges | None] = field(default_factory=OrderedDict)
    parts_bytes: int = 0
    found: dict[str, list[CellVoxels]] = field(default_factory=lambda: {way: [] for way in WAYS})
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WAYS, 0))

    def look(self, key: CellKey) -> None:
        """Add the changes of a cell."""
        own = self._part(key)
        if own is None:
            return
        # Together with what lies around its border: one voxel on, because no test looks farther.
        cell, side = np.array(cell_of_key(key)), self.row.geometry.side
        low, high = cell * side, (cell + 1) * side - 1
        near = (self._part(key) for key in self._keys_around(cell))
        parts = [part.within(low - REACH, high + REACH) for part in near if part is not None]
        changes = joined_changes([own, *parts])
        for way in WAYS:
            self._add(way, key, voxels_within(getattr(changes, way), low, high))

    def answer(self) -> ChangesAnswer:
        """All that was found."""
        span, counts = self.span, ChangeCounts.model_validate(self.counts)
        return ChangesAnswer(
            cursor=str(self.snapshot.head), since_s=span.since_s, until_s=span.until_s, counts=counts, **self.found
        )

    def _add(self, way: str, key: CellKey, voxels: Ints) -> None:
        centres_m = centres_of_voxels(voxels, self.row.geometry)
        low_m, high_m = self.bounds_m
        centres_m = centres_m[((centres_m >= low_m) & (centres_m <= high_m)).all(axis=1)]
        if not len(centres_m):
            return
        self.counts[way] += len(centres_m)
        if sum(self.counts.values()) > CHANGED_MAX:
            raise BadInputError(
                "too_large", f"more than {CHANGED_MAX} voxels changed; ask for a box, or a shorter time"
            )
        places = [(x, y, z) for x, y, z in np.round(centres_m, 6).tolist()]
        self.found[way].append(CellVoxels(cell=cell_of_key(key), centres_m=places))

    def _keys_around(self, cell: Ints) -> Iterator[CellKey]:
        around = (cell + np.array(AROUND)).tolist()
        inside = ((i, j, k) for i, j, k in around if all(-CELL_LIMIT <= n < CELL_LIMIT for n in (i, j, k)))
        yield from (key for each in inside if (key := cell_key(each)) in self.listed)

    def _part(self, key: CellKey) -> CellChanges | None:
        """Candidates of a cell; None: nothing of it was captured between the two times."""
        if key in self.parts:
            self.parts.move_to_end(key)
            return self.parts[key]
        CANCELLATION.get().check()
        if time.monotonic() > self.end_s:
            raise BadInputError("too_costly", f"comparing takes more than {SEARCH_S:g} s; ask for a box")
        part = self.parts[key] = self._made(key)
        self.parts_bytes += _size_bytes(part)
        while self.parts_bytes > PARTS_BYTES and len(self.parts) > 1:
            self.parts_bytes -= _size_bytes(self.parts.popitem(last=False)[1])
        return part

    def _made(self, key: CellKey) -> CellChanges | None:
        row, span = self.row, self.span
        stored = sound_cell(self.snapshot, key, row.layer, self.faults.healed)
        if stored is None or not self._is_between(stored):
            return None
        with DECODING.of_cell(row.geometry, stored.voxels):
            history = rows_around(self.snapshot, stored, row, span.since_s, span.until_s)
            return cell_changes(key, history, row.geometry, row.sensor_model, since=span.since, until=span.until)

    def _is_between(self, stored: CellRow) -> bool:
        """False if no row of a cell is of the time after: seen without decoding it."""
        span = self.span
        if not self.row.layer.has_epochs:
            return True
        epochs = row_bodies(stored.body, stored.key, self.row.layer)
        return any(span.since < epoch and (span.until is None or epoch <= span.until) for epoch in epochs)


def _size_bytes(part: CellChanges | None) -> int:
    return 100 if part is None else part.size_bytes
