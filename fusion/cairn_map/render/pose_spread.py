"""Uncertainty of a camera's pose in pictures of the map: each pixel's ink is spread by its covariance in the image.

    C  (6, 6)  --J of each pixel, by its ray and range-->  J C J^T  (2, 2)  px^2  --> ink spread by it, or withheld

    T_map_camera,true = T_map_camera exp(motion)      motion = [rotation (rad), translation (m)], camera frame

in the order of `calib/CONVENTIONS.md`, in which `robot.align` gives `covariance` for the robot's frame. A turn moves
all pixels alike, a step moves near things more than far ones, and a step along the axis moves only those at the edges.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.spread_kernels import covariances_into, motions_into, scatter_into

Ink = npt.NDArray[np.uint8]
Values = npt.NDArray[np.float32]

LOWER_NUMBERS = 21
"""Numbers of the lower triangle of a (6, 6) matrix."""
SIGMA_MAX_M = 1000.0
SIGMA_MAX_RAD = float(np.pi)
NOISE = 1e-9
"""Asymmetry that rounding may cause, as a fraction of the largest entry."""
SHARP_PX = 0.35
"""Standard deviation below which a pixel is drawn sharp: it is less than that of a pixel itself (1 / sqrt(12))."""
BLUR_MAX_PX = 16.0
"""Median standard deviation above which nothing is drawn: half of the picture may be off by more."""
COUNTS = (64, 256)
"""Places to which a pixel's ink is spread, where it is spread little and where far."""
GOLDEN_RAD = np.pi * (3 - np.sqrt(5))
"""Golden angle: Vogel's spiral of steps by it fills a disc evenly."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseSpread:
    """Covariance of a camera's pose."""

    covariance: Floats
    """(6, 6) covariance of the motion from the assumed to the true pose, [rotation (rad), translation (m)], camera
    frame."""

    def __post_init__(self) -> None:
        C = np.array(self.covariance, dtype=np.float64)
        if C.shape != (6, 6) or not np.isfinite(C).all() or np.abs(C - C.T).max() > NOISE * np.abs(C).max():
            raise BadInputError(
                "bad_pose", "a pose's covariance must be (6, 6), finite and symmetric: rotation, rad, translation, m"
            )
        sigmas = np.sqrt(np.maximum(np.diag(C), 0))
        if sigmas[:3].max() > SIGMA_MAX_RAD or sigmas[3:].max() > SIGMA_MAX_M:
            raise BadInputError(
                "bad_pose",
                f"a pose's standard deviations may be up to {SIGMA_MAX_RAD:.2f} rad and {SIGMA_MAX_M:g} m, got "
                f"{sigmas[:3].max():g} rad and {sigmas[3:].max():g} m: rotation comes first",
            )
        # Compared in standard deviations, because radians and metres are not.
        scale = np.where(sigmas > 0, sigmas, 1.0)
        if np.linalg.eigvalsh(C / np.outer(scale, scale)).min() < -1e-6 or np.diag(C).min() < 0:
            raise BadInputError("bad_pose", "a pose's covariance must have no negative eigenvalue")
        C.setflags(write=False)
        object.__setattr__(self, "covariance", C)

    @classmethod
    def of_sigmas(cls, sigma_m: float = 0.0, sigma_rad: float = 0.0) -> Self:
        """Spread with the same standard deviations along and about every axis.

        Raises:
            BadInputError: kind `bad_pose`: negative, or not finite.
        """
        if not (0 <= sigma_m < np.inf and 0 <= sigma_rad < np.inf):
            raise BadInputError("bad_pose", f"sigma_m and sigma_rad must be 0 or more, got {sigma_m}, {sigma_rad}")
        return cls(np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3))

    @classmethod
    def of_lower(cls, numbers: tuple[float, ...]) -> Self:
        """Spread of the lower triangle of a covariance, row by row: 21 numbers, rad^2, rad m and m^2.

        Raises:
            BadInputError: kind `bad_pose`: another number of them, or no covariance.
        """
        if len(numbers) != LOWER_NUMBERS:
            raise BadInputError(
                "bad_pose",
                f"a pose's covariance is the {LOWER_NUMBERS} numbers of its lower triangle, row by row, "
                f"rx, ry, rz, tx, ty, tz; got {len(numbers)}",
            )
        C = np.zeros((6, 6))
        C[np.tril_indices(6)] = numbers
        return cls(C + np.tril(C, -1).T)

    def seen_from(self, T_here_camera: Floats) -> "PoseSpread":
        """Spread of a camera that is fixed, at `T_here_camera`, to the frame of this spread."""
        # The adjoint: w' = R w, v' = R (v - t x w), with R = R_camera_here, and t the camera's place.
        R, t = T_here_camera[:3, :3].T, T_here_camera[:3, 3]
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        J = np.block([[R, np.zeros((3, 3))], [-R @ cross, R]])
        C = J @ self.covariance @ J.T
        return PoseSpread((C + C.T) / 2)

    @property
    def is_exact(self) -> bool:
        """True if the pose is certain: the covariance is zero."""
        return not self.covariance.any()

    def at(self, sight: CameraRays, range_m: Values) -> Values:
        """(H, W, 3) float32 covariances xx, xy, yy, px^2, of the image of each pixel's surface; NaN where it has none.

        Args:
            sight: the camera.
            range_m: (H, W) metres along its rays; NaN where there is no surface.
        """
        out = np.empty((sight.height, sight.width, 3), np.float32)
        covariances_into(out, motions(sight, range_m), self.covariance)
        return out


