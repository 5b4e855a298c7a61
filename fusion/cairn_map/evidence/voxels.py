"""Evidence read as physical values: one row per voxel, NaN where a value is unknown.

Floats begin here: probabilities are clamped here, means are taken here, and nowhere earlier.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.evidence.channels import Channel, ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, centres_of_voxels, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel

THERMAL_SIGMA_K = 1.0
"""Standard uncertainty of a thermal camera itself, kelvin, which no number of scans lowers: makers of uncooled
radiometric cameras state 2 K at best, two standard deviations, and a map does not know its cameras."""

CLEAR_LEAD = 2
"""Votes by which a class leads the next, at least, to be sure."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A channel's mean in its unit (N,) or (N, 3), and the weight (N,) behind it; NaN where the weight is 0.

    Of a channel of classes the mean is the number of the class with the most votes, of equal ones the smaller number.
    """

    channel: Channel
    mean: Floats
    weight: npt.NDArray[np.int64]
    spread: Floats | None = None
    """(N,) standard deviation of the samples, temperature only; 0 of a single sample."""
    measured_s: Floats | None = None
    """(N,) first instant of the epoch of the newest samples, UTC seconds since 1970, NaN where unknown; None: not asked
    for, or of a map without epochs."""
    unsure: npt.NDArray[np.bool_] | None = None
    """(N,) True where the class leads the next by less than two votes; of classes only."""

    @property
    def class_names(self) -> list[str | None]:
        """(N,) names of the classes; None where there are no votes, and of a channel of another kind."""
        return [self.name_at(row) for row in range(len(self.weight))]

    def name_at(self, row: int) -> str | None:
        """Name of the class of one voxel; None without votes, and of a channel of another kind."""
        names = self.channel.classes
        return names[int(self.mean[row])] if names and self.weight[row] > 0 else None

    @property
    def sigma(self) -> Floats | None:
        """(N,) standard uncertainty of one sample, temperature only: the samples' spread and the camera's own."""
        return None if self.spread is None else np.asarray(np.hypot(self.spread, THERMAL_SIGMA_K))

    def rows(self, rows: npt.NDArray[np.int64]) -> "Reading":
        """Reading of the voxels in these rows alone, in this order."""
        spread, measured_s = (None if array is None else array[rows] for array in (self.spread, self.measured_s))
        unsure = None if self.unsure is None else self.unsure[rows]
        return Reading(self.channel, self.mean[rows], self.weight[rows], spread, measured_s, unsure)


@dataclass(frozen=True, slots=True)
class Voxels:
    """N voxels of a map: numbers (N, 3), centres (N, 3) in metres, counts (N, 2), probability (N,), readings."""

    numbers: npt.NDArray[np.int64]
    centres_m: Floats
    counts: npt.NDArray[np.int32]
    probability: Floats
    readings: dict[str, Reading]

    def __len__(self) -> int:
        return len(self.numbers)

    def rows(self, rows: npt.NDArray[np.int64]) -> "Voxels":
        """Voxels in these rows alone, in this order."""
        readings = {name: reading.rows(rows) for name, reading in self.readings.items()}
        return Voxels(self.numbers[rows], self.centres_m[rows], self.counts[rows], self.probability[rows], readings)

    def of_kind(self, kind: ChannelKind) -> Reading | None:
        """The first reading of a kind, or None if the map has no such channel."""
        return next((r for r in self.readings.values() if r.channel.kind is kind), None)


def voxels_of_evidence(
    key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel, *, occupied_only: bool
) -> Voxels:
    """Voxels of one cell: all with evidence, or only the occupied."""
    samples = np.zeros((len(evidence), geometry.plane_count), np.int64)
    samples[evidence.sampled] = evidence.samples
    keep = evidence.occupied(model) if occupied_only else np.ones(len(evidence), np.bool_)
    numbers = voxels_in_cell(evidence.voxels[keep], key, geometry)
    counts = evidence.counts[keep]
    readings = {
        channel.name: reading_of_sums(channel, samples[keep][:, geometry.planes_of(channel.name)])
        for channel in geometry.channels
    }
    if evidence.measured_s is not None:
        times = np.full((len(evidence), len(geometry.channels)), np.nan)
        times[evidence.sampled] = evidence.measured_s
        dated = zip(readings.items(), times[keep].T, strict=True)
        readings = {name: replace(reading, measured_s=mine) for (name, reading), mine in dated}
    probability = evidence.probability(model, rows=keep)
    return Voxels(numbers, centres_of_voxels(numbers, geometry), counts, probability, readings)


def joined_voxels(parts: list[Voxels]) -> Voxels:
    """Voxels of several cells as one table; at least one part, all of one map."""
    readings = {name: joined_readings([part.readings[name] for part in parts]) for name in parts[0].readings}
    return Voxels(
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.centres_m for part in parts]),
        np.concatenate([part.counts for part in parts]),
        np.concatenate([part.probability for part in parts]),
        readings,
    )


def joined_readings(parts: Sequence[Reading]) -> Reading:
    """Readings of one channel as one; at least one part."""
    spread, measured_s = (_joined(arrays) for arrays in zip(*((r.spread, r.measured_s) for r in parts), strict=True))
    mean, weight = np.concatenate([r.mean for r in parts]), np.concatenate([r.weight for r in parts])
    doubts = [r.unsure for r in parts if r.unsure is not None]
    unsure = np.concatenate(doubts) if doubts else None
    return Reading(parts[0].channel, mean, weight, spread, measured_s, unsure)


def measured_or_none(reading: Reading, row: int) -> float | None:
    """Time of the newest samples of the voxel in a row, as messages state it; None: unknown."""
    measured_s = None if reading.measured_s is None else float(reading.measured_s[row])
    return None if measured_s is None or np.isnan(measured_s) else measured_s


def _joined(arrays: Sequence[Floats | None]) -> Floats | None:
    there = [array for array in arrays if array is not None]
    return np.concatenate(there) if there else None


def reading_of_sums(channel: Channel, sums: npt.NDArray[np.int64]) -> Reading:
    """Reading of (N, planes) sums of one channel."""
    if channel.kind is ChannelKind.CLASSES:
        return _class_reading(channel, sums)
    # mean = sum / weight; spread^2 = sum of squares / weight - mean^2.
    weight = sums[:, -1]
    divisor = np.where(weight > 0, weight, np.nan)
    values = sums[:, : channel.value_count] / divisor[:, None]
    mean = values * channel.step + channel.zero
    spread: Floats | None = None
    if channel.kind is ChannelKind.TEMPERATURE:
        variance = np.maximum(sums[:, 1] / divisor - values[:, 0] ** 2, 0)
        spread = np.sqrt(variance) * channel.step
    return Reading(channel, mean if channel.value_count > 1 else mean[:, 0], weight, spread)


def _class_reading(channel: Channel, sums: npt.NDArray[np.int64]) -> Reading:
    """Class with the most votes, of equal ones that of the smaller number; unsure if it leads by less than two."""
    weight = sums[:, -1]
    # The last class is what the votes for the others leave; clamped when read, never when merged.
    votes = np.concatenate([sums[:, :-1], np.maximum(weight - sums[:, :-1].sum(axis=1), 0)[:, None]], axis=1)
    best = votes.argmax(axis=1)
    second, first = np.partition(votes, -2, axis=1)[:, -2:].T
    has_votes = weight > 0
    number = np.where(has_votes, best, np.nan)
    return Reading(channel, number, weight, unsure=has_votes & (first - second < CLEAR_LEAD))
