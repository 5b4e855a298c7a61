"""Fisheye camera: Kannala and Brandt's model with four coefficients, OpenCV's `fisheye`, Kalibr's `equidistant`.

    theta = angle between the ray and the optical axis             point (X, Y, Z), r = sqrt(X^2 + Y^2)
    theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    pixel = (f_x theta' X / r + c_x, f_y theta' Y / r + c_y)

theta is atan2(r, Z), so that a lens may look back over its shoulder; in front of the camera that is what OpenCV and
Kalibr compute from X / Z and Y / Z. Where theta' first stops rising the lens ends, as in `brown.py`; straight back it
always does.

Kannala and Brandt 2006, "A generic camera model and calibration method", Eq. 6; CONVENTIONS.md.
"""

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from cairn_calib.rig.brown import Coefficient, first_root
from cairn_calib.rig.lens import Lens
from cairn_map.arrays import Floats

Coefficients = Annotated[tuple[Coefficient, ...], Field(min_length=4, max_length=4)]

TABLE_SIZE = 4096
"""Angles of the table that Newton starts from: two steps later it is exact."""
STEPS = 30
STEP_AGAIN = 1e-11
"""Error in radians beyond which another step is worth it; the step itself squares it."""
TOLERANCE = 5e-13
"""Error of theta' in radians: 3e-10 px at a focal length of 600 px. Pixels that stay worse have no ray."""


class FisheyeCamera(Lens, frozen=True):
    """Fisheye camera: k1, k2, k3, k4 of Kannala and Brandt; `focal_px` is pixels a radian on the axis."""

    model: Literal["kb4"] = "kb4"
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0)

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """The four names."""
        return ("k1", "k2", "k3", "k4")

    def plane(self, points: Floats) -> Floats:
        """(..., 2) of (..., 3) points; NaN straight back, at the camera's own place, and beyond the fold."""
        _, theta, radial = self._angles(points)
        seen = theta < angle_limit(self.distortion)
        return np.where(seen[..., None], points[..., :2] * radial[..., None], np.nan)

    def plane_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """(..., 2, 3) by the point and (..., 2, 4) by the coefficients; NaN straight back and at the own place."""
        off_axis, theta, radial = self._angles(points)
        z = points[..., 2]
        # The place is theta' e, e the direction off the axis: d theta' / d theta moves it along e, theta' / r across.
        toward = points[..., :2] / np.where(off_axis > 0, off_axis, 1)[..., None]
        slope = _slope(theta, self.distortion) / (off_axis * off_axis + z * z)
        outer = toward[..., :, None] * toward[..., None, :]
        by_xy = outer * (slope * z - radial)[..., None, None] + np.eye(2) * radial[..., None, None]
        by_z = -(slope * off_axis)[..., None] * toward
        powers = theta[..., None] ** np.array([3, 5, 7, 9])
        return np.concatenate([by_xy, by_z[..., None]], axis=-1), toward[..., None] * powers[..., None, :]

    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """Unit rays through pixels; the mirror of `project`.

        Args:
            pixels: (..., 2), (x, y).

        Returns:
            (..., 3) float64 unit vectors, camera frame; NaN for pixels that the lens never reaches.
        """
        plane = (np.asarray(pixels, dtype=np.float64) - np.array(self.centre_px)) / np.array(self.focal_px)
        reach = np.hypot(plane[..., 0], plane[..., 1])
        theta = _angle_of(reach, self.distortion)
        toward = plane / np.where(reach > 0, reach, 1)[..., None]
        return np.concatenate([np.sin(theta)[..., None] * toward, np.cos(theta)[..., None]], axis=-1)

    def _angles(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """(...) distance from the axis, angle to it (NaN where there is none), and theta' over that distance."""
        off_axis = np.hypot(points[..., 0], points[..., 1])
        z = points[..., 2]
        theta = np.where((off_axis > 0) | (z > 0), np.arctan2(off_axis, z), np.nan)
        # On the axis theta' / r is 1 / z.
        near = np.where(off_axis > 0, off_axis, 1)
        radial = np.where(off_axis > 0, _bend(theta, self.distortion) / near, 1 / np.where(z > 0, z, np.nan))
        return off_axis, theta, radial


@lru_cache(maxsize=64)
def angle_limit(coefficients: Coefficients) -> float:
    """The angle off the axis, radians, at which theta' first stops rising; at most pi."""
    return first_root(np.array([1.0, *np.array(coefficients) * (3, 5, 7, 9)]), at_most=np.pi)


def _angle_of(reach: Floats, coefficients: Coefficients) -> Floats:
    """(...) angles whose theta' is given; NaN for those before no fold."""
    limit = angle_limit(coefficients)
    angles, reached = _table(coefficients)
    wanted = np.where(reach < reached[-1], reach, np.nan)
    theta = np.interp(wanted, reached, angles)
    for _ in range(STEPS):
        # Newton for theta' = wanted, within the angle up to which theta' rises.
        error = _bend(theta, coefficients) - wanted
        slope = _slope(theta, coefficients)
        theta = np.clip(theta - error / np.where(slope > 0, slope, np.nan), 0, limit)
        if not np.any(np.abs(error) > STEP_AGAIN):
            break
    # Only angles that map back count.
    right = (np.abs(_bend(theta, coefficients) - wanted) <= TOLERANCE) & (theta < limit)
    return np.where(right, theta, np.nan)


@lru_cache(maxsize=64)
def _table(coefficients: Coefficients) -> tuple[Floats, Floats]:
    angles = np.linspace(0, angle_limit(coefficients), TABLE_SIZE)
    return angles, _bend(angles, coefficients)


def _bend(theta: Floats, coefficients: Coefficients) -> Floats:
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return theta * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))


def _slope(theta: Floats, coefficients: Coefficients) -> Floats:
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))
