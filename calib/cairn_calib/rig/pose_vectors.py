"""Poses as six numbers, for solvers: a rotation vector in radians and a translation in metres, and its derivatives.

    v_dst_src = (rx, ry, rz, tx, ty, tz)       T_dst_src = [exp(r) | t]        OpenCV's rvec and tvec, mrcal's rt

The rotation vector points along the axis, its length is the angle (Rodrigues). At a whole turn it is singular; a vector
from a matrix is half a turn long at most. A small change of the vector turns the frame about dst's axes by J_l(r) dr.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, quaternion_from_transform
from cairn_map.arrays import Floats

SERIES_BELOW_RAD = 0.1
"""Under this angle the closed forms lose digits, and four terms of their series are exact."""


def transform_from_vector(v_dst_src: npt.ArrayLike) -> Transform:
    """(..., 4, 4) transforms of (..., 6) vectors, radians and metres."""
    v = np.asarray(v_dst_src, dtype=np.float64)
    T = np.zeros((*v.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation_from_vector(v[..., :3])
    T[..., :3, 3] = v[..., 3:]
    T[..., 3, 3] = 1
    return T


def vector_from_transform(T_dst_src: Transform) -> Floats:
    """(6,) rotation vector of at most pi radians, and translation, of a (4, 4) transform; the mirror of the above."""
    q = quaternion_from_transform(T_dst_src)
    sine = float(np.linalg.norm(q[:3]))
    # 2 atan2(s, w) / s, which goes to 2 with s.
    length = 2 * np.arctan2(sine, q[3]) / sine if sine > 0 else 2.0
    return np.concatenate([q[:3] * length, T_dst_src[:3, 3]])


def rotation_from_vector(r: Floats) -> Floats:
    """(..., 3, 3) rotations by (..., 3) vectors, radians: I + a [r] + b [r]^2."""
    K = cross_matrix(r)
    a, b, _ = _terms(r)
    return np.eye(3) + a * K + b * (K @ K)


def left_jacobian(r: Floats) -> Floats:
    """(..., 3, 3) J_l of (..., 3) vectors: exp(r + dr) = exp(J_l dr) exp(r) for a small dr."""
    K = cross_matrix(r)
    _, b, c = _terms(r)
    return np.eye(3) + b * K + c * (K @ K)


def cross_matrix(r: Floats) -> Floats:
    """(..., 3, 3) matrices [r] with [r] p = r x p, of (..., 3) vectors."""
    x, y, z = np.moveaxis(r, -1, 0)
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def moved_points(v_dst_src: Floats, points_src: Floats) -> tuple[Floats, Floats]:
    """Points carried by poses, and how they move with them.

    Args:
        v_dst_src: (..., 6), radians and metres.
        points_src: (..., N, 3), metres; the leading axes are the poses', or broadcast with them.

    Returns:
        (..., N, 3) metres, frame dst; (..., N, 3, 6) metres a radian and metres a metre. By the point itself they
        move with `rotation_from_vector`.
    """
    r = v_dst_src[..., :3]
    turned = points_src @ np.swapaxes(rotation_from_vector(r), -1, -2)
    by_rotation = -cross_matrix(turned) @ left_jacobian(r)[..., None, :, :]
    by_translation = np.broadcast_to(np.eye(3), by_rotation.shape)
    return turned + v_dst_src[..., None, 3:], np.concatenate([by_rotation, by_translation], axis=-1)


def _terms(r: Floats) -> tuple[Floats, Floats, Floats]:
    """(..., 1, 1) each: sin w / w, (1 - cos w) / w^2, (w - sin w) / w^3, of the angle w."""
    s = np.sum(r * r, axis=-1)[..., None, None]
    small = s < SERIES_BELOW_RAD**2
    safe = np.where(small, 1.0, s)
    w = np.sqrt(safe)
    a = np.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), np.sin(w) / w)
    b = np.where(small, (1 - s / 12 * (1 - s / 30 * (1 - s / 56))) / 2, 2 * np.sin(w / 2) ** 2 / safe)
    c = np.where(small, (1 - s / 20 * (1 - s / 42 * (1 - s / 72))) / 6, (w - np.sin(w)) / (safe * w))
    return a, b, c
