"""Collision queries: the states that a body, a box or a sphere, meets at poses and on its way between them.

    pose n-1 ---+---+---+--- pose n        samples: no point of the body moves farther than half a voxel between two

`check_*` tests the poses alone. `sweep_*` tests the way, too: the position moves straight and the rotation along the
shortest arc, at constant speeds. Each sample is exact, so whatever is reported is met. What a body meets only between
two samples, it overlaps by less than a quarter of a voxel's edge: a body that is larger by that to all sides misses
nothing.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import check_cubes
from cairn_map.queries import body_kernels as kernels
from cairn_map.queries.frozen_map import FrozenMap, as_points, check_within
from cairn_map.queries.occupancy_states import State

SAMPLES_MAX = 1 << 20
"""Samples of one path: 20 km at 4 cm."""
SMALL_RAD = 1e-9
"""Angle below which a rotation counts as none."""
WEIGHTS = np.array([1, 0, 2], np.uint8)
"""Weights by `State`: OCCUPIED before UNKNOWN before FREE."""
STATES = np.array([State.FREE, State.UNKNOWN, State.OCCUPIED], np.uint8)

SIZE_MAX_CELLS = 16
"""Length of a body in cells, at most: the cells around it are looked at one by one."""
SQUARE = 1e-6
"""Largest deviation of an entry of R^T R from the unit matrix's that still counts as a rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class PathStates:
    """States that a body meets at N poses."""

    states: npt.NDArray[np.uint8]
    """(N,) `State`: OCCUPIED if it meets an occupied voxel, else UNKNOWN if it meets an unknown one, else FREE."""
    centres_m: Floats
    """(N, 3) centre of the body at each pose, metres, map frame."""

    def __repr__(self) -> str:
        free = int((self.states == State.FREE).sum())
        place = None if self.first_occupied is None else self.centres_m[self.first_occupied].round(3).tolist()
        return f"PathStates({len(self.states)} poses, {free} free, first collision at {place} m)"

    @property
    def first_occupied(self) -> int | None:
        """Index of the first pose that collides, or None."""
        return _first(self.states == State.OCCUPIED)

    @property
    def first_occupied_m(self) -> Floats | None:
        """(3,) centre of the body at the first pose that collides, metres, map frame, or None."""
        return None if self.first_occupied is None else self.centres_m[self.first_occupied]

    @property
    def first_not_free_m(self) -> Floats | None:
        """(3,) centre of the body at the first pose that collides or may collide, metres, map frame, or None."""
        return None if self.first_not_free is None else self.centres_m[self.first_not_free]

    @property
    def first_not_free(self) -> int | None:
        """Index of the first pose that collides or may collide, or None."""
        return _first(self.states != State.FREE)


def check_box(frozen: FrozenMap, T_map_body: npt.ArrayLike, box_m: npt.ArrayLike) -> PathStates:
    """States that a box, (2, 3) low and high corner in the body's frame, meets at (N, 4, 4) poses."""
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
    """States that a sphere meets at (N, 3) centres."""
    if not radius_m > 0:
        raise BadInputError("bad_range", f"a radius must be more than 0, got {radius_m}")
    centres = as_points(centres_m, "centres")
    R = np.broadcast_to(np.eye(3), (len(centres), 3, 3))
    return _check(frozen, centres, R, half_m=np.zeros(3), radius_m=radius_m)


def _check(frozen: FrozenMap, centres_m: Floats, R: Floats, *, half_m: Floats, radius_m: float) -> PathStates:
    check_cubes(frozen.geometry)
    edge_m = frozen.geometry.voxel_edge_m
    if max(half_m.max(), radius_m) * 2 > SIZE_MAX_CELLS * frozen.geometry.cell_edge_m:
        raise BadInputError("too_large", f"a body is at most {SIZE_MAX_CELLS} cells long")
    check_within(bool((np.abs(centres_m) < frozen.reach_m).all()), frozen)
    states = np.empty(len(centres_m), np.uint8)
    kernels.body_states_into(
        frozen.grid, centres_m / edge_m, np.ascontiguousarray(R), half_m / edge_m, radius_m / edge_m, states
    )
    return PathStates(states, centres_m)


def _first(true: npt.NDArray[np.bool_]) -> int | None:
    return int(true.argmax()) if true.any() else None


