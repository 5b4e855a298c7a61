"""Exact signed distances from points to solids; `Scene` is the caller, `Solid.distance_m` the slow twin."""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats, Int32s
from cairn_sim.scene.solid_kernels import BOX, CYLINDER, SPHERE, Shapes


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_solids(points: Floats, shapes: Shapes) -> tuple[Floats, Int32s]:
    """Metres from each (N, 3) point to the nearest solid, negative inside, and its number; NaN and -1 for NaN.

    Inside of several solids it is the one in which the point lies deepest; of equals, the first.
    """
    kind, frame, half_m, _, _, bounds, _, _, _, _ = shapes
    best, which = np.full(len(points), np.nan), np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x != x or y != y or z != z:
            continue
        nearest = np.inf
        for k in range(len(kind)):
            # The box around a solid bounds its distance from below, at a tenth of the price; one that is gone is
            # infinitely far.
            if _outside_box(x, y, z, bounds, k) >= nearest:
                continue
            distance = _distance(x, y, z, k, kind, frame, half_m)
            if distance < nearest:
                nearest = distance
                which[i] = k
        best[i] = nearest
    return best, which


@njit(cache=True, nogil=True, error_model="numpy")
def _outside_box(x: float, y: float, z: float, bounds: Floats, k: int) -> float:
    """A lower bound of the distance: along one axis; negative or 0 inside, where it bounds nothing: minus infinity."""
    a = max(bounds[k, 0] - x, x - bounds[k, 3])
    b = max(bounds[k, 1] - y, y - bounds[k, 4])
    c = max(bounds[k, 2] - z, z - bounds[k, 5])
    out = max(max(a, b), c)
    return out if out > 0.0 else -np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _distance(x: float, y: float, z: float, k: int, kind: npt.NDArray[np.int8], f: Floats, half_m: Floats) -> float:
    # The point in the solid's own axes.
    dx, dy, dz = x - f[k, 9], y - f[k, 10], z - f[k, 11]
    lx = f[k, 0] * dx + f[k, 1] * dy + f[k, 2] * dz
    ly = f[k, 3] * dx + f[k, 4] * dy + f[k, 5] * dz
    lz = f[k, 6] * dx + f[k, 7] * dy + f[k, 8] * dz
    # A plane's distance is the height above it.
    distance: float = lz
    if kind[k] == BOX:
        a, b, c = abs(lx) - half_m[k, 0], abs(ly) - half_m[k, 1], abs(lz) - half_m[k, 2]
        # Outside: to the nearest face, edge or corner; inside: minus the depth below the nearest face.
        distance = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2) + min(max(max(a, b), c), 0.0)
    elif kind[k] == CYLINDER:
        a, c = math.hypot(lx, ly) - half_m[k, 0], abs(lz) - half_m[k, 2]
        distance = math.sqrt(max(a, 0.0) ** 2 + max(c, 0.0) ** 2) + min(max(a, c), 0.0)
    elif kind[k] == SPHERE:
        distance = math.sqrt(lx * lx + ly * ly + lz * lz) - half_m[k, 0]
    return distance
