"""The reading of a cell's history: what is there now, or was at a time (rules R1, R2 and R4).

    l = 0;  row by row, rising in epoch:  l = clamp(l + hits l(p_hit) + misses l(p_miss))

So a wall that was seen 200 times is gone after nine misses of a later epoch, as OctoMap forgets, and yet the reading
does not depend on the order in which the rows came. A history of one row reads as that row under the sensor model.

Samples are not averaged over all times: the newest row's are shown, and older ones only where they are few and agree.
Votes for the heights of a level are the exception: of all times, for a column is read from the shares of its bins.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.epoch import BASE, Epoch, times_of_epochs
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present_kernels import add_counts_into, join_samples_into
from cairn_map.evidence.channels import HEIGHT_OFFSET, ChannelKind, planes_and_squares
from cairn_map.evidence.evidence import COUNT_MAX, Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds

SAMPLE_SIGMA = {
    ChannelKind.COLOUR: 12.0,
    ChannelKind.INTENSITY: 0.0,
    ChannelKind.TEMPERATURE: 0.5,
    ChannelKind.SCALAR: 0.0,
    ChannelKind.CLASSES: 0.0,
}
"""Standard deviation of one sample, in the channel's unit: sRGB steps of a textured surface, kelvin of an uncooled
camera. 0: unknown, so that only equal means are joined."""

JOINED_MIN = 8
"""Samples up to which older rows that agree are joined."""
FEW = 256
"""Share of a cell's voxels, as one of so many, below which sorting them is faster than a table of all."""


@dataclass(frozen=True, slots=True, eq=False)
class Present:
    """Reading of one cell: V voxels, rising, of which S have samples."""

    voxels: npt.NDArray[np.uint32]
    """(V,) Morton codes inside the cell."""
    log_odds: Floats
    """(V,) clamped log-odds; 0 where nothing but samples is known."""
    counts: npt.NDArray[np.int64]
    """(V, 2) hits and misses of all times that were read."""
    newest: npt.NDArray[np.int64]
    """(V,) newest epoch with hits or misses; the base where there are none."""
    sampled: npt.NDArray[np.uint32]
    """(S,) rows of `voxels` that have samples."""
    samples: npt.NDArray[np.int64]
    """(S, P) sums that are shown, in the planes of the geometry's channels."""
    sampled_in: npt.NDArray[np.int64]
    """(S, C) newest epoch whose samples of a channel are shown; the base where there are none."""

    def __len__(self) -> int:
        return len(self.voxels)

    def occupied(self, model: SensorModel) -> npt.NDArray[np.bool_]:
        """(V,) True where the probability is above the model's threshold."""
        return self.known & (self.log_odds > log_odds(model.p_occupied))

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(V,) True where there are hits or misses."""
        return np.asarray((self.counts != 0).any(axis=1))

    @property
    def evidence(self) -> Evidence:
        """The reading as evidence with `odds`, as all queries, views and files read it; counts end at `COUNT_MAX`."""
        return self._evidence(None)

    def dated_evidence(self, epoch_s: int) -> Evidence:
        """`evidence` with the times of its samples, in a map whose epochs are as long."""
        return self._evidence(times_of_epochs(self.sampled_in, epoch_s))

    def _evidence(self, measured_s: Floats | None) -> Evidence:
        counts = np.minimum(self.counts, COUNT_MAX).astype(np.int32)
        whole = Evidence(self.voxels, counts, self.sampled, self.samples, self.log_odds, measured_s)
        keep = self.known
        keep[self.sampled] = True
        return whole if keep.all() else whole.where(keep)


def present(history: CellHistory, geometry: Geometry, model: SensorModel, *, at: Epoch | None = None) -> Present:
    """Reading of a cell.

    Args:
        history: its rows, of which no number is negative.
        geometry: the map's.
        model: inverse sensor model, whose bounds clamp.
        at: last epoch that is read; None: all are.

    Returns:
        The reading; voxels of rows after `at` are not in it.
    """
    read = history if at is None else history.until(at)
    return present_of_rows(list(read.rows), list(read.rows.values()), geometry, model)


def present_of_rows(
    row_epochs: Sequence[Epoch], rows: Sequence[Evidence], geometry: Geometry, model: SensorModel
) -> Present:
    """`present` of rows, rising in epoch, that may be decoded whenever they are read: of each no array is kept."""
    epochs = np.array(row_epochs, np.int64)
    # R1: counts, oldest row first.
    voxels = voxels_of_rows(rows, geometry)
    read_counts = counts_of_rows(voxels, rows, model)
    # R4: samples, newest row first.
    shown = ShownSamples(len(voxels), geometry)
    for number in reversed(range(len(rows))):
        row = rows[number]
        shown.join(voxels, row.voxels[row.sampled], row.samples, number, read_counts.free_after)
    sampled = np.nonzero((shown.samples != 0).any(axis=1))[0]
    return Present(
        voxels=voxels,
        log_odds=read_counts.odds,
        counts=read_counts.counts,
        newest=_epochs_of(read_counts.newest, epochs),
        sampled=sampled.astype(np.uint32),
        samples=shown.samples[sampled],
        sampled_in=_epochs_of(shown.newest[sampled], epochs),
    )


class ReadCounts(NamedTuple):
    """Counts of V voxels, read row by row."""

    odds: Floats
    """(V,) clamped log-odds."""
    counts: npt.NDArray[np.int64]
    """(V, 2) sums of hits and misses."""
    newest: npt.NDArray[np.int32]
    """(V,) number of the newest row with counts; -1: none."""
    free_after: npt.NDArray[np.int32]
    """(V,) number of the newest row after which the voxel read free; -1: none."""

    def add(self, voxels: npt.NDArray[np.uint32], row: Evidence, number: int, model: SensorModel) -> None:
        """Read one more row, newer than those before; its voxels are among these (V,)."""
        steps = log_odds(model.p_hit), log_odds(model.p_miss)
        bounds = (*steps, log_odds(model.p_min), log_odds(model.p_max), log_odds(model.p_occupied))
        add_counts_into(voxels, row.voxels, row.counts, number, bounds, *self)


def counts_of_rows(voxels: npt.NDArray[np.uint32], rows: Sequence[Evidence], model: SensorModel) -> ReadCounts:
    """Counts of rows, the oldest first, at (V,) voxels, among which are all of the rows."""
    V = len(voxels)
    found = ReadCounts(np.zeros(V), np.zeros((V, 2), np.int64), np.full(V, -1, np.int32), np.full(V, -1, np.int32))
    for number, row in enumerate(rows):
        found.add(voxels, row, number, model)
    return found


def joined_samples(geometry: Geometry) -> npt.NDArray[np.int64]:
    """(C,) samples of each channel up to which older rows are joined: of a level's heights without end."""
    endless = [geometry.is_flat and channel == HEIGHT_OFFSET for channel in geometry.channels]
    return np.where(endless, np.iinfo(np.int64).max, JOINED_MIN).astype(np.int64)


