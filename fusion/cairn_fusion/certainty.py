"""How certain a transferred pixel is: chapter IV of Kocmanova et al. with its errors.

Eq. 1-4 put a point at P = d u along the unit ray u of its pixel, Eq. 5 at Q = R P + t before the other camera, Eq. 6 at
the pixel p(Q). Range noise moves the point along its beam, and the pixel along the beam's image:

    dp/dd = J R u = J (Q - t) / d = -J t / d        J = dp/dQ, and J Q = 0: along its own ray a point keeps its pixel
    S     = sigma_d^2 (J t / d) (J t / d)^T + sigma_c^2 I

so without a baseline t range noise does nothing. sigma_c is the rig's `calibration_sigma_px`: what calibration left, as
much in both axes. The place on the surface that a pixel is taken from is uncertain by as many metres as the longer axis
of S spans at the point's depth.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.fisheye import FisheyeCamera
from cairn_calib.lens import Lens
from cairn_calib.poses import inverse, transform_points
from cairn_calib.rig import Rig
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

STRETCH_MAX = 8.0
"""By how much a lens may stretch what it shows, for `is_certain`."""


def pixel_covariance(points_src: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str) -> Floats:
    """(N, 2, 2) covariance, px^2, of where points of one camera's frame appear in another's image.

    Args:
        points_src: (N, 3) metres, frame of the range camera `src`.
        sigma_m: (N,) standard deviation of their range.
        rig: with both cameras.
        src: the range camera.
        dst: the camera to look from.

    Raises:
        BadInputError: `dst` is a lidar.
    """
    camera = rig[dst].camera
    if not isinstance(camera, Lens):
        raise BadInputError("bad_camera", f"{dst} must have a lens, it is a {type(camera).__name__}")
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    gradients = camera.pixel_gradients(transform_points(T_dst_src, points_src))
    moved = gradients @ T_dst_src[:3, 3] * (sigma_m / np.linalg.norm(points_src, axis=1))[:, None]
    calibration_px = rig[dst].calibration_sigma_px or 0.0
    return np.asarray(moved[:, :, None] * moved[:, None, :] + calibration_px**2 * np.eye(2))


def spread_px(covariance: Floats) -> Floats:
    """(N,) standard deviation along the longer axis of (N, 2, 2) covariances."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)))


def spread_m(points_src: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str) -> Floats:
    """(N,) how uncertain the place of each sample is across the line of sight, metres: arguments as above."""
    covariance = pixel_covariance(points_src, sigma_m, rig, src=src, dst=dst)
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    points_dst = transform_points(T_dst_src, points_src)
    # A pinhole's focal length is pixels a tangent, of depth; a fisheye's pixels a radian, of range.
    is_fisheye = isinstance(rig[dst].camera, FisheyeCamera)
    away_m = np.linalg.norm(points_dst, axis=1) if is_fisheye else points_dst[:, 2]
    return np.asarray(spread_px(covariance) * away_m / min(rig[dst].camera.focal_px))


def is_certain(range_m: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str, limit_m: float) -> Flags:
    """(N,) points at these ranges whose samples cannot be uncertain by more than a limit: nobody needs to work it out.

    J moves a pixel by at most some f / z a metre, more only off the axis and where a lens stretches: here, eight times
    as much is allowed for. With a baseline of 0.1 m and 5 mm at 1 m that is 4 mm.
    """
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    baseline_m = float(np.linalg.norm(T_dst_src[:3, 3]))
    calibration = (rig[dst].calibration_sigma_px or 0.0) / min(rig[dst].camera.focal_px)
    bound_m = STRETCH_MAX * (baseline_m * (sigma_m / range_m) + calibration * (range_m + baseline_m))
    return np.asarray(bound_m <= limit_m)
