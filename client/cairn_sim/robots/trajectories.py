"""Trajectories: true poses of robots that stop or drive along a path, and the poses that they believe.

A path is a line of waypoints on the ground of a scene. A robot stops along it (`stops`), as the paper's did, or drives
through (`drive`). The ground is found by a ray straight down, so the same path works on a floor and on a slope.

The paper's experiment (VI.C) is two paths at right angles: 26 stops in the laboratories, 0.7 m +- 0.1 m apart, and 28
in the corridor and its extension, 1.4 m +- 0.4 m apart, closer where there is more to see.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_sim.render.raycast_kernels import cast_each
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.solids import placed

Xy = tuple[float, float]

EXPERIMENT = "experiment"
"""The path of the building that is the paper's, all of `PAPERS_PATHS` one after the other."""
PAPERS_PATHS = ("labs", "corridors")
POSES_MAX = 100_000
"""Poses of one drive at most."""
ERROR_MAX = 100.0
"""Error of a pose at most, metres or radians: more is a typing error."""
CORNER_M = 0.6
"""Distance before a waypoint at which a drive begins to turn."""


@dataclass(frozen=True, slots=True)
class Route:
    """A line on the ground, and where a robot stops on it."""

    waypoints: tuple[Xy, ...]
    from_z_m: float
    """A height above the ground and below everything else, map frame: the ground is looked for below it."""
    spacing_m: float
    """Mean distance from stop to stop."""
    spread_m: float = 0.0
    """Largest deviation from that."""
    busy: tuple[float, float] = (0.0, 0.0)
    """Part of the path, as shares of its length, in which stops stand closer."""


BUILDING = {
    "labs": Route(((15.2, 6.2), (15.2, 23.7)), -0.1, 0.7, 0.1),
    "corridors": Route(((1.3, 0.0), (30.8, 0.0), (30.8, -8.3)), -0.1, 1.4, 0.4, (0.35, 0.55)),
}
YARD = {"loop": Route(((-6.0, -6.0), (5.25, -6.0), (5.25, 6.8), (-6.0, 6.8), (-6.0, -5.0)), 3.0, 2.0)}
BRIDGE_YARD = {
    "round": Route(
        (
            (-6.5, -3.0),
            (-1.4, -3.0),
            (-0.5, -6.0),
            (5.25, -6.0),
            (5.25, 6.8),
            (-6.0, 6.8),
            (-9.3, 5.5),
            (-13.4, 5.5),
        ),
        0.7,
        1.4,
    ),
    "out": Route(((-13.6, 5.5), (-9.3, 5.5), (-6.0, 4.9), (-1.6, 4.9)), 0.7, 1.3),
}
PATHS: Mapping[str, Mapping[str, Route]] = MappingProxyType(
    {
        "small-room": {
            "west": Route(
                ((0.9, 1.0), (0.8, 1.7), (0.8, 3.1), (1.2, 3.6), (1.9, 3.8), (2.6, 3.8), (2.6, 3.1)), 1.1, 0.68
            ),
            "doorway": Route(((1.9, 1.6), (2.2, 2.3), (2.9, 2.45), (5.2, 2.45)), 1.1, 0.65),
            "east": Route(((5.0, 1.2), (4.8, 1.8), (5.1, 2.4), (5.0, 3.1), (4.75, 4.4)), 1.1, 0.66),
        },
        "building": BUILDING,
        "moving-building": BUILDING,
        "calibration": {"views": Route(((0.0, -0.8), (0.7, 0.0), (0.0, 0.8)), 1.1, 0.4)},
        "targets": {"approach": Route(((-0.5, 0.0), (1.8, 0.0)), 1.1, 0.45)},
        "yard": YARD,
        "moving-yard": YARD,
        "bridge-yard": BRIDGE_YARD,
    }
)
"""By scene and name. West and east of the small room share no stop's view but through the doorway. Of the yard with the
bridge, `round` ends in the shed and `out` begins there."""


def path_names(scene: str) -> list[str]:
    """Names that `stops` knows for a scene."""
    names = list(PATHS.get(scene, ()))
    return [*names, EXPERIMENT] if set(PAPERS_PATHS) <= set(names) else names


def stops(scene: Scene, path: str) -> list[Transform]:
    """`T_map_robot` at each stop of a named path; the robot looks along it.

    Raises:
        BadInputError: the scene has no such path, or no ground below it.
    """
    if path == EXPERIMENT and path in path_names(scene.name):
        return [T for name in PAPERS_PATHS for T in stops(scene, name)]
    line = _path(scene, path)
    length_m = _lengths(line.waypoints)[-1]
    return [on_ground(scene, line, at) for at in _stop_lengths(line, float(length_m))]


def drive(scene: Scene, path: str, *, speed_m_s: float, rate_hz: float) -> list[Transform]:
    """`T_map_robot` at even times of a drive along a named path, turning smoothly at its corners.

    Raises:
        BadInputError: the scene has no such path, or no ground below it.
    """
    if not (speed_m_s > 0 and rate_hz > 0):
        raise BadInputError("bad_drive", f"a drive needs a speed and a rate above 0, got {speed_m_s} and {rate_hz}")
    line = _path(scene, path)
    length_m = float(_lengths(line.waypoints)[-1])
    if not length_m * rate_hz / speed_m_s <= POSES_MAX:
        raise BadInputError(
            "bad_drive",
            f"a drive has at most {POSES_MAX} poses; {length_m:.0f} m at {speed_m_s:g} m/s and {rate_hz:g} Hz: more",
        )
    return [on_ground(scene, line, at) for at in np.arange(0.0, length_m, speed_m_s / rate_hz)]


