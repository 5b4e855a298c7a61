"""Pinhole camera with Brown's distortion: its projection and its rays.

    ray (unit, camera frame)  --project-->  pixel (x, y)          Eq. 6 with distortion and principal point
    pixel (x, y)  --unproject-->  ray                             the inverse, by Newton's method (brown.py)

Camera frame: x right, y down, z forward. The centre of the top-left pixel is (0, 0). Units: pixels
for `focal_px` and `centre_px`; the distortion coefficients have none. CONVENTIONS.md is normative. The parts
that all cameras with lenses share, derivatives above all, are in `lens.py`.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.brown import Coefficients, coefficient_gradients, distort, jacobian, undistort
from cairn_calib.rig.lens import Lens
from cairn_map.arrays import Floats

NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


class Camera(Lens, frozen=True):
    """Pinhole camera with Brown's distortion: k1, k2, p1, p2, k3[, k4, k5, k6], in OpenCV's order."""

    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Five names, or eight of a rational lens."""
        return NAMES[: len(self.distortion)]

    def plane(self, points: Floats) -> Floats:
        """(..., 2) of (..., 3) points; NaN at or behind the camera's plane, and beyond the fold."""
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        return distort(points[..., :2] / z[..., None], self.distortion)

    def plane_gradients(self, points: Floats) -> tuple[Floats, Floats]:
        """(..., 2, 3) by the point and (..., 2, 5 or 8) by the coefficients; NaN at or behind the camera's plane."""
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        x, y = points[..., 0] / z, points[..., 1] / z
        xx, xy, yy, _ = jacobian(x, y, self.distortion)
        lens = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
        one, none = 1 / z, np.zeros_like(z)
        plane = np.stack([np.stack([one, none, -x / z], axis=-1), np.stack([none, one, -y / z], axis=-1)], axis=-2)
        return lens @ plane, coefficient_gradients(x, y, self.distortion)

    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """Unit rays through pixels; the mirror of `project`.

        Args:
            pixels: (..., 2), (x, y).

        Returns:
            (..., 3) float64 unit vectors, camera frame; NaN for pixels that the distortion never reaches.
        """
        plane = (np.asarray(pixels, dtype=np.float64) - np.array(self.centre_px)) / np.array(self.focal_px)
        plane = undistort(plane, self.distortion)
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
        unit: Floats = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit


def camera_from_field_of_view(width: int, height: int, *, horizontal_deg: float) -> Camera:
    """An ideal camera of the given size whose rows span `horizontal_deg`, principal point in the middle."""
    focal_px = width / 2 / np.tan(np.radians(horizontal_deg) / 2)
    return Camera(
        width=width, height=height, focal_px=(focal_px, focal_px), centre_px=((width - 1) / 2, (height - 1) / 2)
    )
