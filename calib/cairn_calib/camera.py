"""A pinhole camera with Brown's distortion: its projection and its rays.

    ray (unit, camera frame)  --project-->  pixel (x, y)          Eq. 6 with distortion and principal point
    pixel (x, y)  --unproject-->  ray                             the inverse, by Newton's method (brown.py)

Camera frame: x right, y down, z forward. The centre of the top-left pixel is (0, 0). Units: pixels
for `focal_px` and `centre_px`; the distortion coefficients have none. CONVENTIONS.md says it once for all.
"""

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field

from cairn_calib.brown import Coefficients, distorted, jacobian, undistorted
from cairn_calib.raster import Raster

Floats = npt.NDArray[np.float64]


class Camera(Raster):
    """Pinhole camera with Brown's distortion (k1, k2, p1, p2, k3, in OpenCV's order)."""

    focal_px: tuple[
        Annotated[float, Field(gt=0, allow_inf_nan=False)], Annotated[float, Field(gt=0, allow_inf_nan=False)]
    ]
    centre_px: tuple[Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]]
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)

    def project(self, points: npt.NDArray[np.floating]) -> Floats:
        """Pixels at which points of the camera frame appear.

        Eq. 6 of Kocmanova et al., then distortion, then the shift to the principal point.

        Args:
            points: (..., 3), metres (any scale), camera frame.

        Returns:
            (..., 2) float64 pixels (x, y); NaN for points at or behind the camera's plane, and for those so far
            off the axis that the distortion would fold them back into the image.
        """
        p = np.asarray(points, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        plane = p[..., :2] / z[..., None]
        pixels: Floats = distorted(plane, self.distortion) * np.array(self.focal_px) + np.array(self.centre_px)
        return pixels

    def pixel_gradients(self, points: npt.NDArray[np.floating]) -> Floats:
        """How pixels move with points: the derivatives of `project`.

        Args:
            points: (..., 3), metres, camera frame.

        Returns:
            (..., 2, 3) float64, pixels a metre; NaN where `project` gives NaN because of z.
        """
        p = np.asarray(points, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        x, y = p[..., 0] / z, p[..., 1] / z
        xx, xy, yy, _ = jacobian(x, y, self.distortion)
        lens = np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
        one, none = 1 / z, np.zeros_like(z)
        plane = np.stack([np.stack([one, none, -x / z], axis=-1), np.stack([none, one, -y / z], axis=-1)], axis=-2)
        gradients: Floats = np.array(self.focal_px)[:, None] * (lens @ plane)
        return gradients

    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """Unit rays through pixels; the mirror of `project`.

        Args:
            pixels: (..., 2), (x, y).

        Returns:
            (..., 3) float64 unit vectors, camera frame; NaN for pixels that the distortion never reaches.
        """
        plane = (np.asarray(pixels, dtype=np.float64) - np.array(self.centre_px)) / np.array(self.focal_px)
        plane = undistorted(plane, self.distortion)
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
        unit: Floats = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit


def camera_from_field_of_view(width: int, height: int, *, horizontal_deg: float) -> Camera:
    """An ideal camera of the given size whose rows span `horizontal_deg`, principal point in the middle."""
    focal_px = width / 2 / np.tan(np.radians(horizontal_deg) / 2)
    return Camera(
        width=width, height=height, focal_px=(focal_px, focal_px), centre_px=((width - 1) / 2, (height - 1) / 2)
    )
