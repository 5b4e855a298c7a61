"""Distance queries: along rays to the first occupied voxel, and from points to the nearest voxel in a state.

Where nothing is found, the distance is infinite, the point is NaN, and the voxel is `NO_VOXEL` along each axis.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import check_cubes
from cairn_map.queries.frozen_map import FrozenMap, as_points, check_within
from cairn_map.queries.nearest_kernels import nearest_into
from cairn_map.queries.occupancy_states import State
from cairn_map.queries.ray_kernels import cast_into

NO_VOXEL = int(np.iinfo(np.int64).min)
"""Number, along each axis, of no voxel."""
ONES = ~np.uint64(0)
CHUNK = 1 << 14
"""Rays that are cast at a time: it bounds the memory for their unit directions."""


@dataclass(frozen=True, slots=True, eq=False)
class RayEnds:
    """Ends of N rays."""

    distance_m: Floats
    """(N,) metres to where the ray enters the voxel that ends it, 0 if it starts there; infinite if none does."""
    states: npt.NDArray[np.uint8]
    """(N,) `State` of that voxel; FREE if the ray came to its maximum range."""
    voxels: npt.NDArray[np.int64]
    """(N, 3) number of that voxel; `NO_VOXEL` where there is none."""
    points_m: Floats
    """(N, 3) where the ray enters it, metres, map frame; NaN where there is none."""

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """(N,) True where an occupied voxel ended the ray."""
        return np.asarray(self.states == State.OCCUPIED)

    def __repr__(self) -> str:
        near_m = self.distance_m[self.hit]
        span = f", {near_m.min():.3g} to {near_m.max():.3g} m away" if len(near_m) else ""
        return f"RayEnds({len(self.states)} rays, {len(near_m)} hit{span})"


def cast(
    frozen: FrozenMap,
    origins_m: npt.ArrayLike,
    directions: npt.ArrayLike,
    *,
    max_range_m: float,
    ends_in_unknown: bool,
) -> RayEnds:
    """Ends of N rays, from N origins, or one, along N directions, or one, of any length other than 0."""
    check_cubes(frozen.geometry)
    origins, directions = _as_many(_rows(origins_m, "origins"), _rows(directions, "directions"))
    if not max_range_m >= 0:
        raise BadInputError("bad_range", f"the maximum range must be 0 or more, got {max_range_m}")
    N, edge_m = len(origins), frozen.geometry.voxel_edge_m
    ends = RayEnds(np.empty(N), np.empty(N, np.uint8), np.empty((N, 3), np.int64), np.full((N, 3), np.nan))
    for start in range(0, N, CHUNK):
        part = slice(start, start + CHUNK)
        units = units_of(directions[part])
        inside = cast_into(
            frozen.grid,
            origins[part],
            units,
            frozen.reach_m,
            max_range_m / edge_m,
            ONES if ends_in_unknown else np.uint64(0),
            ends.distance_m[part],
            ends.states[part],
            ends.voxels[part],
        )
        check_within(inside, frozen)
        distance_m = ends.distance_m[part]
        distance_m *= edge_m
        ended = np.isfinite(distance_m)
        ends.points_m[part][ended] = origins[part][ended] + units[ended] * distance_m[ended, None]
        ends.voxels[part][~ended] = NO_VOXEL
    return ends


def _rows(values: npt.ArrayLike, what: str) -> Floats:
    """(N, 3) of (N, 3) numbers, or (1, 3) of three."""
    return as_points(np.asarray(values)[None] if np.ndim(values) == 1 else values, what)


def _as_many(origins: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Both as many; one alone is repeated.

    Raises:
        BadInputError: kind `bad_points`.
    """
    N = max(len(origins), len(directions))
    if {len(origins), len(directions)} - {1, N} or min(len(origins), len(directions)) == 0 < N:
        raise BadInputError(
            "bad_points",
            f"as many directions as origins, or one of either, got {len(directions)} and {len(origins)}",
        )
    repeated = (np.repeat(each, N, axis=0) if len(each) < N else each for each in (origins, directions))
    return next(repeated), next(repeated)


def units_of(directions: Floats) -> Floats:
    """The same directions with length 1.

    Raises:
        BadInputError: one has no length, or is not finite.
    """
    largest = np.abs(directions).max(axis=1, keepdims=True)
    if not ((largest > 0) & (largest < math.inf)).all():
        raise BadInputError("bad_points", "directions must be finite and not of length 0")
    scaled: Floats = directions / largest  # so that no square overflows or vanishes
    units: Floats = scaled / np.sqrt((scaled * scaled).sum(axis=1, keepdims=True))
    return units


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest voxels of N points."""

    distance_m: Floats
    """(N,) metres to the nearest point of the voxel, 0 inside it; infinite if there is none within the radius."""
    voxels: npt.NDArray[np.int64]
    """(N, 3) number of the voxel, of one of them if several are as near; `NO_VOXEL` if there is none."""
    points_m: Floats
    """(N, 3) nearest point of that voxel, metres, map frame; NaN if there is none."""

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """(N,) True where there is a voxel within the radius."""
        return np.isfinite(self.distance_m)

    def __repr__(self) -> str:
        near_m = self.distance_m[self.found]
        span = f", {near_m.min():.3g} to {near_m.max():.3g} m away" if len(near_m) else ""
        return f"Nearest({len(self.distance_m)} points, {len(near_m)} found{span})"


def nearest(frozen: FrozenMap, points_m: npt.ArrayLike, state: State, *, radius_m: float) -> Nearest:
    """The nearest voxels in a state, OCCUPIED or UNKNOWN, of (N, 3) points."""
    check_cubes(frozen.geometry)
    points = as_points(points_m, "points")
    if not 0 <= radius_m < np.inf:
        raise BadInputError("bad_range", f"a radius must be finite and 0 or more, got {radius_m}")
    N, edge_m = len(points), frozen.geometry.voxel_edge_m
    found = Nearest(np.empty(N), np.empty((N, 3), np.int64), np.full((N, 3), np.nan))
    inside = nearest_into(
        frozen.grid,
        points,
        frozen.reach_m,
        radius_m / edge_m,
        state is State.UNKNOWN,
        found.distance_m,
        found.voxels,
    )
    check_within(inside, frozen)
    np.multiply(found.distance_m, edge_m, out=found.distance_m)
    there = found.found
    low_m = found.voxels[there] * edge_m
    found.points_m[there] = np.clip(points[there], low_m, low_m + edge_m)
    found.voxels[~there] = NO_VOXEL
    return found
