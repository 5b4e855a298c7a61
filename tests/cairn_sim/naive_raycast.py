"""The slow, obvious twin of `cairn_sim.raycast_kernels`: every face of every solid, one after the other."""

import numpy as np
import numpy.typing as npt

from cairn_sim.room import Box, Cylinder, Room, Solid, Sphere

Floats = npt.NDArray[np.float64]


def naive_cast(room: Room, origin: Floats, directions: Floats) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Range (inf for none) and solid (-1 for none) of each of the (N, 3) rays."""
    best = np.full(len(directions), np.inf)
    which = np.full(len(directions), -1, dtype=np.int32)
    for k, solid in enumerate(room.solids):
        for t in crossings(solid, origin, directions):
            points = origin + np.where(np.isfinite(t), t, 0)[:, None] * directions
            on_surface = np.abs(solid.distance_m(points)) < 1e-9
            nearer = np.isfinite(t) & on_surface & (t > 0) & (t < best)
            best[nearer], which[nearer] = t[nearer], k
    return best, which


def crossings(solid: Solid, origin: Floats, directions: Floats) -> list[Floats]:
    """Lengths at which the rays cross the planes, and the infinite cylinder or the sphere, that bound a solid."""
    with np.errstate(all="ignore"):
        match solid:
            case Box():
                cos, sin = np.cos(solid.yaw_rad), np.sin(solid.yaw_rad)
                axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
                p, d = (origin - np.array(solid.centre_m)) @ axes.T, directions @ axes.T
                return [(s * solid.size_m[a] / 2 - p[a]) / d[:, a] for a in range(3) for s in (-1, 1)]
            case Cylinder():
                p = origin - np.array(solid.foot_m)
                ends = [(z - p[2]) / directions[:, 2] for z in (0, solid.height_m)]
                return ends + roots(p[:2], directions[:, :2], solid.radius_m)
            case Sphere():
                return roots(origin - np.array(solid.centre_m), directions, solid.radius_m)


def roots(p: Floats, d: Floats, radius: float) -> list[Floats]:
    """Both t with |p + t d| = radius; NaN where there is none."""
    a, b, c = (d * d).sum(axis=1), d @ p, p @ p - radius * radius
    root = np.sqrt(b * b - a * c)
    return [(-b - root) / a, (-b + root) / a]
