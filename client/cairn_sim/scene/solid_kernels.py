"""Entry of a ray into a solid, and the surface at that point; exact, in the solid's own axes.

    box         the overlap of three pairs of planes
    cylinder    the overlap of a circle in x, y and a pair of planes in z
    sphere      the two roots of a quadratic
    plane       where the ray goes below z = 0

Every solid is convex, so a ray is inside it over one interval of its length, and meets it where that begins. There is
no grid and no marching, so a range is right to rounding, about 1e-15 of it.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from cairn_map.arrays import Floats, Int32s

Bytes = npt.NDArray[np.int8]
Marks = npt.NDArray[np.uint8]

BOX, CYLINDER, SPHERE, PLANE = 0, 1, 2, 3
SIDE, END = 0, 2
"""Face of a cylinder; a box's faces have the number of their axis, a plane's is `END`, a sphere's `SIDE`."""
PARALLEL = 1e-150
"""A direction component below this is parallel to the planes; its square is still a normal number."""
FAR = 1e150
"""Stands for the inverse of a parallel component: finite, so that FAR times zero is zero and not NaN."""


class Shapes(NamedTuple):
    """P solids as arrays."""

    kind: Bytes
    """(P,) box, cylinder, sphere, plane."""
    frame: Floats
    """(P, 12) R_solid_map by rows, then the centre in the map."""
    half_m: Floats
    """(P, 3) half of what the solid spans along its own axes."""
    optics: Bytes
    """(P,) `Optics`."""
    texture: Floats
    """(P, 6) changes a metre along u and v, phase in u and v, grain, spots a metre."""
    bounds: Floats
    """(P, 6) lowest and highest corner of each solid, with a margin."""
    endless: Int32s
    """Numbers of the planes, which no tree can hold."""
    nodes: Floats
    """`tree.tree_of`, as `links` and `leaves`, which holds numbers of solids."""
    links: Int32s
    leaves: Int32s


@njit(nogil=True, error_model="numpy")
def enter(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    k: int,
    kind: Bytes,
    frame: Floats,
    half_m: Floats,
) -> tuple[float, int]:
    """Distance along the ray to a solid, and the number of the face that it enters; -1 when it misses."""
    # The ray in the solid's own axes, where every shape is centred and upright.
    px, py, pz = _own(ox - frame[k, 9], oy - frame[k, 10], oz - frame[k, 11], frame, k)
    ex, ey, ez = _own(dx, dy, dz, frame, k)
    # Own normal, and lengths along the face.
    if kind[k] == BOX:
        return _enter_box(px, py, pz, ex, ey, ez, half_m[k, 0], half_m[k, 1], half_m[k, 2])
    if kind[k] == CYLINDER:
        return _enter_cylinder(px, py, pz, ex, ey, ez, half_m[k, 0], half_m[k, 2])
    if kind[k] == SPHERE:
        return _enter_sphere(px, py, pz, ex, ey, ez, half_m[k, 0])
    # A plane: the ray goes below z = 0.
    return (-pz / ez, END) if ez < -PARALLEL else (-1.0, END)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_box(
    px: float, py: float, pz: float, ex: float, ey: float, ez: float, hx: float, hy: float, hz: float
) -> tuple[float, int]:
    # Slab by slab: the entry is the last of three, the exit the first; the face is the axis that is entered last.
    inverse = inverse_of(ex)
    middle, reach = -px * inverse, hx * abs(inverse)
    near, far, axis = middle - reach, middle + reach, 0
    inverse = inverse_of(ey)
    middle, reach = -py * inverse, hy * abs(inverse)
    if middle - reach > near:
        near, axis = middle - reach, 1
    far = min(far, middle + reach)
    inverse = inverse_of(ez)
    middle, reach = -pz * inverse, hz * abs(inverse)
    if middle - reach > near:
        near, axis = middle - reach, 2
    far = min(far, middle + reach)
    return (near, axis) if near < far else (-1.0, axis)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_cylinder(
    px: float, py: float, pz: float, ex: float, ey: float, ez: float, radius: float, half: float
) -> tuple[float, int]:
    # The circle: |p + t e|^2 = r^2 in x and y, a quadratic in t.
    a = ex * ex + ey * ey
    b = px * ex + py * ey
    # The ray's miss of the axis, squared, by the cross product: b^2 - a c would cancel far from the axis.
    cross = px * ey - py * ex
    root = a * radius * radius - cross * cross
    if a > PARALLEL * PARALLEL:
        if not root > 0.0:
            return -1.0, SIDE
        near, far = (-b - math.sqrt(root)) / a, (-b + math.sqrt(root)) / a
    # Parallel to the axis: inside the circle for ever, or never.
    elif px * px + py * py < radius * radius:
        near, far = -np.inf, np.inf
    else:
        return -1.0, SIDE
    inverse = inverse_of(ez)
    middle, reach = -pz * inverse, half * abs(inverse)
    # The caps: an entry through one of them is later than that through the side.
    face = SIDE
    if middle - reach > near:
        near, face = middle - reach, END
    far = min(far, middle + reach)
    return (near, face) if near < far else (-1.0, face)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_sphere(px: float, py: float, pz: float, ex: float, ey: float, ez: float, radius: float) -> tuple[float, int]:
    # The nearest point of the ray to the centre, q = p - b e; e is a unit vector.
    b = px * ex + py * ey + pz * ez
    qx, qy, qz = px - b * ex, py - b * ey, pz - b * ez
    root = radius * radius - (qx * qx + qy * qy + qz * qz)
    return (-b - math.sqrt(root), SIDE) if root > 0.0 else (-1.0, SIDE)


