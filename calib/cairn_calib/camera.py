"""One camera: pinhole with Brown's distortion, its rays and its projection.

    ray (unit, camera frame)  --project-->  pixel (x, y)          Eq. 6 with distortion and principal point
    pixel (x, y)  --unproject-->  ray                             the inverse, by Newton's fixed point

Camera frame: x right, y down, z forward. The centre of the top-left pixel is (0, 0). Units: pixels
for `focal_px` and `centre_px`; the distortion coefficients have none. CONVENTIONS.md says it once for all.
"""

from functools import lru_cache
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]

MAX_SIDE_PX = 16384
UNDISTORT_STEPS = 40
UNDISTORT_TOLERANCE = 1e-12
"""Of the normalised image plane; 1e-9 px at a focal length of 1000 px."""


class Camera(BaseModel):
    """Pinhole camera with Brown's distortion (k1, k2, p1, p2, k3, in OpenCV's order)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
    height: Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
    focal_px: tuple[
        Annotated[float, Field(gt=0, allow_inf_nan=False)], Annotated[float, Field(gt=0, allow_inf_nan=False)]
    ]
    centre_px: tuple[Annotated[float, Field(allow_inf_nan=False)], Annotated[float, Field(allow_inf_nan=False)]]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __hash__(self) -> int:
        return hash((self.width, self.height, self.focal_px, self.centre_px, self.distortion))

    def project(self, points: npt.NDArray[np.floating]) -> Floats:
        """Pixels at which points of the camera frame appear.

        Eq. 6 of Kocmanova et al., then distortion, then the shift to the principal point.

        Args:
            points: (..., 3), metres (any scale), camera frame.

        Returns:
            (..., 2) float64 pixels (x, y); NaN for points at or behind the camera's plane.
        """
        p = np.asarray(points, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        plane = p[..., :2] / z[..., None]
        pixels: Floats = distorted(plane, self.distortion) * np.array(self.focal_px) + np.array(self.centre_px)
        return pixels

    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """Unit rays through pixels; the mirror of `project`.

        Args:
            pixels: (..., 2), (x, y).

        Returns:
            (..., 3) float64 unit vectors, camera frame.
        """
        plane = (np.asarray(pixels, dtype=np.float64) - np.array(self.centre_px)) / np.array(self.focal_px)
        plane = undistorted(plane, self.distortion)
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
        unit: Floats = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def rays(self) -> Floats:
        """(H, W, 3) float64 unit ray of every pixel, camera frame; computed once per camera, read-only."""
        return _rays(self)

    def contains(self, pixels: Floats) -> npt.NDArray[np.bool_]:
        """(...) bool: the pixel's nearest raster point lies in the image; False for NaN."""
        x, y = pixels[..., 0], pixels[..., 1]
        return np.asarray((x >= -0.5) & (y >= -0.5) & (x < self.width - 0.5) & (y < self.height - 0.5))

    def check_image(self, image: npt.NDArray[np.generic], *, name: str) -> None:
        """Refuse an image that is not this camera's.

        Raises:
            BadInputError: rows or columns differ.
        """
        if image.shape[:2] != (self.height, self.width):
            raise BadInputError(
                "image_size",
                f"{name} must be {self.width} x {self.height} pixels, got {image.shape[1]} x {image.shape[0]}"
                if image.ndim >= 2
                else f"{name} must be an image, got an array of shape {image.shape}",
            )


def camera_from_field_of_view(width: int, height: int, *, horizontal_deg: float) -> Camera:
    """An ideal camera of the given size whose rows span `horizontal_deg`, principal point in the middle."""
    focal_px = width / 2 / np.tan(np.radians(horizontal_deg) / 2)
    return Camera(
        width=width, height=height, focal_px=(focal_px, focal_px), centre_px=((width - 1) / 2, (height - 1) / 2)
    )


def distorted(plane: Floats, coefficients: tuple[float, ...]) -> Floats:
    """Brown's model: (..., 2) normalised image plane without distortion to the plane with it."""
    if not any(coefficients):
        return plane
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistorted(plane: Floats, coefficients: tuple[float, ...]) -> Floats:
    """The mirror of `distorted`, by fixed-point iteration; NaN where it does not converge."""
    if not any(coefficients):
        return plane
    guess = plane.copy()
    error = np.zeros_like(plane)
    for _ in range(UNDISTORT_STEPS):
        error = distorted(guess, coefficients) - plane
        guess = guess - error
        if not np.any(np.abs(error) > UNDISTORT_TOLERANCE):
            return guess
    # Outside the region where the model is invertible there is no ray: say so instead of returning a wrong one.
    bad = np.abs(error).max(axis=-1, keepdims=True) > 1e-6
    return np.where(bad, np.nan, guess)


@lru_cache(maxsize=32)
def _rays(camera: Camera) -> Floats:
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = camera.unproject(np.stack([x, y], axis=-1))
    rays.setflags(write=False)
    return rays
