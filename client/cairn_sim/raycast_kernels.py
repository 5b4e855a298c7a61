"""Rays against solids, exactly: every solid is convex, so a ray is inside it over one interval of its length.

    box         the overlap of three pairs of planes, in the box's own axes (turned by its yaw about z)
    cylinder    the overlap of a circle in x, y and a pair of planes in z
    sphere      the two roots of a quadratic

The ray meets the solid where that interval begins, if it begins in front of the origin: a solid is seen
from outside only. The nearest of these is the hit. There is no grid and no marching, so a range is right to
rounding, about 1e-15 of it. A few dozen solids need no tree: a ray first asks each one's cone, the directions
under which its bounding sphere is seen from the origin, and most say no.

`render.cast` is the caller that checks; tests/cairn_sim/naive_raycast.py is the slow twin.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

SIDE = 0
"""Face code of a cylinder's curved side and of a sphere; a box's face and a cylinder's end have their axis, 0 to 2."""
END = 2
PARALLEL = 1e-150
"""A direction component below this is parallel to the planes; its square is still a normal number."""
FAR = 1e150
"""Stands for the inverse of a parallel component: finite, so that FAR times zero is zero and not NaN."""
CONE_MARGIN = 1e-9
"""Taken off a cone's cosine, so that rounding never cuts a solid's rim."""


@njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(
    origin: Floats, directions: Floats, boxes: Floats, cylinders: Floats, spheres: Floats
) -> tuple[Floats, Ints, Floats, Floats]:
    """The first solid that each ray from one origin meets.

    Args:
        origin: (3,) metres.
        directions: (N, 3) unit vectors; a NaN one meets nothing.
        boxes: (B, 8) rows centre x y z, half size x y z, cosine and sine of the yaw.
        cylinders: (C, 5) rows axis x y, lowest z, highest z, radius.
        spheres: (S, 4) rows centre x y z, radius.

    Returns:
        range_m (N,), infinite where nothing is met; solid (N,), counted through boxes, then cylinders, then
        spheres, -1 for none; normal (N, 3), outward unit vectors; uv (N, 2), metres along the surface.
    """
    n_rays = len(directions)
    range_m = np.full(n_rays, np.inf)
    solid = np.full(n_rays, -1, np.int32)
    normal = np.zeros((n_rays, 3))
    uv = np.zeros((n_rays, 2))
    cones = np.empty((len(boxes) + len(cylinders) + len(spheres), 4))
    _cones_into(cones, origin, boxes, cylinders, spheres)
    ox, oy, oz = origin[0], origin[1], origin[2]
    for i in range(n_rays):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        t, k, face = _first_entry(ox, oy, oz, dx, dy, dz, cones, boxes, cylinders, spheres)
        if k < 0:
            continue
        range_m[i], solid[i] = t, k
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        if k < len(boxes):
            _box_surface_into(normal[i], uv[i], x, y, z, boxes[k], face)
        elif k < len(boxes) + len(cylinders):
            _cylinder_surface_into(normal[i], uv[i], x, y, z, cylinders[k - len(boxes)], face)
        else:
            _sphere_surface_into(normal[i], uv[i], x, y, z, spheres[k - len(boxes) - len(cylinders)])
    return range_m, solid, normal, uv


@njit(cache=True, nogil=True, error_model="numpy")
def _first_entry(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    cones: Floats,
    boxes: Floats,
    cylinders: Floats,
    spheres: Floats,
) -> tuple[float, int, int]:
    """Range, solid and face where the ray first enters a solid; infinite and -1 when it enters none."""
    best, which, best_face = np.inf, -1, SIDE
    n_boxes, n_cylinders = len(boxes), len(cylinders)
    # A loop for each kind: one loop that branched on the kind took 2.5 times as long (small room, 320 x 240 rays).
    for k in range(n_boxes):
        if dx * cones[k, 0] + dy * cones[k, 1] + dz * cones[k, 2] >= cones[k, 3]:
            t, face = _enter_box(ox, oy, oz, dx, dy, dz, boxes[k])
            if 0.0 < t < best:
                best, which, best_face = t, k, face
    for j in range(n_cylinders):
        k = n_boxes + j
        if dx * cones[k, 0] + dy * cones[k, 1] + dz * cones[k, 2] >= cones[k, 3]:
            t, face = _enter_cylinder(ox, oy, oz, dx, dy, dz, cylinders[j])
            if 0.0 < t < best:
                best, which, best_face = t, k, face
    for j in range(len(spheres)):
        k = n_boxes + n_cylinders + j
        if dx * cones[k, 0] + dy * cones[k, 1] + dz * cones[k, 2] >= cones[k, 3]:
            t, face = _enter_sphere(ox, oy, oz, dx, dy, dz, spheres[j])
            if 0.0 < t < best:
                best, which, best_face = t, k, face
    return best, which, best_face


@njit(cache=True, nogil=True, error_model="numpy")
def _cones_into(cones: Floats, origin: Floats, boxes: Floats, cylinders: Floats, spheres: Floats) -> None:
    """Rows of unit axis and cosine of the half angle; -2 from within the bounding sphere: every ray may meet it."""
    for b in range(len(boxes)):
        box = boxes[b]
        radius = math.sqrt(box[3] * box[3] + box[4] * box[4] + box[5] * box[5])
        _cone_into(cones[b], origin, box[0], box[1], box[2], radius)
    for c in range(len(cylinders)):
        cylinder = cylinders[c]
        radius = math.hypot(cylinder[4], (cylinder[3] - cylinder[2]) / 2)
        middle_z = (cylinder[2] + cylinder[3]) / 2
        _cone_into(cones[len(boxes) + c], origin, cylinder[0], cylinder[1], middle_z, radius)
    for s in range(len(spheres)):
        sphere = spheres[s]
        _cone_into(cones[len(boxes) + len(cylinders) + s], origin, sphere[0], sphere[1], sphere[2], sphere[3])


