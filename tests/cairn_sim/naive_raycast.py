"""The slow, obvious twin of `cairn_sim.render.raycast_kernels`: every face of every solid, one after the other."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_sim.scene.scene import Scene
from cairn_sim.scene.solids import Box, Cylinder, Plane, Solid, Sphere
from cairn_sim.scene.surfaces import Optics

Floats = npt.NDArray[np.float64]


def naive_cast(scene: Scene, origin: Floats, directions: Floats) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Range (inf for none) and solid (-1 for none) of each of the (N, 3) rays."""
    best = np.full(len(directions), np.inf)
    which = np.full(len(directions), -1, dtype=np.int32)
    for k, solid in enumerate(scene.solids):
        for t in crossings(solid, origin, directions):
            points = origin + np.where(np.isfinite(t), t, 0)[:, None] * directions
            on_surface = np.abs(solid.distance_m(points)) < 1e-9
            nearer = np.isfinite(t) & on_surface & (t > 0) & (t < best)
            best[nearer], which[nearer] = t[nearer], k
    return best, which


def crossings(solid: Solid, origin: Floats, directions: Floats) -> list[Floats]:
    """Lengths at which the rays cross the planes, and the infinite cylinder or the sphere, that bound a solid."""
    R_map_solid = solid.T_map_solid[:3, :3]
    p, d = (origin - solid.T_map_solid[:3, 3]) @ R_map_solid, directions @ R_map_solid
    with np.errstate(all="ignore"):
        match solid.shape:
            case Box():
                return [(s * solid.shape.half_m[a] - p[a]) / d[:, a] for a in range(3) for s in (-1, 1)]
            case Cylinder():
                ends = [(z - p[2]) / d[:, 2] for z in (-solid.shape.height_m / 2, solid.shape.height_m / 2)]
                return ends + roots(p[:2], d[:, :2], solid.shape.radius_m)
            case Sphere():
                return roots(p, d, solid.shape.radius_m)
            case Plane():
                return [-p[2] / d[:, 2]]


def roots(p: Floats, d: Floats, radius: float) -> list[Floats]:
    """Both t with |p + t d| = radius; NaN where there is none."""
    a, b, c = (d * d).sum(axis=1), d @ p, p @ p - radius * radius
    root = np.sqrt(b * b - a * c)
    return [(-b - root) / a, (-b + root) / a]


@dataclass
class Sight:
    """What one ray shows."""

    path_m: float
    solid: int
    way: int
    passes: int


def naive_sight(scene: Scene, origin: Floats, direction: Floats) -> Sight:
    """One ray through glass and round mirrors, step by step, with the surface's normal from distances."""
    path_m, way, passes = 0.0, 0, 0
    for _ in range(9):
        start = origin
        while True:
            (step,), (k,) = naive_cast(scene, start, direction[None])
            if k < 0:
                return Sight(np.inf, -1, way, passes)
            start = start + step * direction
            optics = scene.solids[k].surface.material.optics
            if optics is not Optics.GLASS:
                break
            way, passes = way | 1, passes + 1
            # Out of the pane at its back: nothing is seen from inside.
            start = start + (crossing_length(scene.solids[k], start, direction) + 1e-9) * direction
        path_m += float(np.linalg.norm(start - origin))
        if optics is Optics.OPAQUE:
            return Sight(path_m, int(k), way, passes)
        way, passes = way | 2, passes + 1
        normal = gradient(scene.solids[k], start)
        direction = direction - 2 * (direction @ normal) * normal
        origin = start + 1e-9 * normal
    return Sight(np.inf, -1, way, passes)


def crossing_length(solid: Solid, origin: Floats, direction: Floats) -> float:
    """How long a ray that enters at `origin` stays in a solid."""
    lengths = np.array([float(t[0]) for t in crossings(solid, origin, direction[None])])
    inside = [t for t in lengths if t > 1e-9 and abs(float(solid.distance_m(origin + t * direction))) < 1e-9]
    return min(inside, default=0.0)


def gradient(solid: Solid, point: Floats) -> Floats:
    """The outward normal, by differences of the distance."""
    steps = 1e-6 * np.eye(3)
    slope = np.array([float(solid.distance_m(point + s) - solid.distance_m(point - s)) for s in steps])
    return slope / np.linalg.norm(slope)