def on_ground(scene: Scene, path: Route, at_m: float) -> Transform:
    """`T_map_robot` of a robot that stands on the ground, `at_m` metres along a path: its z is the ground's normal.

    Raises:
        BadInputError: nothing is below.
    """
    xy, heading = _along(path.waypoints, at_m)
    above = np.array([*xy, path.from_z_m])
    range_m, solid, normal = cast_each(above[None], np.array([[0.0, 0.0, -1.0]]), scene.shapes)
    if solid[0] < 0:
        raise BadInputError("no_ground", f"no ground below {above.tolist()} in {scene.name}")
    z = normal[0]
    y = np.cross(z, [math.cos(heading), math.sin(heading), 0.0])
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = above - [0, 0, range_m[0]]
    return T


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of a robot's believed poses; all zero: it knows the truth."""

    sigma_m: float = 0.0
    """Standard deviation of each pose on its own, along each axis, metres."""
    sigma_rad: float = 0.0
    """Standard deviation of each pose on its own, about each axis, radians."""
    drift: float = 0.0
    """Sigma of the position's random walk after one metre of way, in metres; grows with the root of the way."""
    drift_rad: float = 0.0
    """Sigma of the heading's random walk after one metre of way."""

    def __post_init__(self) -> None:
        for name in ("sigma_m", "sigma_rad", "drift", "drift_rad"):
            if not 0 <= getattr(self, name) <= ERROR_MAX:
                raise BadInputError("bad_pose_error", f"{name} must be 0 to {ERROR_MAX:g}, got {getattr(self, name):g}")


def believed(true: Sequence[Transform], errors: PoseErrors, rng: np.random.Generator) -> list[Transform]:
    """The poses that a robot reports when it truly is at `true`, `T_map_rig` or `T_map_robot`.

    The drift moves the whole rest of the way, as odometry's does: heading about the map's vertical.
    """
    poses: list[Transform] = []
    gone = np.eye(4)
    before: Transform | None = None
    for T in true:
        if before is not None:
            step_m = float(np.linalg.norm(T[:3, 3] - before[:3, 3]))
            jump_m = errors.drift * math.sqrt(step_m) * rng.standard_normal(3)
            turn_rad = errors.drift_rad * math.sqrt(step_m) * rng.standard_normal()
            about = placed((T[0, 3], T[1, 3], T[2, 3]))
            gone = gone @ placed(tuple(jump_m)) @ about @ placed((0, 0, 0), (0, 0, turn_rad)) @ np.linalg.inv(about)
        shake = placed(tuple(errors.sigma_m * rng.standard_normal(3)), tuple(errors.sigma_rad * rng.standard_normal(3)))
        own = gone @ T
        own[:3, 3] += shake[:3, 3]
        own[:3, :3] = own[:3, :3] @ shake[:3, :3]
        poses.append(own)
        before = T
    return poses


def _path(scene: Scene, path: str) -> Route:
    known = PATHS.get(scene.name, {})
    if path not in known:
        raise BadInputError(
            "unknown_path",
            f"scene {scene.name} has the paths {', '.join(path_names(scene.name)) or '(none)'}, got {path!r}",
        )
    return known[path]


def _lengths(waypoints: Sequence[Xy]) -> Floats:
    """(K,) metres from the start to each waypoint."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(np.array(waypoints), axis=0), axis=1))])


def _along(waypoints: Sequence[Xy], at_m: float) -> tuple[Xy, float]:
    """Position and heading, radians, some metres along a line; headings change smoothly around corners."""
    lengths, points = _lengths(waypoints), np.array(waypoints)
    x, y = (float(np.interp(at_m, lengths, points[:, axis])) for axis in (0, 1))
    ahead, behind = (np.clip(at_m + d, 0, lengths[-1]) for d in (CORNER_M, -CORNER_M))
    dx, dy = (np.interp(ahead, lengths, points[:, a]) - np.interp(behind, lengths, points[:, a]) for a in (0, 1))
    return (x, y), math.atan2(float(dy), float(dx))


def _stop_lengths(path: Route, length_m: float) -> Floats:
    """Metres along the path of each stop, both ends included; closer together in the busy part."""
    count = round(length_m / path.spacing_m) + 1
    if path.spread_m == 0:
        return np.linspace(0, length_m, count)
    shares = (np.arange(count - 1) + 0.5) / (count - 1)
    busy = (shares > path.busy[0]) & (shares < path.busy[1])
    # An even pattern of longer and shorter steps, so that the figures of the paper hold for every run.
    steps = path.spacing_m + path.spread_m * np.where(busy, -0.9, np.sin(2.4 * np.arange(count - 1)) * 0.6)
    return np.concatenate([[0.0], np.cumsum(steps * (length_m / steps.sum()))])