@njit(nogil=True, error_model="numpy")
def inverse_of(d: float) -> float:
    """1 / d, finite where the direction is parallel to the planes."""
    return 1.0 / d if abs(d) > PARALLEL else FAR


@njit(cache=True, nogil=True, error_model="numpy")
def _own(x: float, y: float, z: float, frame: Floats, k: int) -> tuple[float, float, float]:
    """A direction of the map in a solid's own axes."""
    return (
        frame[k, 0] * x + frame[k, 1] * y + frame[k, 2] * z,
        frame[k, 3] * x + frame[k, 4] * y + frame[k, 5] * z,
        frame[k, 6] * x + frame[k, 7] * y + frame[k, 8] * z,
    )


@njit(nogil=True, error_model="numpy")
def surface_at(
    x: float, y: float, z: float, k: int, face: int, kind: Bytes, f: Floats, half_m: Floats
) -> tuple[float, float, float, float, float]:
    """Outward normal in the map, and the two lengths along the surface, at a point on a solid's face."""
    lx, ly, lz = _own(x - f[k, 9], y - f[k, 10], z - f[k, 11], f, k)
    nx, ny, nz = 0.0, 0.0, 0.0
    u, v = lx, ly
    if kind[k] == BOX:
        if face == 0:
            nx = math.copysign(1.0, lx)
            u, v = ly, lz
        elif face == 1:
            ny = math.copysign(1.0, ly)
            u, v = lx, lz
        else:
            nz = math.copysign(1.0, lz)
    elif kind[k] == PLANE:
        nz = 1.0
    elif kind[k] == CYLINDER and face == END:
        nz = math.copysign(1.0, lz)
    else:
        radius = half_m[k, 0]
        nx, ny = lx / radius, ly / radius
        nz = lz / radius if kind[k] == SPHERE else 0.0
        # Arc length and height.
        u, v = radius * math.atan2(ly, lx), lz
    return (
        f[k, 0] * nx + f[k, 3] * ny + f[k, 6] * nz,
        f[k, 1] * nx + f[k, 4] * ny + f[k, 7] * nz,
        f[k, 2] * nx + f[k, 5] * ny + f[k, 8] * nz,
        u,
        v,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def second_at(points: Floats, solids: Int32s, shapes: Shapes) -> Marks:
    """(N,) 1 where the surface of the given solid nearest to each (N, 3) point shows the second material."""
    kind, f, half_m, _, texture, _, _, _, _, _ = shapes
    second = np.zeros(len(points), np.uint8)
    for i in range(len(points)):
        k = solids[i]
        if k < 0:
            continue
        half = half_m[k]
        lx, ly, lz = _own(points[i, 0] - f[k, 9], points[i, 1] - f[k, 10], points[i, 2] - f[k, 11], f, k)
        face = END
        if kind[k] == BOX:
            # The face whose plane the point lies farthest outside of, or nearest to.
            outside = max(max(abs(lx) - half[0], abs(ly) - half[1]), abs(lz) - half[2])
            face = 0 if abs(lx) - half[0] == outside else (1 if abs(ly) - half[1] == outside else 2)
        elif kind[k] == CYLINDER:
            face = SIDE if math.hypot(lx, ly) - half[0] > abs(lz) - half[2] else END
        elif kind[k] == SPHERE:
            face = SIDE
        _, _, _, u, v = surface_at(points[i, 0], points[i, 1], points[i, 2], k, face, kind, f, half_m)
        second[i] = turn_at(u, v, k, texture)
    return second


@njit(nogil=True, error_model="numpy")
def turn_at(u: float, v: float, k: int, texture: Floats) -> int:
    """Number of the material, 0 or 1, that a texture shows at (u, v) metres on face k."""
    # A checker: steps along u and v, counted together; odd ones show the second material.
    turns = math.floor((u - texture[k, 2]) * texture[k, 0]) + math.floor((v - texture[k, 3]) * texture[k, 1])
    return int(turns) & 1


@njit(nogil=True, error_model="numpy")
def grain_at(u: float, v: float, salt: int) -> float:
    """Smooth pseudo-random pattern, -1 to 1: values on a lattice of step 1 and one of step 1/3, interpolated."""
    return 0.65 * _lattice(u, v, salt) + 0.35 * _lattice(3.0 * u, 3.0 * v, salt + 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _lattice(u: float, v: float, salt: int) -> float:
    i, j = math.floor(u), math.floor(v)
    # Bilinear between the four corners of the lattice cell.
    a, b = u - i, v - j
    # Smoothstep, so that the pattern has no creases at lattice lines.
    a, b = a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b)
    low = _hashed(i, j, salt) * (1.0 - a) + _hashed(i + 1, j, salt) * a
    high = _hashed(i, j + 1, salt) * (1.0 - a) + _hashed(i + 1, j + 1, salt) * a
    return low * (1.0 - b) + high * b


@njit(cache=True, nogil=True, error_model="numpy")
def _hashed(i: float, j: float, salt: int) -> float:
    """-1 to 1, by the finalizer of splitmix64 (Steele, Lea and Flood 2014)."""
    # One 64-bit number of place and salt, its bits mixed; 53 of them become a float.
    z = np.uint64(np.int64(i)) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(np.int64(j)) * np.uint64(0xC2B2AE3D27D4EB4F)
    z += np.uint64(salt) * np.uint64(0x165667B19E3779F9)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * (2.0 / 9007199254740992.0) - 1.0
