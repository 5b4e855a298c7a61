"""How certain a transferred pixel is: chapter IV of Kocmanova et al. with its errors.

Eq. 1-4 put a point at P = d u along the unit ray u of its pixel, Eq. 5 at Q = R P + t before the other camera, Eq. 6 at
the pixel p(Q). Range noise moves the point along its beam, and the pixel along the beam's image:

    dp/dd = J R u = J (Q - t) / d = -J t / d        J = dp/dQ, and J Q = 0: along its own ray a point keeps its pixel
    S     = C + sigma_d^2 (J t / d) (J t / d)^T + sigma_u^2 D D^T

so without a baseline t range noise does nothing. C is what calibration left (`calibration_certainty`), sigma_u how
uncertain the pixel itself is, where it is one that was found by an algorithm, D how the other moves with it. The
place on the surface that a pixel is taken from is uncertain by as many metres as the longer axis of S spans at the
point's depth.
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
"""A bound on the work of looking around."""
CALIBRATION_SIGMAS = 1.5
"""Of a rig that is calibrated to 2 px one alone leaves 11 % of mapped temperatures of hot things wrong by over 2 K, for
5 % (docs/decisions/002)."""
STRETCH_MAX = 8.0
"""By how much a lens may stretch what it shows, for `is_certain`."""


def pixel_covariance(
    points_src: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str, pixel_sigma_px: float = 0.0
) -> Floats:
    """(N, 2, 2) covariance, px^2, of where points of one camera's frame appear in another's image.

    Args:
        points_src: (N, 3) metres, frame of the camera `src`.
        sigma_m: (N,) standard deviation of their range along its rays.
        rig: with both cameras.
        src: the camera whose pixels are carried: the range camera, or any other through range.
        dst: the camera to look from.
        pixel_sigma_px: of where in `src` they are, both axes; 0 for the centres of pixels.

    Raises:
        BadInputError: `dst` is a lidar.
    """
    camera = lens_of(rig, dst)
    T_dst_src = inverse(rig[dst].transform) @ rig[src].transform
    gradients = camera.pixel_gradients(transform_points(T_dst_src, points_src))
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
    calibration = calibration_bound_px(rig, src=src, dst=dst) / min(rig[dst].camera.focal_px)
    bound_m = STRETCH_MAX * (baseline_m * (sigma_m / range_m) + calibration * (range_m + baseline_m))
    return np.asarray(bound_m <= limit_m)


def reach_px_of(range_m: Floats, sigma_m: Floats, rig: Rig, *, src: str, dst: str) -> npt.NDArray[np.int32]:
    """(N,) how many whole pixels of `dst`, to each side, a pixel of the range camera may cover there.

    Half a range pixel, `CALIBRATION_SIGMAS` of calibration, and one of the range's noise, which moves it along the
    baseline's image by f t sigma / d^2. What it covers of one more is left out: with an edge there, nearly all of the
    range pixel is on one side, and so is its range. Never less than one: at an edge that pixel shows both sides itself.
    """
    focal_px, T_dst_src = max(rig[dst].camera.focal_px), inverse(rig[dst].transform) @ rig[src].transform
    half_px = 0.5 * focal_px / max(rig[src].camera.focal_px)
    fixed_px = min(half_px + CALIBRATION_SIGMAS * calibration_bound_px(rig, src=src, dst=dst), float(REACH_MAX_PX))
    moved_px = focal_px * float(np.linalg.norm(T_dst_src[:3, 3])) * sigma_m / np.square(range_m)
    return np.asarray(np.clip(np.floor(fixed_px + moved_px), 1, REACH_MAX_PX), dtype=np.int32)