def motions(sight: CameraRays, range_m: Values) -> Floats:
    """(H, W, 2, 6) Jacobians J: pixels by which each pixel's surface moves in the image, per rad and per metre of the
    camera's own motion; NaN where there is no range or ray.
    """
    out = np.empty((sight.height, sight.width, 2, 6))
    # Writable, as Numba has one kernel for such arrays and another for others.
    range_m = np.require(range_m, np.float32, ["C", "W"])
    motions_into(out, np.require(sight.rays, np.float64, ["C", "W"]), range_m)
    return out


def sigma_px(covariance_px2: Values) -> Values:
    """(...) largest standard deviation in any direction, pixels, of (..., 3) covariances."""
    # The root of the larger eigenvalue of a symmetric 2 x 2 matrix.
    xx, xy, yy = np.moveaxis(covariance_px2, -1, 0)
    return np.asarray(np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)), np.float32)


def why_withheld(covariance_px2: Values, *, blur_max_px: float = BLUR_MAX_PX) -> str | None:
    """Reason to withhold a picture with (N, 3) covariances: half of it may be too far off; None if it may not."""
    middle = float(np.median(sigma_px(covariance_px2))) if covariance_px2.size else 0.0
    if middle <= blur_max_px:
        return None
    return f"the pose is uncertain by {middle:.0f} px, more than {blur_max_px:g}"


def spread_ink(ink: Ink, covariance_px2: Values) -> Ink:
    """(H, W, 4) ink, each pixel's spread by its (H, W, 3) covariance; sharp where that is NaN or small.

    The sum of the ink is preserved, except for ink that leaves the image or adds up to more than full cover.
    """
    total = _scattered(ink, covariance_px2)
    over = np.maximum(total[..., 3:] / 255, 1)
    return np.rint(total / over).astype(np.uint8)


def spread_picture(rgb: Ink, covariance_px2: Values) -> Ink:
    """(H, W, 3) sRGB, each pixel spread by its covariance: the expected colour at each place."""
    total = _scattered(np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)]), covariance_px2)
    mean = total[..., :3] / np.maximum(total[..., 3:] / 255, 1e-6)
    return np.where(total[..., 3:] > 0, np.rint(mean), rgb).astype(np.uint8)


def _scattered(ink: Ink, covariance_px2: Values) -> Values:
    # A covariance of 0 is drawn sharp; NaN is not >= SHARP_PX.
    is_drawn = sigma_px(covariance_px2) >= SHARP_PX
    drawn = np.where(is_drawn[..., None], covariance_px2, np.float32(0))
    total = np.zeros(ink.shape, np.float32)
    scatter_into(total, np.require(ink, np.uint8, ["C", "W"]), drawn, _points(), np.array(COUNTS))
    return total


@lru_cache(maxsize=1)
def _points() -> Values:
    """(S, N, 2) standard normal points on Vogel's spiral, their mean zero and covariance one."""
    points = np.zeros((len(COUNTS), max(COUNTS), 2), np.float32)
    for size, count in enumerate(COUNTS):
        # Radii of the quantiles of the normal distribution's radius (Rayleigh), angles by the golden angle.
        n = np.arange(count)
        radius, angle = np.sqrt(-2 * np.log(1 - (n + 0.5) / count)), n * GOLDEN_RAD
        plain = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        # Exactly mean 0 and covariance 1: whitened by the Cholesky factor of their own covariance.
        plain -= plain.mean(axis=0)
        points[size, :count] = plain @ np.linalg.inv(np.linalg.cholesky(plain.T @ plain / count)).T
    points.setflags(write=False)
    return points
