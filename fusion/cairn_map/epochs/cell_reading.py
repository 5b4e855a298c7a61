"""The reading of one cell as its rows change: only the voxels that the newest row touched are read again (rule R5).

    older rows     at rest as bytes        closed: log-odds after them, and the samples that may yet be joined
    newest row     open, and growing       its sums at the touched voxels are added to what is closed, and clamped

It is, bit for bit, the reading that `present` makes of all rows. When another row than the newest changes, the cell is
read from its rows again. What is closed is made when the newest row first grows, and may be dropped at any time.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Words32
from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch, begin_s, times_of_epochs
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present import (
    JOINED_MIN,
    ReadCounts,
    ShownSamples,
    counts_of_rows,
    joined_samples,
    present,
    present_of_rows,
    voxels_of_rows,
)
from cairn_map.epochs.present_kernels import number_words_into
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell, reading_cell
from cairn_map.evidence.brick_counts import BrickCounts
from cairn_map.evidence.channels import planes_and_squares
from cairn_map.evidence.compact_cell import HeldCell, opened
from cairn_map.evidence.evidence import COUNT_MAX, Evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

HASH_BITS = 17
"""Bits of the hash table of log-odds: twice as many places as there can be different ones."""
SAMPLE_TYPES: tuple[type[np.integer[Any]], ...] = (np.uint8, np.int16, np.int32, np.uint32, np.int64)
Rows = Mapping[Epoch, HeldCell]
"""Rows of one cell in any order; they may be empty."""


class CellReading:
    """Reading of one cell under one sensor model, kept up to date; not thread-safe."""

    def __init__(
        self, geometry: Geometry, model: SensorModel, rows: Callable[[], Rows], *, at: Epoch | None = None
    ) -> None:
        """Make the reading of a cell, which is read when it is asked for.

        Args:
            geometry: the map's.
            model: inverse sensor model.
            rows: gives the cell's rows as they are, without copying or decoding them.
            at: last epoch that is read; None: all are.
        """
        self._geometry = geometry
        self._model = model
        self._rows = rows
        self._at = at
        self._cell: BrickCell | None = None
        self._closed: _ClosedRows | None = None
        self._changes: list[tuple[Epoch, Evidence, int]] = []
        self._change_bytes = 0

    def note(self, epoch: Epoch, diff: Evidence, sign: int) -> None:
        """Note that sign * diff was added to a row, 1 or -1."""
        if self._cell is not None and (self._at is None or epoch <= self._at):
            self._changes.append((epoch, diff, sign))
            self._change_bytes += diff.size_bytes
            # Where the reading is not asked for, its changes must not grow for ever.
            if self._change_bytes > self._cell.size_bytes:
                self.forget()

    def forget(self) -> None:
        """Have the cell read from its rows when it is asked for next."""
        self._cell, self._closed, self._changes, self._change_bytes = None, None, [], 0

    def rest(self) -> None:
        """Drop what only helps the newest row to grow on."""
        self._closed = None

    def cell(self) -> BrickCell:
        """The reading as it is now, to be read; a `copy` of it does not change."""
        if self._cell is not None and not self._changes:
            return self._cell
        rows = {epoch: row for epoch, row in self._rows().items() if self._at is None or epoch <= self._at}
        if self._cell is None or not self._revised(self._cell, rows):
            self._closed = None
            reading = present(_history(rows), self._geometry, self._model).evidence
            self._cell = reading_cell(self._geometry, reading, self._model)
        self._changes, self._change_bytes = [], 0
        return self._cell

    @property
    def is_current(self) -> bool:
        """True if nothing changed since the cell was last asked for."""
        return self._cell is not None and not self._changes

    @property
    def size_bytes(self) -> int:
        """Memory held besides the rows."""
        cell = self._cell.size_bytes if self._cell else 0
        return cell + self._change_bytes + (self._closed.size_bytes if self._closed else 0)

    def _revised(self, cell: BrickCell, rows: Rows) -> bool:
        """Bring the cell up to date with the changes; False if it must be read from its rows."""
        # All of one row, which is the newest.
        epoch = self._changes[0][0]
        if epoch not in rows or epoch != max(rows) or any(other != epoch for other, _, _ in self._changes):
            return False
        if self._closed is None or self._closed.newest != epoch:
            older = {mine: row for mine, row in rows.items() if mine != epoch}
            self._closed = _ClosedRows.of_rows(epoch, older, cell.counts, self._geometry, self._model)
        if self._closed is None:
            return False
        # Sums beyond 32 bits end there when they are read, so that a change cannot be added to them.
        try:
            diff = self._diff()
            was = cell.of_voxels(diff.voxels)
            if int(was.counts.max(initial=0)) == COUNT_MAX:
                return False
            row = opened(rows[epoch]).of_voxels(diff.voxels)
            now = self._closed.read(row, cell.counts, self._geometry, self._model)
            cell.revise(_change(diff, was, now))
        except BadInputError:
            return False
        return True

    def _diff(self) -> Evidence:
        """Sum of the changes."""
        if len(self._changes) == 1 and self._changes[0][2] == 1:
            return self._changes[0][1]
        total = BrickCell(self._geometry)
        for _, diff, sign in self._changes:
            (total.merge if sign == 1 else total.unmerge)(diff)
        return total.packed()


@dataclass(frozen=True, slots=True, eq=False)
class _ClosedRows:
    """All rows of a cell but the newest, as far as its reading needs them."""

    newest: Epoch
    """The row that is not among them."""
    codes: npt.NDArray[np.uint16]
    """(B, 512) log-odds after all of these rows, in the bricks of the reading: their numbers in the palette."""
    palette: Floats
    """(K,) different log-odds; 0 is the first."""
    samples: tuple["_Samples", ...]
    """Samples of the rows that may be joined, the newest row first."""

    @classmethod
    def of_rows(
        cls, newest: Epoch, rows: Rows, bricks: BrickCounts, geometry: Geometry, model: SensorModel
    ) -> "_ClosedRows | None":
        """Rows without the newest, in the bricks of their reading; None: their log-odds are too many different ones."""
        older = list(_history(rows).rows.values())
        voxels = voxels_of_rows(older, geometry)
        counts = counts_of_rows(voxels, older, model)
        palette, codes = np.zeros(1 << 16), np.zeros(len(voxels), np.uint16)
        table = np.zeros(1 << HASH_BITS, np.int32)
        found = number_words_into(counts.odds.view(np.uint64), table, 64 - HASH_BITS, palette.view(np.uint64), codes)
        if found < 0:
            return None
        dense = np.zeros((len(bricks.pool), 512), np.uint16)
        # A voxel in no brick was never hit or seen through: its log-odds are 0.
        numbers = bricks.brick_of[voxels >> np.uint32(9)]
        there = numbers >= 0
        dense[numbers[there], voxels[there] & np.uint32(511)] = codes[there]
        return cls(newest, dense, palette[:found].copy(), _joinable(older, voxels, counts, geometry))

    @property
    def size_bytes(self) -> int:
        return self.codes.nbytes + self.palette.nbytes + sum(samples.size_bytes for samples in self.samples)

    def read(self, row: Evidence, bricks: BrickCounts, geometry: Geometry, model: SensorModel) -> Evidence:
        """Reading of some voxels: these rows, and then the newest.

        Args:
            row: sums of the newest row at all of the voxels, zeros too.
            bricks: those of the reading; some may be newer than these rows' log-odds.
            geometry: the map's.
            model: inverse sensor model.

        Returns:
            Log-odds and samples of the voxels; the counts are the newest row's.
        """
        # R1: the log-odds so far, and the newest row on top. Rows have numbers: 0 for all that are closed, 1 for it.
        V = len(row)
        counts = ReadCounts(np.zeros(V), np.zeros((V, 2), np.int64), np.full(V, -1, np.int32), np.full(V, -1, np.int32))
        numbers = bricks.brick_of[row.voxels >> np.uint32(9)]
        here = np.flatnonzero((numbers >= 0) & (numbers < len(self.codes)))
        counts.odds[here] = self.palette[self.codes[numbers[here], row.voxels[here] & np.uint32(511)]]
        counts.add(row.voxels, row, 1, model)
        # R4: the newest row's samples, and then the others'.
        shown = ShownSamples(V, geometry)
        shown.join(row.voxels, row.voxels[row.sampled], row.samples, 1, counts.free_after)
        for samples in self.samples:
            here, places = _places(row.voxels, samples.voxels)
            shown.join(row.voxels, row.voxels[here], samples.sums(places), 0, counts.free_after)
        sampled = np.flatnonzero((shown.samples != 0).any(axis=1))
        return Evidence(row.voxels, row.counts, sampled.astype(np.uint32), shown.samples[sampled], counts.odds)


class _Samples(NamedTuple):
    """Samples of some voxels of one row, in as few bytes as they fit into."""

    voxels: Words32
    """(S,) rising."""
    planes: tuple[npt.NDArray[np.integer[Any]], ...]
    """P times (S,) sums, each plane in the smallest integers that hold it: of most planes 1 or 2 bytes."""

    @classmethod
    def of_sums(cls, voxels: Words32, sums: npt.NDArray[np.int64]) -> "_Samples":
        """Samples of (S,) voxels, 1 at least, from their (S, P) sums."""
        spans = zip(sums.min(axis=0).tolist(), sums.max(axis=0).tolist(), strict=True)
        types = [next(each for each in SAMPLE_TYPES if _holds(each, *span)) for span in spans]
        return cls(voxels, tuple(plane.astype(dtype) for plane, dtype in zip(sums.T, types, strict=True)))

    def sums(self, places: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
        """(n, P) sums at n places."""
        found = np.empty((len(places), len(self.planes)), np.int64)
        for number, plane in enumerate(self.planes):
            found[:, number] = plane[places]
        return found

    @property
    def size_bytes(self) -> int:
        return self.voxels.nbytes + sum(plane.nbytes for plane in self.planes)


def _holds(dtype: type[np.integer[Any]], low: int, high: int) -> bool:
    return int(np.iinfo(dtype).min) <= low and high <= int(np.iinfo(dtype).max)


def voxel_times_s(rows: Rows, voxels: Words32, epoch_s: int) -> Floats:
    """(V,) first instant of the newest epoch that hit or saw through voxels of a cell, UTC seconds since 1970.

    Args:
        rows: the cell's; the newest is decoded first, and older ones only for voxels that no newer one has.
        voxels: (V,) Morton codes inside the cell, in any order, also several times.
        epoch_s: length of the map's epochs, seconds.

    Returns:
        NaN where no row with a time has hits or misses.
    """
    seen, rising = np.full(len(voxels), np.nan), np.unique(voxels)
    for epoch in sorted(rows, reverse=True):
        left = np.isnan(seen)
        if epoch == BASE or not left.any():
            break
        counts = opened(rows[epoch]).counts.of_voxels(rising)
        is_seen = (counts != 0).any(axis=1)[np.searchsorted(rising, voxels)]
        seen[left & is_seen] = begin_s(epoch, epoch_s)
    return seen


def block_times_s(rows: Iterable[tuple[float, Evidence]], depth: int) -> Floats:
    """(8^(depth - 2),) newest time of each block of 4^3 voxels of a cell; NaN where no row with a time has evidence.

    Args:
        rows: times, UTC seconds since 1970 or NaN, and what was measured then, in any order.
        depth: octree depth of the cell's voxels.
    """
    times = np.full(8 ** (depth - 2), np.nan)
    for time_s, evidence in rows:
        blocks = np.unique(evidence.voxels >> np.uint32(6))
        times[blocks] = np.fmax(times[blocks], time_s)
    return times


def sample_times_s(rows: Rows, voxels: Words32, layer: MapLayer, model: SensorModel) -> Floats:
    """(V, C) first instant of the newest epoch of which samples of each channel are shown, UTC seconds since 1970.

    Args:
        rows: the cell's.
        voxels: (V,) Morton codes inside the cell, in any order, also several times.
        layer: a map's with epochs.
        model: inverse sensor model: samples of what was seen through since are not shown.

    Returns:
        NaN where no samples are shown, or none with a time.
    """
    epochs, rising = sorted(rows), np.unique(voxels)
    read = present_of_rows(epochs, [_among(rows[epoch].packed(), rising) for epoch in epochs], layer.geometry, model)
    times = np.full((len(rising), len(layer.geometry.channels)), np.nan)
    times[np.searchsorted(rising, read.voxels[read.sampled])] = times_of_epochs(read.sampled_in, layer.epoch_s or 0)
    return times[np.searchsorted(rising, voxels)]


def _among(evidence: Evidence, voxels: Words32) -> Evidence:
    """Evidence of some voxels, rising, as far as there is any."""
    keep = np.zeros(len(evidence), np.bool_)
    keep[_places(voxels, evidence.voxels)[1]] = True
    return evidence.where(keep)


def _history(rows: Rows) -> CellHistory:
    return cell_history({epoch: row.packed() for epoch, row in rows.items()})


def _places(voxels: Words32, among: Words32) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows of the voxels that are among others, and their places there; both rise."""
    places = np.searchsorted(among, voxels)
    is_there = places < len(among)
    is_there[is_there] = among[places[is_there]] == voxels[is_there]
    return np.flatnonzero(is_there), places[is_there]