class ShownSamples:
    """Samples of V voxels that rule R4 shows."""

    __slots__ = ("_done", "_joined", "_sigma", "_spec", "newest", "samples")

    def __init__(self, voxels: int, geometry: Geometry) -> None:
        channels = geometry.channels
        self._spec, self._joined = planes_and_squares(channels), joined_samples(geometry)
        if geometry.is_flat:  # votes, as those for classes
            self._spec = self._spec.copy()
            self._spec[[channel == HEIGHT_OFFSET for channel in channels], 2] = 1
        self._sigma = np.array([SAMPLE_SIGMA[channel.kind] / channel.step for channel in channels], np.float64)
        self._done = np.zeros((voxels, len(channels)), np.bool_)
        self.samples = np.zeros((voxels, geometry.plane_count), np.int64)
        """(V, P) sums."""
        self.newest = np.full((voxels, len(channels)), -1, np.int32)
        """(V, C) number of the newest row of which samples are shown; -1: none."""

    def join(
        self,
        voxels: npt.NDArray[np.uint32],
        row_voxels: npt.NDArray[np.uint32],
        row_samples: npt.NDArray[np.int64],
        number: int,
        free_after: npt.NDArray[np.int32],
    ) -> None:
        """Join one more row, older than those before, if it is to be.

        Args:
            voxels: (V,) rising.
            row_voxels: (S,) those of them that have samples in the row.
            row_samples: (S, P) their sums.
            number: of the row.
            free_after: `ReadCounts.free_after`.
        """
        join_samples_into(
            voxels,
            row_voxels,
            row_samples,
            number,
            self._spec,
            self._sigma,
            self._joined,
            free_after,
            self.samples,
            self.newest,
            self._done,
        )


def voxels_of_rows(rows: Sequence[Evidence], geometry: Geometry) -> npt.NDArray[np.uint32]:
    """(V,) voxels of all rows, rising."""
    if len(rows) == 1:
        return rows[0].voxels.copy()
    # A table of all voxels is much faster than sorting, unless they are few.
    count, top = sum(len(row) for row in rows), 8**geometry.depth
    if count * FEW < top:
        return np.unique(np.concatenate([np.empty(0, np.uint32), *(row.voxels for row in rows)]))
    there = np.zeros(top, np.bool_)
    for row in rows:
        there[row.voxels] = True
    return np.flatnonzero(there).astype(np.uint32)


def _epochs_of(numbers: npt.NDArray[np.int32], epochs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Epochs of rows' numbers; the base for -1."""
    return np.concatenate([epochs, [np.iinfo(np.int64).min]])[numbers]


def shown_evidence(history: CellHistory, layer: MapLayer, model: SensorModel, *, at: Epoch | None = None) -> Evidence:
    """Evidence of a cell as it is read: its sums in a map without epochs, else the dated reading of its rows.

    Args:
        history: its rows, of which no number is negative.
        layer: the map's.
        model: inverse sensor model of the reading.
        at: last epoch that is read; None: all are.
    """
    if layer.epoch_s is None:
        return history.rows.get(BASE) or empty_evidence(layer.geometry)
    return present(history, layer.geometry, model, at=at).dated_evidence(layer.epoch_s)
