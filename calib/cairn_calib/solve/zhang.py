"""First guess of a camera and of a flat board's poses, from homographies alone.

Z. Zhang, "A flexible new technique for camera calibration", 2000; equation numbers below are his.

Each view's homography H = K [r1 r2 t] makes two equations in the image of the absolute conic, B = K^-T K^-1, for r1
and r2 are perpendicular and equally long. Lens distortion is unknown here and bends all of it, so several guesses are
made: Zhang's own, one with the principal point in the middle, and where both are impossible, fixed fields of view. The
guess that meets the corners best is taken.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from cairn_calib.board.corners import Corners
from cairn_calib.board.homography import fit_homography
from cairn_calib.rig.poses import Transform
from cairn_map.arrays import Floats

FOCAL_SHARES = tuple(np.geomspace(0.35, 8.0, 14))
"""Focal lengths that are tried, shares of the width: fields of view from 110 to 7 degrees."""
SANE = (0.2, 20.0)
"""Bounds of a plausible focal length, shares of the width."""
OFF_CENTRE = 0.25
"""Largest plausible distance of the principal point from the image's middle, share of the image's size."""


def first_camera_matrix(views: Sequence[Corners], homographies: Sequence[Floats], size_px: tuple[int, int]) -> Floats:
    """(3, 3) camera matrix without skew that meets the corners of views best, of those that homographies suggest."""
    best, least = np.eye(3), np.inf
    for K in _guesses(homographies, size_px):
        poses = [pose_from_homography(H, K) for H in homographies]
        misses = [_misses(K, T, each) for T, each in zip(poses, views, strict=True)]
        rms = float(np.sqrt(np.nanmean(np.concatenate(misses) ** 2)))
        # Zhang's come first: others must be clearly better.
        if rms < 0.98 * least:
            best, least = K, rms
    return best


def homography_of(corners: Corners) -> Floats | None:
    """(3, 3) from metres on the board to pixels; None where its corners lie on a line."""
    seen = corners.seen
    return fit_homography(corners.board.points()[seen, :2], corners.pixels[seen])


def pose_from_homography(H: Floats, K: Floats) -> Transform:
    """`T_camera_board` of a homography from metres on the board to pixels of an undistorted camera."""
    # [r1 r2 t] up to scale (Zhang, section 3.1), scaled so that r1 and r2 are 1 long, with the board before the camera.
    columns = np.linalg.solve(K, H)
    columns *= 2 / (np.linalg.norm(columns[:, 0]) + np.linalg.norm(columns[:, 1]))
    if columns[2, 2] < 0:
        columns = -columns
    # The rotation nearest to [r1 r2 r1 x r2] (Zhang, appendix C).
    U, _, Vt = np.linalg.svd(np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])]))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = columns[:, 2]
    return T


def mirrored_pose(T_camera_board: Transform, middle: Floats) -> Transform:
    """The other pose in which a small, distant board looks nearly the same: its normal mirrored at the line of sight.

    Schweighofer and Pinz 2006. `middle` is the (3,) middle of the board, metres, board frame.
    """
    at = T_camera_board[:3, :3] @ middle + T_camera_board[:3, 3]
    sight = at / np.linalg.norm(at)
    normal = T_camera_board[:3, 2]
    axis = np.cross(normal, sight)
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ sight)
    if sine < 1e-9:
        return T_camera_board.copy()
    # Rodrigues: turn by twice the angle between normal and sight, about the board's middle.
    angle = 2 * np.arctan2(sine, cosine)
    unit = axis / sine
    K = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
    T = T_camera_board.copy()
    T[:3, :3] = (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K) @ T_camera_board[:3, :3]
    T[:3, 3] = at - T[:3, :3] @ middle
    return T


def _guesses(homographies: Sequence[Floats], size_px: tuple[int, int]) -> Iterator[Floats]:
    width, height = size_px
    middle = np.array([width - 1, height - 1]) / 2
    found = False
    full = _zhang_matrix(homographies, middle, width)
    if full is not None and np.all(np.abs(full[:2, 2] - middle) < OFF_CENTRE * np.array(size_px)):
        found = True
        yield full
    centred = _centred_matrix(homographies, middle)
    if centred is not None and SANE[0] < centred[0, 0] / width < SANE[1]:
        found = True
        yield centred
    for share in () if found else FOCAL_SHARES:
        yield _matrix(share * width, share * width, *middle)


def _zhang_matrix(homographies: Sequence[Floats], middle: Floats, width: int) -> Floats | None:
    """Camera matrix with fx, fy, cx and cy, from three views or more; None where they come out impossible."""
    if len(homographies) < 3:
        return None
    # Near 1 in all coordinates, so that the equations weigh alike.
    shift = np.array([[1 / width, 0, -middle[0] / width], [0, 1 / width, -middle[1] / width], [0, 0, 1]])
    rows = []
    for H in homographies:
        h = shift @ H
        h = h / np.linalg.norm(h[:, :2])
        # Zhang's eq. 8: h1^T B h2 = 0 and h1^T B h1 = h2^T B h2.
        rows += [_conic_row(h[:, 0], h[:, 1]), _conic_row(h[:, 0], h[:, 0]) - _conic_row(h[:, 1], h[:, 1])]
    # B spans the null space of Zhang's eq. 9; its sign makes the first entry positive.
    _, _, Vt = np.linalg.svd(np.array(rows))
    xx, yy, xz, yz, zz = Vt[-1] * np.sign(Vt[-1, 0] or 1.0)
    if xx <= 0 or yy <= 0:
        return None
    # Zhang, appendix B, without skew: `rest` is his scale lambda.
    rest = zz - xz**2 / xx - yz**2 / yy
    if rest <= 0:
        return None
    fx, fy = np.sqrt(rest / xx) * width, np.sqrt(rest / yy) * width
    if not (SANE[0] < fx / width < SANE[1] and 0.5 < fx / fy < 2):
        return None
    return _matrix(fx, fy, middle[0] - width * xz / xx, middle[1] - width * yz / yy)


def _conic_row(a: Floats, b: Floats) -> Floats:
    """(5,) coefficients of a^T B b in B's xx, yy, xz, yz, zz (Zhang's eq. 7; without skew xy is 0)."""
    return np.array([a[0] * b[0], a[1] * b[1], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1], a[2] * b[2]])


def _centred_matrix(homographies: Sequence[Floats], middle: Floats) -> Floats | None:
    """Camera matrix with one focal length and the principal point in the middle, from one tilted view on."""
    rows, right = [], []
    for H in homographies:
        h = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, 1]]) @ H
        h = h / np.linalg.norm(h[:2, :2])
        a, b = h[:, 0], h[:, 1]
        rows += [a[0] * b[0] + a[1] * b[1], a[0] ** 2 + a[1] ** 2 - b[0] ** 2 - b[1] ** 2]
        right += [-a[2] * b[2], -(a[2] ** 2 - b[2] ** 2)]
    # The same two equations are linear in 1 / f^2: least squares over all views.
    inverse_square = float(np.dot(rows, right) / max(np.dot(rows, rows), 1e-300))
    if inverse_square <= 0:
        return None
    focal = 1 / np.sqrt(inverse_square)
    return _matrix(focal, focal, *middle)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _misses(K: Floats, T_camera_board: Transform, corners: Corners) -> Floats:
    points = corners.board.points()[corners.seen] @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    there = points @ K.T
    depth = np.where(there[:, 2:] > 0, there[:, 2:], np.nan)
    return np.asarray(there[:, :2] / depth - corners.pixels[corners.seen]).ravel()
