"""Changes of a map between two times: the test of rule R3, never a mere comparison of two readings.

A voxel has appeared or gone if all of this holds:

    its readings before and after differ                     occupied or not
    G > 10.83                                                 likelihood ratio of hits among observations, p = 0.001,
    with at least 4 new observations                          at some epoch since then: those after it, and those
                                                              before it since the reading last changed
    at least 4 of the 27 voxels around it changed the same way

In a scene where nothing moved, readings alone differ in hundreds of voxels at each comparison, because poses and ranges
are noisy. Voxels next to one that was occupied (appeared) or is occupied now (gone) may be a surface seen from a pose
that is off by a voxel, and are reported apart, unless they touch a change that is farther from it: a crate's lowest
voxels lie next to the floor. Temperatures change where the readings of both times have samples enough.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.present import Present, present
from cairn_map.epochs.present_kernels import ALONE_MIN
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.grid import CellKey, Geometry, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds

G_MIN = 10.83
"""Least likelihood ratio: chi-squared of one degree of freedom at p = 0.001."""
NEW_MIN = 4
"""Least count of new observations of a voxel."""
TOGETHER_MIN = 4
"""Least count of voxels, of the 27 around one and itself, that changed the same way."""
REACH = 2
"""Voxels from one to the farthest that says what became of it: a neighbour's neighbour makes of it a rim or none."""
WARMER_K = 5.0
"""Least change of a temperature, kelvin: makers of uncooled cameras state an accuracy of 5 K."""
EXTENT_MAX = 1 << 62
"""Most voxels in the box around all cells that are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class MapChanges:
    """Voxels that changed between two times; each array is (N, 3) voxel numbers, rising."""

    appeared: Ints
    """Occupied now, and not before."""
    gone: Ints
    """Occupied before, and not now."""
    moved: Ints
    """Either of the two next to a surface that was or is there: mostly a pose that is off by a voxel."""
    warmer: Ints
    colder: Ints


@dataclass(frozen=True, slots=True, eq=False)
class CellChanges:
    """Voxels of one cell that may have changed, and those that are occupied; each array is (N, 3) voxel numbers."""

    appeared: Ints
    gone: Ints
    warmer: Ints
    colder: Ints
    was_occupied: Ints
    is_occupied: Ints

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return sum(getattr(self, each.name).nbytes for each in fields(self))

    def within(self, low: Ints, high: Ints) -> "CellChanges":
        """Part of it in a box of voxels, ends included."""
        return CellChanges(**{each.name: voxels_within(getattr(self, each.name), low, high) for each in fields(self)})


def voxels_within(voxels: Ints, low: Ints, high: Ints) -> Ints:
    """Those of (N, 3) voxels that are in a box, ends included."""
    return voxels[((voxels >= low) & (voxels <= high)).all(axis=1)]


def map_changes(
    cells: Mapping[CellKey, CellHistory],
    geometry: Geometry,
    model: SensorModel,
    *,
    since: Epoch,
    until: Epoch | None = None,
) -> MapChanges:
    """Changes of a map after an epoch.

    Args:
        cells: histories of the cells that are compared; at a border to others fewer voxels stand together.
        geometry: the map's.
        model: inverse sensor model of both readings.
        since: last epoch of the time before.
        until: last epoch of the time after; None: the newest.

    Raises:
        BadInputError: kind `too_large`: the box around the cells has more than `EXTENT_MAX` voxels.
    """
    parts = (cell_changes(key, cells[key], geometry, model, since=since, until=until) for key in cells)
    return joined_changes([part for part in parts if part is not None])


def joined_changes(parts: Sequence[CellChanges]) -> MapChanges:
    """Changes of the cells of these parts: candidates that stand together, and not next to a surface.

    Raises:
        BadInputError: kind `too_large`, as `map_changes`.
    """
    lattice = _Lattice([voxels for part in parts for voxels in (part.was_occupied, part.is_occupied)])
    was, now = (lattice.numbers([getattr(part, name) for part in parts]) for name in ("was_occupied", "is_occupied"))
    # What stands together; and of it, what stands at a surface of the other time.
    appeared = lattice.together([part.appeared for part in parts])
    gone = lattice.together([part.gone for part in parts])
    is_moved = (lattice.is_rim(appeared, was), lattice.is_rim(gone, now))
    return MapChanges(
        appeared=lattice.voxels(appeared[~is_moved[0]]),
        gone=lattice.voxels(gone[~is_moved[1]]),
        moved=lattice.voxels(np.concatenate([appeared[is_moved[0]], gone[is_moved[1]]])),
        warmer=lattice.voxels(lattice.together([part.warmer for part in parts])),
        colder=lattice.voxels(lattice.together([part.colder for part in parts])),
    )


def likelihood_ratio(before: Ints, after: Ints) -> Floats:
    """(N,) G of (N, 2) hits and misses before and after: twice the sum of O ln(O / E) over the four counts.

    It is 0 where either has no observations.
    """
    observed = np.stack([before, after], axis=1).astype(np.float64)
    rows, columns = observed.sum(axis=2, keepdims=True), observed.sum(axis=1, keepdims=True)
    expected = rows * columns / np.maximum(rows.sum(axis=1, keepdims=True), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(observed > 0, observed * np.log(observed / expected), 0.0)
    return np.asarray(2 * terms.sum(axis=(1, 2)))


def cell_changes(
    key: CellKey,
    history: CellHistory,
    geometry: Geometry,
    model: SensorModel,
    *,
    since: Epoch,
    until: Epoch | None = None,
) -> CellChanges | None:
    """Candidates of one cell, with arguments as of `map_changes`; None: nothing of it was captured after `since`."""
    history = history if until is None else history.until(until)
    if not any(epoch > since for epoch in history):
        return None
    before, now = present(history, geometry, model, at=since), present(history, geometry, model)
    # The voxels of `now` are all; where each was before.
    rows = np.searchsorted(now.voxels, before.voxels)
    was = np.zeros(len(now), np.bool_)
    was[rows] = before.occupied(model)
    occupied = now.occupied(model)
    # R3 a to c.
    flipped = np.nonzero(occupied != was)[0]
    is_sure = np.zeros(len(now), np.bool_)
    is_sure[flipped] = _is_likely(history, now.voxels[flipped], now.counts[flipped], since, model)
    warmth = _warming(before, now, rows, geometry)

    def numbers(mask: npt.NDArray[np.bool_]) -> Ints:
        return voxels_in_cell(now.voxels[mask], key, geometry)

    return CellChanges(
        appeared=numbers(occupied & ~was & is_sure),
        gone=numbers(was & ~occupied & is_sure),
        warmer=numbers(occupied & (warmth > WARMER_K)),
        colder=numbers(occupied & (warmth < -WARMER_K)),
        was_occupied=numbers(was),
        is_occupied=numbers(occupied),
    )


def _is_likely(
    history: CellHistory, voxels: npt.NDArray[np.uint32], counts: Ints, since: Epoch, model: SensorModel
) -> npt.NDArray[np.bool_]:
    """(N,) True where the observations after some epoch, not before `since`, differ from those until then.

    What changed long after `since` was first seen unchanged: against these observations, too, the new ones count. What
    came and went was free long before: only observations since the reading last changed say what it was until then.

    Args:
        history: the cell's.
        voxels: (N,) rising.
        counts: (N, 2) their hits and misses of all times.
        since: first epoch after which they may have changed.
        model: inverse sensor model of the reading.
    """
    found, old, left = np.zeros(len(voxels), np.bool_), np.zeros_like(counts), counts.copy()
    odds = np.zeros(len(voxels))
    steps = np.array([log_odds(model.p_hit), log_odds(model.p_miss)])
    low, high, border = log_odds(model.p_min), log_odds(model.p_max), log_odds(model.p_occupied)
    epochs = list(history)
    for epoch, following in zip(epochs, [*epochs[1:], None], strict=True):
        row = history.rows[epoch]
        at = np.minimum(np.searchsorted(row.voxels, voxels), len(row) - 1)
        seen = np.where((row.voxels[at] == voxels)[:, None], row.counts[at], 0)
        # R1, and whether the reading changes by this row.
        was_occupied = odds > border
        odds = np.clip(odds + seen @ steps, low, high)
        old = np.where(((odds > border) != was_occupied)[:, None], 0, old) + seen
        left -= seen
        # After this row lies a time at which they may have changed.
        if following is not None and following > since:
            found |= (likelihood_ratio(old, left) > G_MIN) & (left.sum(axis=1) >= NEW_MIN)
    return found


def _warming(before: Present, now: Present, rows: npt.NDArray[np.intp], geometry: Geometry) -> Floats:
    """(V,) kelvin by which the first temperature channel reads more than before; 0 where either has few samples."""
    means = np.full((2, len(now)), np.nan)
    channel = next((c for c in geometry.channels if c.kind is ChannelKind.TEMPERATURE), None)
    if channel is None:
        return np.zeros(len(now))
    planes = geometry.planes_of(channel.name)
    for n, (reading, places) in enumerate([(before, rows), (now, np.arange(len(now)))]):
        sums, weights = reading.samples[:, planes.start], reading.samples[:, planes.stop - 1]
        has = weights >= ALONE_MIN
        means[n, places[reading.sampled[has]]] = sums[has] / weights[has] * channel.step
    return np.asarray(np.nan_to_num(means[1] - means[0]))


class _Lattice:
    """Numbers of voxels in the box around some, with a margin of one, so that neighbours have known distances."""

    def __init__(self, voxels: list[Ints]) -> None:
        everything = np.concatenate([*voxels, np.zeros((0, 3), np.int64)])
        low, high = (
            (everything.min(axis=0), everything.max(axis=0)) if len(everything) else (np.zeros(3, np.int64),) * 2
        )
        self._low = low - 1
        self._sides = [int(side) for side in high - low + 3]
        if self._sides[0] * self._sides[1] * self._sides[2] > EXTENT_MAX:
            raise BadInputError("too_large", f"cells {self._sides} voxels apart cannot be compared at once; give a box")
        _, y, z = self._sides
        self._strides = np.array([y * z, z, 1], np.int64)
        steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        self._around = steps @ self._strides

    def numbers(self, parts: list[Ints]) -> Ints:
        """Numbers of voxels, rising."""
        voxels = np.concatenate([*parts, np.zeros((0, 3), np.int64)])
        return np.sort((voxels - self._low) @ self._strides)

    def voxels(self, numbers: Ints) -> Ints:
        """(N, 3) voxels of numbers, rising in number; the mirror of `numbers`."""
        rising = np.sort(numbers)
        _, y, z = self._sides
        return np.stack([rising // (y * z), rising // z % y, rising % z], axis=1) + self._low

    def together(self, parts: list[Ints]) -> Ints:
        """Numbers of the voxels around which, with themselves, there are `TOGETHER_MIN` of these at least."""
        numbers = self.numbers(parts)
        count = np.zeros(len(numbers), np.int64)
        for step in self._around:
            count += _isin(numbers + step, numbers)
        return numbers[count >= TOGETHER_MIN]

    def is_rim(self, changed: Ints, surface: Ints) -> npt.NDArray[np.bool_]:
        """(N,) True where a change is next to a surface of the other time, and to no change that is farther from it."""
        is_near = self.is_next_to(changed, surface)
        return is_near & ~self.is_next_to(changed, changed[~is_near])

    def is_next_to(self, numbers: Ints, others: Ints) -> npt.NDArray[np.bool_]:
        """(N,) True where one of the 26 voxels around a number is one of the others."""
        found = np.zeros(len(numbers), np.bool_)
        for step in self._around[self._around != 0]:
            found |= _isin(numbers + step, others)
        return found


def _isin(numbers: Ints, rising: Ints) -> npt.NDArray[np.bool_]:
    places = np.searchsorted(rising, numbers)
    found: npt.NDArray[np.bool_] = np.append(rising, -1)[places] == numbers
    return found