def _joinable(
    rows: Sequence[Evidence], voxels: Words32, counts: ReadCounts, geometry: Geometry
) -> tuple[_Samples, ...]:
    """Samples of rows, the oldest first, that rule R4 may join to those of a newer one; the newest row's come first."""
    planes = planes_and_squares(geometry.channels)[:, 0]
    weights = np.cumsum(planes) - 1
    at_rows = [row.voxels[row.sampled] for row in rows]
    sampled = np.unique(np.concatenate([np.empty(0, np.uint32), *at_rows]))
    free_after = counts.free_after[np.searchsorted(voxels, sampled)]
    enough, joined = np.zeros((len(sampled), len(weights)), np.int64), joined_samples(geometry)
    found = []
    for number, (row, at) in reversed(list(enumerate(zip(rows, at_rows, strict=True)))):
        places, mine = np.searchsorted(sampled, at), row.samples[:, weights]
        # With as many samples as are joined, older ones are of no account; nor is what was seen through since.
        needed = ((mine > 0) & (enough[places] < joined)).any(axis=1) & (number >= free_after[places])
        enough[places] += np.minimum(mine, JOINED_MIN)
        if needed.any():
            found.append(_Samples.of_sums(at[needed], row.samples[needed]))
    return tuple(found)


def _change(diff: Evidence, was: Evidence, now: Evidence) -> Evidence:
    """Change of a reading for `BrickCell.revise`: the counts of `diff`, and the samples and log-odds of `now`."""
    samples = np.zeros((len(diff), diff.samples.shape[1]), np.int64)
    samples[now.sampled] = now.samples
    samples[was.sampled] -= was.samples
    sampled = np.flatnonzero((samples != 0).any(axis=1))
    return Evidence(diff.voxels, diff.counts, sampled.astype(np.uint32), samples[sampled], now.odds)
