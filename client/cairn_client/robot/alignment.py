"""Alignment of a robot's own frame with the shared map, by its scans laid onto the map's occupied voxels.

    starts     the guess, and places around it            a step of the search apart
    GICP       from each start to the nearest minimum     Segal et al. 2009; small_gicp (Koide 2024)
    fit        of the points in known space, how many lie on surfaces
    verdict    accepted, ambiguous or failed, with the reason in words: `alignment_verdict`

A wrong place would spread to all robots, so an ambiguous one is refused: another minimum that fits nearly as well
(rooms that are alike), or a motion that nothing holds (along a bare corridor).
"""

import dataclasses
import math
import os
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform, transform_points
from cairn_calib.rig.rig import Rig
from cairn_client.robot.alignment_verdict import Alignment, AlignmentVerdict, Matches, Minimum, apart_m, failed, judged
from cairn_fusion.mapping.beam_returns import returns_of
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.queries.occupancy_states import State

STEP_M, STEP_RAD = 0.5, math.radians(15)
"""Steps of the search: from half a step, and more, GICP finds the place where there is anything to hold it."""
STARTS_MAX = 1000
COARSE_POINTS, FINE_POINTS = 1000, 20_000
"""Number of the scans' points that are used in the search and at its end."""
COARSE_EDGE_M = 0.12
"""Edge of the map's surface cells in the search; its voxels' edge, if that is larger."""
COARSE_STEPS, FINE_STEPS = 15, 50
"""Iterations of a GICP in the search and at its end."""
FOLLOWED = 32
"""Number of the best minima of the search that are refined and compared."""
COMPARED, RIVALS_MAX = 0.7, 6
"""Least fraction of the best minimum's worth, and largest number, of those that are refined on all voxels."""
POINTS_MIN = 200
"""Least number of points, one a voxel; fewer say too little."""
NEIGHBOURS = 20
"""Voxels that make a surface's normal: a patch of 4 x 5."""


def points_of_scans(scans: Sequence[Scan], rig: Rig, integrator: Integrator) -> Floats:
    """(N, 3) points that the scans of a rig saw, metres, in the frame of their poses, within the integrator's ranges.

    Raises:
        BadInputError: a scan does not fit the rig.
    """
    seen = (
        returns_of(
            scan,
            rig,
            min_range_m=integrator.min_range_m,
            max_range_m=integrator.max_range_m,
            flying_step_m=integrator.flying_step_m,
        )
        for scan in scans
    )
    return np.concatenate([np.empty((0, 3)), *(returns.points_map for returns in seen)])


def align_points(
    snapshot: MapSnapshot,
    points_robot: npt.NDArray[np.floating],
    *,
    T_map_robot: npt.ArrayLike,
    reach_m: float = STEP_M,
    reach_rad: float = STEP_RAD,
) -> Alignment:
    """Lay (N, 3) points of a robot's own frame, metres, onto the map, as `Robot.align`; NaN is left out."""
    guess = check_transform(T_map_robot, name="T_map_robot")
    edge_m = snapshot.geometry.voxel_edge_m
    # The scans' points, thinned to one a voxel.
    finite = np.asarray(points_robot, np.float64)[np.isfinite(points_robot).all(axis=1)]
    points = some(one_a_voxel(finite, edge_m), FINE_POINTS)
    if len(points) < POINTS_MIN:
        return failed(guess, f"the scans have {len(points)} points, one a voxel; {POINTS_MIN} are needed")
    # The map's surfaces wherever a start may put the points.
    starts = list(starts_around(guess, reach_m=reach_m, reach_rad=reach_rad))
    corners = np.concatenate([transform_points(start, _corners(points)) for start in starts])
    box_m = np.stack([corners.min(axis=0) - STEP_M, corners.max(axis=0) + STEP_M])
    surfaces = snapshot.occupied_in(box_m).centres_m
    if len(surfaces) < POINTS_MIN:
        text = f"the map has {len(surfaces)} occupied voxels where the points may be"
        return failed(guess, f"{text}; {POINTS_MIN} are needed")
    # From each start to a minimum, on coarse surfaces; the best ones again on all voxels.
    rough = _searched(snapshot, MapSurfaces(one_a_voxel(surfaces, max(edge_m, COARSE_EDGE_M))), points, starts)
    all_surfaces = MapSurfaces(surfaces)
    cloud = all_surfaces.cloud(points)
    fine = (all_surfaces.registered(cloud, minimum.T, 3 * edge_m, steps=FINE_STEPS) for minimum in rough)
    best, *others = _distinct([minimum_at(snapshot, points, T) for T in fine], points, edge_m)
    # The verdict, and a last check: a place much farther off than was asked for is none.
    found = judged(best, others, points, all_surfaces.matches(points, best.T, 2 * edge_m), edge_m=edge_m)
    # The reach counts along x and along y: a corner lies sqrt(2) of it off, and GICP may go a step beyond.
    shift_m = float(np.linalg.norm(best.T[:3, 3] - guess[:3, 3]))
    if shift_m > math.sqrt(2) * reach_m + STEP_M:
        reason = f"it ended {shift_m:.2f} m from the guess: if that may be, give a larger reach_m"
        return dataclasses.replace(found, verdict=AlignmentVerdict.FAILED, reason=reason)
    return found


