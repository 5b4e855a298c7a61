"""Rays and distances through several layers, each place by the finest layer that knows it.

A ray ends at its first point that is occupied by the finest layer that knows the point. So it passes through the part
of a coarse occupied voxel that a finer layer knows as free, and ends in the rest of it. Layers of flat voxels are left
aside: they hold votes for heights, of which rays would see the bins.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats, Ints
from cairn_map.queries import distance_queries, point_queries
from cairn_map.queries.frozen_map import FrozenMap
from cairn_map.queries.occupancy_states import State

STEP_PART = 1e-6
"""Part of the finest voxel's edge by which a ray steps over a border, so that the point is inside of the next voxel."""


@dataclass(frozen=True, slots=True, eq=False)
class LayeredEnds:
    """Ends of N rays, or the nearest voxels of N points, in the layers of a map."""

    distance_m: Floats
    """(N,) metres; infinite where there is none."""
    points_m: Floats
    """(N, 3) where the ray ends, or the nearest point of the voxel, metres, map frame; NaN where there is none."""
    of_layer: Ints
    """(N,) place in `layers` of the layer whose voxel it is, where there is one."""
    layers: tuple[str, ...]
    """Names of the layers, the finest first."""

    @property
    def names(self) -> list[str | None]:
        """N names of the layers whose voxel it is; None where there is none."""
        found = zip(self.of_layer.tolist(), self.hit.tolist(), strict=True)
        return [self.layers[index] if is_hit else None for index, is_hit in found]

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """(N,) True where there is a voxel."""
        return np.isfinite(self.distance_m)


def cast_layers(
    layers: Mapping[str, FrozenMap], origins_m: npt.ArrayLike, directions: npt.ArrayLike, *, max_range_m: float
) -> LayeredEnds:
    """Ends of rays in layers of cubes, the finest first; as many origins as directions, or one of either.

    Raises:
        BadInputError: as `MapSnapshot.cast_rays`.
    """
    frozen = list(layers.values())
    # Checked once, and as one layer does; its ends are those of the finest layer, too.
    first = distance_queries.cast(frozen[0], origins_m, directions, max_range_m=max_range_m, ends_in_unknown=False)
    N, names = len(first.states), tuple(layers)
    if len(frozen) == 1:
        return LayeredEnds(first.distance_m, first.points_m, np.zeros(N, np.int64), names)
    origins, ways = (np.broadcast_to(np.asarray(each, np.float64), (N, 3)) for each in (origins_m, directions))
    units = distance_queries.units_of(ways)
    step_m = STEP_PART * frozen[0].geometry.voxel_edge_m
    # Next occupied voxel of each layer, which holds for as long as the ray has not passed it.
    next_m = np.full((len(frozen), N), -1.0)
    next_m[0] = first.distance_m
    at_m, ends_m, of_layer = np.zeros(N), np.full(N, np.inf), np.full(N, -1)
    rows = np.arange(N)
    while len(rows):
        for index, layer in enumerate(frozen):
            stale = rows[next_m[index, rows] < at_m[rows]]
            next_m[index, stale] = _next_m(layer, origins[stale], units[stale], at_m[stale], max_range_m)
        which = next_m[:, rows].argmin(axis=0)
        found_m = next_m[which, rows]
        is_met = np.isfinite(found_m)
        rows, which, found_m = rows[is_met], which[is_met], found_m[is_met]
        # Just inside that voxel, the finest layer that knows the point answers.
        inside = origins[rows] + units[rows] * (found_m + step_m)[:, None]
        answering, states = _answers(frozen, inside, which)
        is_end = states == State.OCCUPIED
        ends_m[rows[is_end]], of_layer[rows[is_end]] = found_m[is_end], answering[is_end]
        # Free there: on to where the ray leaves that voxel, or before to an occupied one of a layer finer still, in it.
        rows, found_m, answering = rows[~is_end], found_m[~is_end], answering[~is_end]
        out_m = found_m + 2 * step_m + _way_out_m(frozen, answering, inside[~is_end], units[rows])
        is_finer = np.arange(len(frozen))[:, None] < answering
        at_m[rows] = np.minimum(out_m, np.where(is_finer, next_m[:, rows], np.inf).min(axis=0))
        rows = rows[at_m[rows] <= max_range_m]
    points = origins + units * np.where(np.isfinite(ends_m), ends_m, np.nan)[:, None]
    return LayeredEnds(ends_m, points, of_layer, names)


def nearest_of_layers(finest: Mapping[str, FrozenMap], points_m: npt.ArrayLike, *, radius_m: float) -> LayeredEnds:
    """The nearest occupied voxel of each of (N, 3) points, among the `finest_states` of layers of cubes.

    Raises:
        BadInputError: as `MapSnapshot.nearest_occupied`.
    """
    found = [
        distance_queries.nearest(frozen, points_m, State.OCCUPIED, radius_m=radius_m) for frozen in finest.values()
    ]
    distances = np.stack([nearest.distance_m for nearest in found])
    best, places = distances.argmin(axis=0), np.stack([nearest.points_m for nearest in found])
    rows = np.arange(len(best))
    return LayeredEnds(distances[best, rows], places[best, rows], best, tuple(finest))


def _next_m(layer: FrozenMap, origins: Floats, units: Floats, at_m: Floats, max_range_m: float) -> Floats:
    """(N,) metres from the origin to the first occupied voxel of a layer at or after a way along each ray."""
    starts = origins + units * at_m[:, None]
    ends = distance_queries.cast(layer, starts, units, max_range_m=max_range_m, ends_in_unknown=False)
    found_m = at_m + ends.distance_m
    return np.asarray(np.where(found_m <= max_range_m, found_m, math.inf))


def _answers(frozen: list[FrozenMap], points: Floats, which: Ints) -> tuple[Ints, npt.NDArray[np.uint8]]:
    """(N,) layer and state of the finest that knows each point, from the layer of its occupied voxel down."""
    answering, states = which.copy(), np.full(len(points), State.OCCUPIED, np.uint8)
    for index in range(len(frozen) - 1, -1, -1):
        finer = np.nonzero(which > index)[0]
        seen = point_queries.states_at(frozen[index], points[finer])
        known = seen != State.UNKNOWN
        answering[finer[known]], states[finer[known]] = index, seen[known]
    return answering, states


def _way_out_m(frozen: list[FrozenMap], answering: Ints, points: Floats, units: Floats) -> Floats:
    """(N,) metres from points to where the rays leave the voxel of the layer that answers."""
    edges = np.array([layer.geometry.voxel_edge_m for layer in frozen])[answering][:, None]
    low = np.floor(points / edges) * edges
    with np.errstate(divide="ignore", invalid="ignore"):
        ways = np.where(units > 0, low + edges - points, low - points) / units
    # A ray along a border has no way to it; rounding may put a point a hair over a border.
    return np.asarray(np.where(units == 0, np.inf, np.maximum(ways, 0.0)).min(axis=1))
