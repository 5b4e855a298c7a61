"""Bodies on a path: where a robot would collide, and where nobody knows."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.queries import body_kernels as kernels
from cairn_map.queries.frozen_map import FrozenMap, as_points, check_within
from cairn_map.queries.occupancy_states import State

SIZE_MAX_CELLS = 16
"""A body is no longer than so many cells: the cells around it are looked at one by one."""
SQUARE = 1e-6
"""How far a rotation may be from one."""


@dataclass(frozen=True, slots=True, eq=False)
class PathStates:
    """What a body meets at N poses."""

    states: npt.NDArray[np.uint8]
    """(N,) `State`: OCCUPIED if it meets an occupied voxel, else UNKNOWN if it meets an unknown one, else FREE."""

    @property
    def first_occupied(self) -> int | None:
        """The first pose that collides, or None."""
        return _first(self.states == State.OCCUPIED)

    @property
    def first_not_free(self) -> int | None:
        """The first pose that collides or might, or None."""
        return _first(self.states != State.FREE)


def check_box(frozen: FrozenMap, T_map_body: npt.ArrayLike, box_m: npt.ArrayLike) -> PathStates:
    """What a box, (2, 3) low and high corner in the body's frame, meets at (N, 4, 4) poses."""
    T, box = np.asarray(T_map_body, np.float64), np.asarray(box_m, np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise BadInputError("bad_points", f"poses must be (N, 4, 4), got {T.shape}")
    if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
        raise BadInputError("bad_box", "a body's box is its lowest and its highest corner, (2, 3) finite metres")
    R = np.ascontiguousarray(T[:, :3, :3])
    straight = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)) < SQUARE
    if not (straight.all() and (T[:, 3] == [0, 0, 0, 1]).all()):
        raise BadInputError("bad_points", "poses must be rigid transforms: a rotation and a translation")
    centres = T[:, :3, 3] + R @ box.mean(axis=0)
    return _check(frozen, centres, R, half_m=(box[1] - box[0]) / 2, radius_m=0.0)


def check_sphere(frozen: FrozenMap, centres_m: npt.ArrayLike, *, radius_m: float) -> PathStates:
    """What a sphere meets at (N, 3) centres."""
    if not radius_m > 0:
        raise BadInputError("bad_range", f"a radius must be more than 0, got {radius_m}")
    centres = as_points(centres_m, "centres")
    R = np.broadcast_to(np.eye(3), (len(centres), 3, 3))
    return _check(frozen, centres, R, half_m=np.zeros(3), radius_m=radius_m)


def _check(frozen: FrozenMap, centres_m: Floats, R: Floats, *, half_m: Floats, radius_m: float) -> PathStates:
    edge_m = frozen.geometry.voxel_edge_m
    if max(half_m.max(), radius_m) * 2 > SIZE_MAX_CELLS * frozen.geometry.cell_edge_m:
        raise BadInputError("too_large", f"a body is at most {SIZE_MAX_CELLS} cells long")
    check_within(bool((np.abs(centres_m) < frozen.reach_m).all()), frozen)
    states = np.empty(len(centres_m), np.uint8)
    kernels.body_states_into(
        frozen.grid, centres_m / edge_m, np.ascontiguousarray(R), half_m / edge_m, radius_m / edge_m, states
    )
    return PathStates(states)


def _first(true: npt.NDArray[np.bool_]) -> int | None:
    return int(true.argmax()) if true.any() else None