def _searched(
    snapshot: MapSnapshot, surfaces: "MapSurfaces", points: Floats, starts: Sequence[Transform]
) -> list[Minimum]:
    """Minima that the starts lead to, each once, the best first, without those of much less worth."""
    edge_m = snapshot.geometry.voxel_edge_m
    # Few points and wide matches from every start: enough to fall into the right valley.
    cloud = surfaces.cloud(some(points, COARSE_POINTS))
    ends = (surfaces.registered(cloud, start, 2 * STEP_M, steps=COARSE_STEPS) for start in starts)
    rough = _distinct([minimum_at(snapshot, points, T) for T in ends], points, edge_m)[:FOLLOWED]
    # Closer matches from the best of them; starts that fell into one valley have become one minimum.
    closer = (surfaces.registered(cloud, minimum.T, 0.2 + 2 * edge_m, steps=FINE_STEPS) for minimum in rough)
    minima = _distinct([minimum_at(snapshot, points, T) for T in closer], points, edge_m)
    # What is much worse is no rival by `alignment_verdict.RIVAL`, and need not be refined on all voxels.
    return [minimum for minimum in minima if minimum.worth >= COMPARED * minima[0].worth][:RIVALS_MAX]


def minimum_at(snapshot: MapSnapshot, points: Floats, T: Transform) -> Minimum:
    """Fit of points in the robot's frame at a place."""
    there = transform_points(T, points)
    hits = snapshot.nearest_occupied(there, radius_m=snapshot.geometry.voxel_edge_m).found
    # Points in unknown space tell neither for nor against a place: they count as not known, not as misses.
    known = hits | (snapshot.state_at(there) != State.UNKNOWN)
    return Minimum(T, float(hits.sum() / max(known.sum(), 1)), float(known.mean()))


def _distinct(minima: Sequence[Minimum], points: Floats, edge_m: float) -> list[Minimum]:
    """The best first, without those that are within two voxels of a better one."""
    few = some(points, 100)
    kept: list[Minimum] = []
    # Best first: a minimum gives way only to a better one.
    for minimum in sorted(minima, key=_worth, reverse=True):
        if all(apart_m(other.T, minimum.T, few) > 2 * edge_m for other in kept):
            kept.append(minimum)
    return kept


def _worth(minimum: Minimum) -> float:
    return minimum.worth


