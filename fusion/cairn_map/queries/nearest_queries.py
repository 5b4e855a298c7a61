"""The voxel that is nearest to a point, of the occupied or of the unknown ones."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.queries.frozen_map import FrozenMap, as_points, check_within
from cairn_map.queries.nearest_kernels import nearest_into
from cairn_map.queries.occupancy_states import State


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest voxels of N points."""

    distance_m: Floats
    """(N,) to the nearest point of the voxel, 0 inside it; infinite if there is none within the radius."""
    voxels: npt.NDArray[np.int64]
    """(N, 3) its number, one of them if several are as near; the point's own voxel if there is none."""

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """(N,) whether there is one."""
        return np.isfinite(self.distance_m)


def nearest(frozen: FrozenMap, points_m: npt.ArrayLike, state: State, *, radius_m: float) -> Nearest:
    """The nearest voxels in a state, OCCUPIED or UNKNOWN, of (N, 3) points."""
    points = as_points(points_m, "points")
    if not 0 <= radius_m < np.inf:
        raise BadInputError("bad_range", f"a radius must be finite and 0 or more, got {radius_m}")
    N, edge_m = len(points), frozen.geometry.voxel_edge_m
    found = Nearest(np.empty(N), np.empty((N, 3), np.int64))
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
    return found
