"""Rigid transforms as 4x4 matrices, named `T_dst_src`: points *from* src *to* dst.

    p_map = T_map_rig @ T_rig_tof @ p_tof          neighbouring letters cancel

A pose is checked once, where it enters (`check_transform`), and trusted afterwards.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError

Transform = npt.NDArray[np.float64]
Points = npt.NDArray[np.float64]

ROTATION_TOLERANCE = 1e-4
"""Largest deviation of R^T R from the identity that is taken for rounding in a text file."""
IDENTITY, LAST_ROW = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])
LAST_ROW_TOLERANCE = np.array([1e-9, 1e-9, 1e-9, 1e-5 + 1e-9])
"""Largest deviation of the last row from 0 0 0 1. A pose is checked with every scan, and `np.allclose` and `np.eye`
take half of that."""


def check_transform(
    values: npt.ArrayLike, *, name: str = "transform", tolerance: float = ROTATION_TOLERANCE
) -> Transform:
    """A (4, 4) float64 rigid transform, its rotation made orthonormal to float precision.

    Args:
        values: 4x4 numbers.
        name: of the transform, for messages.
        tolerance: largest `rotation_deviation` that is accepted.

    Raises:
        BadInputError: not 4x4, not finite, last row not 0 0 0 1, or not a rotation (a mirror or a scale).
    """
    T = np.array(values, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise BadInputError("bad_transform", f"{name} must be 4x4 finite numbers, got shape {T.shape}")
    if (np.abs(T[3] - LAST_ROW) > LAST_ROW_TOLERANCE).any():
        raise BadInputError("bad_transform", f"{name} must end in the row 0 0 0 1, got {T[3].tolist()}")
    R = T[:3, :3]
    deviation = rotation_deviation(R)
    a, b, c = R.tolist()
    det = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    # Not `deviation > ...`: of numbers beyond 1e154 it may be NaN.
    if not deviation <= tolerance or det < 0:
        raise BadInputError(
            "bad_transform", f"{name} must hold a rotation: R^T R is off by {deviation:.2g}, det R is {det:.3g}"
        )
    U, _, Vt = np.linalg.svd(R)
    T[:3, :3] = U @ Vt
    T[3] = LAST_ROW
    return T


def rotation_deviation(R: npt.NDArray[np.float64]) -> float:
    """Largest absolute entry of R^T R - I of a (3, 3) matrix: 0 for a rotation or a mirror; NaN beyond 1e154."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(R.T @ R - IDENTITY).max())


def inverse(T_dst_src: Transform) -> Transform:
    """`T_src_dst`, by transposing the rotation (exact for a rigid transform)."""
    T = np.empty((4, 4))
    T[:3, :3], T[3] = T_dst_src[:3, :3].T, LAST_ROW
    T[:3, 3] = -T_dst_src[:3, :3].T @ T_dst_src[:3, 3]
    return T


def transform_points(T_dst_src: Transform, points_src: npt.NDArray[np.floating]) -> Points:
    """(..., 3) points, metres, carried from src to dst (Eq. 5 of Kocmanova et al.); NaN stays NaN."""
    points: Points = points_src.astype(np.float64) @ T_dst_src[:3, :3].T + T_dst_src[:3, 3]
    return points


def transform_from_quaternion(t: npt.ArrayLike, q_xyzw: npt.ArrayLike) -> Transform:
    """The transform of a TUM trajectory line: translation in metres, unit quaternion x y z w.

    Raises:
        BadInputError: the quaternion is shorter than 0.5 or longer than 1.5, so it is no rounding of a unit one.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if q.shape != (4,) or not 0.5 < norm < 1.5:
        raise BadInputError("bad_transform", f"a quaternion needs four numbers of unit length, got {q.tolist()}")
    x, y, z, w = q / norm
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = np.asarray(t, dtype=np.float64)
    return T


def quaternion_from_transform(T_dst_src: Transform) -> npt.NDArray[np.float64]:
    """Unit quaternion x y z w of the rotation, w >= 0; the mirror of `transform_from_quaternion`."""
    q: npt.NDArray[np.float64] = quaternions_from_transforms(T_dst_src[None])[0]
    return q


def quaternions_from_transforms(T_dst_src: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(N, 4) unit quaternions x y z w of the rotations of (N, 4, 4) transforms, as `quaternion_from_transform`."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(T_dst_src[:, :3, :3], 0, 2)
    # Bar-Itzhack: the quaternion is the eigenvector of K to its largest eigenvalue; no case split, no cancellation.
    K = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    q = np.linalg.eigh(np.moveaxis(K, 2, 0))[1][:, :, 3]
    return np.asarray(np.where(q[:, 3:] < 0, -q, q))


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike, *, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Transform:
    """`T_map_camera` of a camera at `eye` that looks at `target`: x right, y down, z forward."""
    eye_m = np.asarray(eye, dtype=np.float64)
    z = np.asarray(target, dtype=np.float64) - eye_m
    z /= np.linalg.norm(z)
    x = np.cross(z, np.asarray(up, dtype=np.float64))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = eye_m
    return T
