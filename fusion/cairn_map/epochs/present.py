"""The reading of a cell's history: what is there now, or was at a time (rules R1, R2 and R4).

    l = 0;  row by row, rising in epoch:  l = clamp(l + hits l(p_hit) + misses l(p_miss))

So a wall that was seen 200 times is gone after nine misses of a later epoch, as OctoMap forgets, and yet the reading
does not depend on the order in which the rows came. A history of one row reads as that row under the sensor model.

Samples are not averaged over all times: the newest row's are shown, and older ones only where they are few and agree.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present_kernels import add_counts_into, join_samples_into
from cairn_map.evidence.channels import Channel, ChannelKind, planes_and_squares
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds

SAMPLE_SIGMA = {
    ChannelKind.COLOUR: 12.0,
    ChannelKind.INTENSITY: 0.0,
    ChannelKind.TEMPERATURE: 0.5,
    ChannelKind.SCALAR: 0.0,
}
"""Standard deviation of one sample, in the channel's unit: sRGB steps of a textured surface, kelvin of an uncooled
camera. 0: unknown, so that only equal means are joined."""


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
    epochs, rows = np.array([*read.rows], np.int64), list(read.rows.values())
    voxels = np.unique(np.concatenate([row.voxels for row in rows])) if rows else np.empty(0, np.uint32)
    # R1: counts, oldest row first.
    V, C = len(voxels), len(geometry.channels)
    odds, counts = np.zeros(V), np.zeros((V, 2), np.int64)
    newest, free_after = np.full(V, -1, np.int32), np.full(V, -1, np.int32)
    steps = (log_odds(model.p_hit), log_odds(model.p_miss))
    bounds = (*steps, log_odds(model.p_min), log_odds(model.p_max), log_odds(model.p_occupied))
    for number, row in enumerate(rows):
        add_counts_into(voxels, row.voxels, row.counts, number, bounds, odds, counts, newest, free_after)
    # R4: samples, newest row first.
    samples = np.zeros((V, geometry.plane_count), np.int64)
    sampled_in, done = np.full((V, C), -1, np.int32), np.zeros((V, C), np.bool_)
    spec, sigma = planes_and_squares(geometry.channels), _sigmas(geometry.channels)
    for number, row in reversed(list(enumerate(rows))):
        at_voxels = row.voxels[row.sampled]
        join_samples_into(voxels, at_voxels, row.samples, number, spec, sigma, free_after, samples, sampled_in, done)
    sampled = np.nonzero((samples != 0).any(axis=1))[0]
    return Present(
        voxels=voxels,
        log_odds=odds,
        counts=counts,
        newest=_epochs_of(newest, epochs),
        sampled=sampled.astype(np.uint32),
        samples=samples[sampled],
        sampled_in=_epochs_of(sampled_in[sampled], epochs),
    )


def _sigmas(channels: tuple[Channel, ...]) -> Floats:
    """(C,) standard deviation of one sample of each channel, in its steps."""
    return np.array([SAMPLE_SIGMA[channel.kind] / channel.step for channel in channels], np.float64)


def _epochs_of(numbers: npt.NDArray[np.int32], epochs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Epochs of rows' numbers; the base for -1."""
    return np.concatenate([epochs, [np.iinfo(np.int64).min]])[numbers]


def shown_evidence(history: CellHistory, layer: MapLayer, model: SensorModel, *, at: Epoch | None = None) -> Evidence:
    """Evidence of a cell as it is read: its sums in a map without epochs, else the reading of its rows.

    Args:
        history: its rows, of which no number is negative.
        layer: the map's.
        model: inverse sensor model of the reading.
        at: last epoch that is read; None: all are.
    """
    if not layer.has_epochs:
        return history.rows.get(BASE) or empty_evidence(layer.geometry)
    read = present(history, layer.geometry, model, at=at)
    return Evidence(read.voxels, read.counts.astype(np.int32), read.sampled, read.samples)
