"""Covariance of a transferred pixel: chapter IV of Kocmanova et al. with its errors.

Eq. 1-4 put a point at P = d u along the unit ray u of its pixel, Eq. 5 at Q = R P + t before the other camera, Eq. 6 at
the pixel p(Q). Range noise moves the point along its beam, and the pixel along the beam's image:

    dp/dd = J R u = J (Q - t) / d = -J t / d        J = dp/dQ, and J Q = 0: along its own ray a point keeps its pixel
    S     = C + sigma_d^2 (J t / d) (J t / d)^T + sigma_u^2 D D^T

so without a baseline t range noise has no effect. C is the calibration's part (`calibration_covariance`), sigma_u the
standard deviation of the source pixel itself, where an algorithm found it, and D the derivative by it. The place on the
surface that a pixel is taken from is uncertain by as many metres as the longer axis of S spans at the point's depth.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import Rig
from cairn_fusion.transfer.calibration_covariance import calibration_covariance, lens_of, pixel_gradients
from cairn_fusion.transfer.covariance_grid import calibration_bound_px
from cairn_fusion.transfer.transfer_kernels import REACH_MAX_PX
from cairn_map.arrays import Floats

CALIBRATION_SIGMAS = 1.5
"""Standard deviations of calibration in a reach. With one, on a rig calibrated to 2 px, 11 % of the mapped
temperatures of hot things are wrong by over 2 K, against 5 % (docs/decisions/002)."""


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


@dataclass(frozen=True, slots=True)
class PlaceBounds:
    """Bounds on the uncertainty of a camera's samples that take a few operations a point (`sample_kernels`).

    spread  J moves a pixel by at most some f / z a metre, more only off the axis and where a lens stretches: here,
            eight times as much is allowed for. With a baseline of 0.1 m and 5 mm at 1 m that is 4 mm.
    reach   whole pixels of `dst`, to each side, that a pixel of the range camera may cover there: half a range pixel,
            `CALIBRATION_SIGMAS` of calibration, and one of the range's noise, which moves it along the baseline's
            image by f t sigma / d^2. A last pixel that it covers in part is left out: with an edge there, nearly all of
            the range pixel is on one side, and so is its range. Never less than one: at an edge that pixel itself
            shows both sides.
    """

    baseline_m: float
    calibration: float
    """Standard deviation by calibration, as a tangent."""
    fixed_px: float
    """Reach without the range's noise."""
    moved_px: float
    """Pixels by which a range's noise of 1 m moves a point at 1 m."""

    @classmethod
    def of(cls, rig: Rig, *, src: str, dst: str) -> Self:
        """Bounds for the samples of `dst` at the points of the range camera `src`."""
        T_dst_src, focals_px = inverse(rig[dst].transform) @ rig[src].transform, rig[dst].camera.focal_px
        baseline_m, calibration_px = (
            float(np.linalg.norm(T_dst_src[:3, 3])),
            calibration_bound_px(rig, src=src, dst=dst),
        )
        half_px = 0.5 * max(focals_px) / max(rig[src].camera.focal_px)
        fixed_px = min(half_px + CALIBRATION_SIGMAS * calibration_px, float(REACH_MAX_PX))
        return cls(baseline_m, calibration_px / min(focals_px), fixed_px, max(focals_px) * baseline_m)