class MapSurfaces:
    """Points of a map's surfaces, as small_gicp takes them."""

    def __init__(self, points_m: Floats) -> None:
        """Args: points_m: (V, 3) map frame."""
        try:
            import small_gicp
        except ImportError as exc:
            raise BadInputError(
                "no_small_gicp", 'align needs small_gicp; get it with pip install "cairn-robotics[robot]"'
            ) from exc
        self._gicp = small_gicp
        self._cloud = small_gicp.PointCloud(points_m)
        self._tree = small_gicp.KdTree(self._cloud)
        small_gicp.estimate_normals_covariances(self._cloud, self._tree, NEIGHBOURS, os.cpu_count() or 1)

    def cloud(self, points: Floats) -> Any:
        """(N, 3) points with their covariances."""
        cloud = self._gicp.PointCloud(points)
        self._gicp.estimate_normals_covariances(cloud, self._gicp.KdTree(cloud), NEIGHBOURS // 2)
        return cloud

    def registered(self, cloud: Any, start: Transform, distance_m: float, *, steps: int) -> Transform:
        """From a start to the nearest minimum, by matches within a distance.

        On one thread: more would add up in another order each time.
        """
        return check_transform(
            self._gicp.align(
                self._cloud,
                cloud,
                self._tree,
                start,
                max_correspondence_distance=distance_m,
                max_iterations=steps,
                rotation_epsilon=1e-4,
                translation_epsilon=1e-4,
            ).T_target_source
        )

    def matches(self, points: Floats, T: Transform, distance_m: float) -> Matches:
        """The points within a distance of surfaces, with the surfaces' normals in the robot's frame."""
        there = transform_points(T, points)
        numbers, squares = self._tree.batch_nearest_neighbor_search(there)
        near = np.asarray(squares) < distance_m**2
        found = np.asarray(numbers)[near]
        normals, centres = self._cloud.normals()[found, :3], self._cloud.points()[found, :3]
        offsets_m = ((there[near] - centres) * normals).sum(axis=1)
        # Rows n @ R are R^T n: the normals in the robot's frame.
        return Matches(points[near], normals @ T[:3, :3], offsets_m)


def starts_around(guess: Transform, *, reach_m: float, reach_rad: float) -> Iterator[Transform]:
    """The guess, and places around it, a step of the search apart: moved, and the robot turned where it stands.

    Raises:
        BadInputError: too many.
    """
    if not (0 <= reach_m < math.inf and 0 <= reach_rad <= math.pi):
        raise BadInputError(
            "bad_option", f"reach_m must be 0 or more and reach_rad 0 to pi, got {reach_m}, {reach_rad}"
        )
    # Roll, pitch and height are not searched: the guess knows them well enough for GICP to do the rest.
    shifts_m, turns_rad = (_steps(*pair) for pair in ((reach_m, STEP_M), (reach_rad, STEP_RAD)))
    if len(shifts_m) ** 2 * len(turns_rad) > STARTS_MAX:
        raise BadInputError("too_large", f"the search would have more than {STARTS_MAX} starts; give a smaller reach")
    for x, y, turn in product(shifts_m, shifts_m, turns_rad):
        R = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        start = guess.copy()
        start[:3, :3] = R @ guess[:3, :3]
        start[:2, 3] += (x, y)
        yield start


def one_a_voxel(points: Floats, edge_m: float) -> Floats:
    """The mean of the points in each voxel of an edge, (M, 3) of (N, 3), in the order of the voxels' numbers."""
    if not len(points):
        return points
    numbers = np.floor(points / edge_m).astype(np.int64)
    numbers -= numbers.min(axis=0)
    spans = numbers.max(axis=0) + 1
    rows = (numbers[:, 0] * spans[1] + numbers[:, 1]) * spans[2] + numbers[:, 2]  # as one number: 5 times as fast
    _, voxel_of, counts = np.unique(rows, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel_of, points[:, axis], len(counts)) for axis in range(3)]
    return np.asarray(np.stack(sums, axis=1) / counts[:, None])


def some(points: Floats, count: int) -> Floats:
    """At most so many of the points, always the same ones."""
    if len(points) <= count:
        return points
    # A fixed seed, and the points in their order: the same scans give the same place every time.
    return points[np.sort(np.random.default_rng(0).permutation(len(points))[:count])]


def _steps(reach: float, step: float) -> list[float]:
    """0 and steps to both sides, as far as the reach; round the circle each heading once."""
    # 1e-9: a reach of whole steps must not get one more by rounding.
    count = math.ceil(reach / step - 1e-9)
    steps = [n * reach / count for n in range(-count, count + 1)] if count else [0.0]
    # -pi and pi are the same heading.
    return steps[1:] if reach == math.pi else steps


def _corners(points: Floats) -> Floats:
    """(8, 3) corners of the points' box."""
    return np.array(list(product(*np.stack([points.min(axis=0), points.max(axis=0)], axis=1))))