def sweep_box(frozen: FrozenMap, T_map_body: npt.ArrayLike, box_m: npt.ArrayLike) -> PathStates:
    """States that a box, (2, 3) corners in the body's frame, meets on its way to each of (N, 4, 4) poses."""
    # The poses themselves; this also refuses arrays that are no path, or no box.
    T, box = np.asarray(T_map_body, np.float64), np.asarray(box_m, np.float64)
    at_poses = check_box(frozen, T, box)
    if len(T) < 2:
        return at_poses
    # An upper bound of the way of any point: the translation, and the arc of the point farthest from the origin.
    turns = _turns(T[:-1, :3, :3], T[1:, :3, :3])
    arm_m = float(np.linalg.norm(np.abs(box).max(axis=0)))
    moved_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) + np.linalg.norm(turns, axis=1) * arm_m
    # The samples between the poses.
    segment, fraction = _samples(frozen, moved_m)
    samples = np.tile(np.eye(4), (len(segment), 1, 1))
    samples[:, :3, :3] = T[segment, :3, :3] @ _rotations(turns[segment] * fraction[:, None])
    samples[:, :3, 3] = _between(T[:, :3, 3], segment, fraction)
    return _worst(at_poses, check_box(frozen, samples, box), segment)


def sweep_sphere(frozen: FrozenMap, centres_m: npt.ArrayLike, *, radius_m: float) -> PathStates:
    """States that a sphere meets on its way to each of (N, 3) centres."""
    centres = as_points(centres_m, "centres")
    at_poses = check_sphere(frozen, centres, radius_m=radius_m)
    if len(centres) < 2:
        return at_poses
    segment, fraction = _samples(frozen, np.linalg.norm(np.diff(centres, axis=0), axis=1))
    samples = _between(centres, segment, fraction)
    return _worst(at_poses, check_sphere(frozen, samples, radius_m=radius_m), segment)


def _samples(frozen: FrozenMap, moved_m: Floats) -> tuple[npt.NDArray[np.int64], Floats]:
    """Segment (S,) and fraction (S,), 0 to 1, of samples between the poses; segment n leads to pose n + 1.

    Raises:
        BadInputError: kind `too_large`: too many.
    """
    steps = np.ceil(moved_m / (frozen.geometry.voxel_edge_m / 2))
    if not steps.sum() < SAMPLES_MAX:
        raise BadInputError("too_large", f"a path has at most {SAMPLES_MAX} steps of half a voxel; check it in parts")
    between = np.maximum(steps.astype(np.int64) - 1, 0)
    segment = np.repeat(np.arange(len(between)), between)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(between) - between, between)
    return segment, (number + 1) / steps[segment]


def _between(points: Floats, segment: npt.NDArray[np.int64], fraction: Floats) -> Floats:
    return np.asarray(points[segment] + (points[segment + 1] - points[segment]) * fraction[:, None])


def _turns(R_from: Floats, R_to: Floats) -> Floats:
    """(N, 3) rotation vectors, radians, of the shortest turns that lead from (N, 3, 3) rotations to others."""
    # The skew part of R is sin(angle) times the axis, its trace 1 + 2 cos(angle).
    R = np.swapaxes(R_from, 1, 2) @ R_to
    vectors = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    sines, cosines = np.linalg.norm(vectors, axis=1), (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angles = np.arctan2(sines, cosines)
    # Near half a turn the vector vanishes; the axis is then the longest column of R + 1.
    symmetric = R + np.swapaxes(R, 1, 2) + (1 - np.trace(R, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    longest = np.linalg.norm(symmetric, axis=1).argmax(axis=1)
    columns = symmetric[np.arange(len(R)), :, longest]
    signs = np.where((columns * vectors).sum(axis=1) < 0, -1.0, 1.0)
    axes = columns * (signs / np.maximum(np.linalg.norm(columns, axis=1), SMALL_RAD))[:, None]
    near_half = sines < 1e-3
    axes[~near_half] = vectors[~near_half] / sines[~near_half, None]
    return np.asarray(np.where((near_half & (cosines > 0))[:, None], vectors, axes * angles[:, None]))


def _rotations(turns: Floats) -> Floats:
    """(N, 3, 3) rotations of (N, 3) rotation vectors: Rodrigues' R = 1 + sin K + (1 - cos) K^2."""
    angles = np.linalg.norm(turns, axis=1)
    x, y, z = (turns / np.maximum(angles, SMALL_RAD)[:, None]).T
    nothing = np.zeros_like(x)
    K = np.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], axis=1).reshape(-1, 3, 3)
    sines, versines = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    return np.asarray(np.eye(3) + sines * K + versines * (K @ K))


def _worst(at_poses: PathStates, between: PathStates, segment: npt.NDArray[np.int64]) -> PathStates:
    """The worst state of each pose and of the samples on the way to it."""
    weights = WEIGHTS[at_poses.states]
    np.maximum.at(weights, segment + 1, WEIGHTS[between.states])
    return PathStates(STATES[weights], at_poses.centres_m)
