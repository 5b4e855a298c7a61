"""Interface of all cameras: a raster of pixels, each with one ray.

The centre of the top-left pixel is (0, 0), pixels are (x, y), arrays [y, x]. The models are `camera.py`
(pinhole), `fisheye.py` and `lidar.py` (cylinder).
"""

from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

MAX_SIDE_PX = 16384
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


class Raster(BaseModel, ABC, frozen=True):
    """An image of `width` x `height` pixels and the directions that they look in."""

    model_config = ConfigDict(extra="forbid")

    width: Side
    height: Side

    def __hash__(self) -> int:
        return hash((type(self), *(getattr(self, name) for name in type(self).model_fields)))

    @abstractmethod
    def project(self, points: npt.NDArray[np.floating]) -> Floats:
        """(..., 2) float64 pixels (x, y) of (..., 3) points of the camera frame; NaN for those that do not appear."""

    @abstractmethod
    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """(..., 3) float64 unit rays through (..., 2) pixels (x, y); the mirror of `project`."""

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


@lru_cache(maxsize=32)
def _rays(camera: Raster) -> Floats:
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = camera.unproject(np.stack([x, y], axis=-1))
    rays.setflags(write=False)
    return rays
