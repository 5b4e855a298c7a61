"""Covariance of a transferred pixel: chapter IV of Kocmanova et al. with its errors.

Eq. 1-4 put a point at P = d u along the unit ray u of its pixel, Eq. 5 at Q = R P + t before the other camera, Eq. 6 at
the pixel p(Q). Range noise moves the point along its beam, and the pixel along the beam's image:

    dp/dd = J R u = J (Q - t) / d = -J t / d        J = dp/dQ, and J Q = 0: along its own ray a point keeps its pixel
    S     = C + sigma_d^2 (J t / d) (J t / d)^T + sigma_u^2 D D^T

so without a baseline t range noise has no effect. C is the calibration's part (`calibration_covariance`), sigma_u the
standard deviation of the source pixel itself, where an algorithm found it, and D the derivative by it. The place on the
surface that a pixel is taken from is uncertain by as many metres as the longer axis of S spans at the point's depth.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import Rig
from cairn_fusion.transfer.calibration_covariance import calibration_covariance, lens_of, pixel_gradients
from cairn_fusion.transfer.covariance_grid import calibration_bound_px
from cairn_map.arrays import Flags, Floats

REACH_MAX_PX = 16
"""Largest reach of `reach_px_of`: a bound on work."""
CALIBRATION_SIGMAS = 1.5
"""Standard deviations of calibration in `reach_px_of`. With one, on a rig calibrated to 2 px, 11 % of the mapped
temperatures of hot things are wrong by over 2 K, against 5 % (docs/decisions/002)."""
STRETCH_MAX = 8.0
"""Largest factor by which a lens stretches its image, for `is_certain`."""


def pixel_covariance(
    points_src: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str, pixel_sigma_px: float = 0.0
) -> Floats:
    """(N, 2, 2) covariance, px^2, of the pixels of one camera's points in another's image.

    Args:
        points_src: (N, 3) metres, frame of the camera `src`.
        sigma_m: (N,) standard deviation of their range along its rays.
        rig: with both cameras.
        src: source camera: the range camera, or any other through range.
        dst: camera with the pixels.
        pixel_sigma_px: standard deviation of the pixels in `src`, both axes; 0 for the centres of pixels.

    Raises:
        BadInputError: `dst` is a lidar.
    """
    camera = lens_of(rig, dst)
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    gradients = camera.pixel_gradients(transform_points(T_dst_src, points_src))
    # J t / d times sigma_d: the range's part; J Q = 0 leaves only the baseline.
    moved = gradients @ T_dst_src[:3, 3] * (sigma_m / np.linalg.norm(points_src, axis=1))[:, None]
    covariance = moved[:, :, None] * moved[:, None, :] + calibration_covariance(points_src, rig, src=src, dst=dst)
    if pixel_sigma_px:
        by_pixel = pixel_gradients(points_src, rig, src=src, dst=dst)
        covariance += pixel_sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, -1, -2)
    return np.asarray(covariance)


def spread_px(covariance: Floats) -> Floats:
    """(N,) standard deviation along the longer axis of (N, 2, 2) covariances."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.asarray(np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b)))


def spread_m(points_src: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str) -> Floats:
    """(N,) standard deviation of samples' places across the line of sight, metres; arguments of `pixel_covariance`."""
    covariance = pixel_covariance(points_src, sigma_m, rig, src=src, dst=dst)
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    points_dst = transform_points(T_dst_src, points_src)
    # A pinhole's focal length is pixels a tangent, of depth; a fisheye's pixels a radian, of range.
    is_fisheye = isinstance(rig[dst].camera, FisheyeCamera)
    away_m = np.linalg.norm(points_dst, axis=1) if is_fisheye else points_dst[:, 2]
    return np.asarray(spread_px(covariance) * away_m / min(rig[dst].camera.focal_px))


def is_certain(range_m: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str, limit_m: float) -> Flags:
    """(N,) true for points whose samples are certainly within a limit of uncertainty, by a bound on their covariance.

    J moves a pixel by at most some f / z a metre, more only off the axis and where a lens stretches: here, eight times
    as much is allowed for. With a baseline of 0.1 m and 5 mm at 1 m that is 4 mm.
    """
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    baseline_m = float(np.linalg.norm(T_dst_src[:3, 3]))
    calibration = calibration_bound_px(rig, src=src, dst=dst) / min(rig[dst].camera.focal_px)
    bound_m = STRETCH_MAX * (baseline_m * (sigma_m / range_m) + calibration * (range_m + baseline_m))
    return np.asarray(bound_m <= limit_m)


def reach_px_of(range_m: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str) -> npt.NDArray[np.int32]:
    """(N,) whole pixels of `dst`, to each side, that a pixel of the range camera may cover there.

    Half a range pixel, `CALIBRATION_SIGMAS` of calibration, and one of the range's noise, which moves it along the
    baseline's image by f t sigma / d^2. A last pixel that it covers in part is left out: with an edge there, nearly all
    of the range pixel is on one side, and so is its range. Never less than one: at an edge that pixel itself shows both
    sides.
    """
    focal_px, T_dst_src = max(rig[dst].camera.focal_px), inverse(rig[dst].transform) @ rig[src].transform
    half_px = 0.5 * focal_px / max(rig[src].camera.focal_px)
    fixed_px = min(half_px + CALIBRATION_SIGMAS * calibration_bound_px(rig, src=src, dst=dst), float(REACH_MAX_PX))
    moved_px = focal_px * float(np.linalg.norm(T_dst_src[:3, 3])) * sigma_m / np.square(range_m)
    return np.asarray(np.clip(np.floor(fixed_px + moved_px), 1, REACH_MAX_PX), dtype=np.int32)