@njit(cache=True, nogil=True, error_model="numpy")
def _cone_into(cone: Floats, origin: Floats, x: float, y: float, z: float, radius: float) -> None:
    cone[0], cone[1], cone[2], cone[3] = x - origin[0], y - origin[1], z - origin[2], -2.0
    distance = math.sqrt(cone[0] * cone[0] + cone[1] * cone[1] + cone[2] * cone[2])
    if distance > radius:
        cone[:3] /= distance
        cone[3] = math.sqrt(1.0 - (radius / distance) ** 2) - CONE_MARGIN
    else:
        cone[:3] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _inverse(d: float) -> float:
    return 1.0 / d if abs(d) > PARALLEL else FAR


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_box(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, box: Floats) -> tuple[float, int]:
    """Where the ray enters the box and through faces of which axis; -1 when it does not."""
    px, py = ox - box[0], oy - box[1]
    cos, sin = box[6], box[7]
    inverse = _inverse(cos * dx + sin * dy)
    middle, half = -(cos * px + sin * py) * inverse, box[3] * abs(inverse)
    near, far, axis = middle - half, middle + half, 0
    inverse = _inverse(cos * dy - sin * dx)
    middle, half = (sin * px - cos * py) * inverse, box[4] * abs(inverse)
    if middle - half > near:
        near, axis = middle - half, 1
    far = min(far, middle + half)
    inverse = _inverse(dz)
    middle, half = (box[2] - oz) * inverse, box[5] * abs(inverse)
    if middle - half > near:
        near, axis = middle - half, 2
    far = min(far, middle + half)
    return (near, axis) if near < far else (-1.0, axis)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_cylinder(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, cylinder: Floats
) -> tuple[float, int]:
    """Where the ray enters the cylinder, through its side or an end; -1 when it does not."""
    px, py, radius = ox - cylinder[0], oy - cylinder[1], cylinder[4]
    a = dx * dx + dy * dy
    b = px * dx + py * dy
    # The ray's miss of the axis, squared, by the cross product: b^2 - a c would cancel far from the axis.
    cross = px * dy - py * dx
    root = a * radius * radius - cross * cross
    if a > PARALLEL * PARALLEL:
        if not root > 0.0:
            return -1.0, SIDE
        near, far = (-b - math.sqrt(root)) / a, (-b + math.sqrt(root)) / a
    elif px * px + py * py < radius * radius:
        near, far = -np.inf, np.inf
    else:
        return -1.0, SIDE
    inverse = _inverse(dz)
    one, other = (cylinder[2] - oz) * inverse, (cylinder[3] - oz) * inverse
    face = SIDE
    if min(one, other) > near:
        near, face = min(one, other), END
    far = min(far, max(one, other))
    return (near, face) if near < far else (-1.0, face)


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_sphere(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, sphere: Floats
) -> tuple[float, int]:
    """Where the ray enters the sphere; -1 when it does not."""
    px, py, pz = ox - sphere[0], oy - sphere[1], oz - sphere[2]
    b = px * dx + py * dy + pz * dz
    qx, qy, qz = px - b * dx, py - b * dy, pz - b * dz
    root = sphere[3] * sphere[3] - (qx * qx + qy * qy + qz * qz)
    return (-b - math.sqrt(root), SIDE) if root > 0.0 else (-1.0, SIDE)


@njit(cache=True, nogil=True, error_model="numpy")
def _box_surface_into(normal: Floats, uv: Floats, x: float, y: float, z: float, box: Floats, axis: int) -> None:
    """Normal, and the two coordinates across the face, in metres from the box's centre."""
    cos, sin = box[6], box[7]
    lx = cos * (x - box[0]) + sin * (y - box[1])
    ly = cos * (y - box[1]) - sin * (x - box[0])
    lz = z - box[2]
    if axis == 0:
        sign = math.copysign(1.0, lx)
        normal[0], normal[1] = sign * cos, sign * sin
        uv[0], uv[1] = ly, lz
    elif axis == 1:
        sign = math.copysign(1.0, ly)
        normal[0], normal[1] = -sign * sin, sign * cos
        uv[0], uv[1] = lx, lz
    else:
        normal[2] = math.copysign(1.0, lz)
        uv[0], uv[1] = lx, ly


@njit(cache=True, nogil=True, error_model="numpy")
def _cylinder_surface_into(
    normal: Floats, uv: Floats, x: float, y: float, z: float, cylinder: Floats, face: int
) -> None:
    """Normal, and arc length and height on the side, or x and y on an end."""
    lx, ly, lz = x - cylinder[0], y - cylinder[1], z - (cylinder[2] + cylinder[3]) / 2
    if face == SIDE:
        normal[0], normal[1] = lx / cylinder[4], ly / cylinder[4]
        uv[0], uv[1] = cylinder[4] * math.atan2(ly, lx), lz
    else:
        normal[2] = math.copysign(1.0, lz)
        uv[0], uv[1] = lx, ly


@njit(cache=True, nogil=True, error_model="numpy")
def _sphere_surface_into(normal: Floats, uv: Floats, x: float, y: float, z: float, sphere: Floats) -> None:
    """Normal, and arc length along the equator and height."""
    lx, ly, lz = x - sphere[0], y - sphere[1], z - sphere[2]
    normal[0], normal[1], normal[2] = lx / sphere[3], ly / sphere[3], lz / sphere[3]
    uv[0], uv[1] = sphere[3] * math.atan2(ly, lx), lz
