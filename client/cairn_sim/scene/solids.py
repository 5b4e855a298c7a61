"""Four convex solids, each at a pose of its own: what a scene is made of, walls too (a wall is a slab).

So a ray caster needs four formulas, and every question about the truth has an exact answer. A solid's own frame has
its origin in the middle of a box, cylinder or sphere; a plane is the half space below z = 0.
"""

import math
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform, check_transform
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_sim.scene.surfaces import Surface

Metres3 = tuple[float, float, float]
Angles3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Box:
    """Edges along its own axes."""

    size_m: Metres3

    @property
    def half_m(self) -> Metres3:
        """Half of what the solid spans along its own axes."""
        x, y, z = self.size_m
        return x / 2, y / 2, z / 2

    def distance_m(self, local: Floats) -> Floats:
        """(...) metres from the surface to (..., 3) points of the own frame, negative inside."""
        return _distance_outside(np.abs(local) - np.array(self.half_m))


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Its axis is its own z."""

    radius_m: float
    height_m: float

    @property
    def half_m(self) -> Metres3:
        """Half of what the solid spans along its own axes."""
        return self.radius_m, self.radius_m, self.height_m / 2

    def distance_m(self, local: Floats) -> Floats:
        """(...) metres from the surface to (..., 3) points of the own frame, negative inside."""
        across = np.hypot(local[..., 0], local[..., 1]) - self.radius_m
        along = np.abs(local[..., 2]) - self.height_m / 2
        return _distance_outside(np.stack([across, along], axis=-1))


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball."""

    radius_m: float

    @property
    def half_m(self) -> Metres3:
        """Half of what the solid spans along its own axes."""
        return self.radius_m, self.radius_m, self.radius_m

    def distance_m(self, local: Floats) -> Floats:
        """(...) metres from the surface to (..., 3) points of the own frame, negative inside."""
        return np.asarray(np.linalg.norm(local, axis=-1) - self.radius_m)


@dataclass(frozen=True, slots=True)
class Plane:
    """Everything below its own z = 0, without end: the ground."""

    @property
    def half_m(self) -> Metres3:
        """Half of what the solid spans along its own axes."""
        return math.inf, math.inf, math.inf

    def distance_m(self, local: Floats) -> Floats:
        """(...) metres from the surface to (..., 3) points of the own frame, negative inside."""
        return np.asarray(local[..., 2], dtype=np.float64)


Shape = Box | Cylinder | Sphere | Plane


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A shape at a place, with a name and a surface."""

    name: str
    shape: Shape
    surface: Surface
    T_map_solid: Transform

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_map_solid", check_transform(self.T_map_solid, name=f"pose of {self.name}"))
        if not all(size > 0 for size in self.shape.half_m) or (
            not isinstance(self.shape, Plane) and not all(map(math.isfinite, self.shape.half_m))
        ):
            raise BadInputError("bad_solid", f"{self.name} needs finite sizes above 0 m, got {self.shape}")

    def distance_m(self, points: Floats) -> Floats:
        """(...) metres from the surface to (..., 3) points of the map frame, negative inside."""
        local = (points - self.T_map_solid[:3, 3]) @ self.T_map_solid[:3, :3]
        return self.shape.distance_m(local)

    def bounds_m(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner, (3,) each, map frame, of a box around the solid; infinite for a plane."""
        half = np.array(self.shape.half_m)
        reach = half if isinstance(self.shape, Plane) else np.abs(self.T_map_solid[:3, :3]) @ half
        centre = self.T_map_solid[:3, 3]
        return centre - reach, centre + reach


def placed(at_m: Metres3, turn_rad: Angles3 = (0.0, 0.0, 0.0)) -> Transform:
    """`T_map_solid` of a solid turned about x, then y, then z (all of the map), and then moved."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(turn_rad), np.cos(turn_rad)
    T = np.eye(4)
    T[:3, :3] = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )
    T[:3, 3] = at_m
    return T


def _distance_outside(excess: Floats) -> Floats:
    """Signed distance to a product of intervals, from (..., K) how far a point is outside each."""
    outside = np.linalg.norm(np.maximum(excess, 0), axis=-1)
    return np.asarray(outside + np.minimum(excess.max(axis=-1), 0))
