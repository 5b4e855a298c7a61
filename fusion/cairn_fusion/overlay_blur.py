"""How far ink may be off because the pose is: each pixel's ink is spread by its own standard deviation.

    sigma_px = sqrt((f sigma_rad)^2 + (f sigma_m / range)^2)

A turn moves all pixels alike, a step near things more than far ones. Standard deviations are rounded to a half octave.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError

Ink = npt.NDArray[np.uint8]
Values = npt.NDArray[np.float32]
RANGE_MIN_M = 0.01
SHARP_PX = 0.35
"""A spread below this is not drawn: it is less than that of a pixel itself."""


@dataclass(frozen=True, slots=True)
class PoseSpread:
    """How certain a pose is: standard deviations along and about any one axis, as a scan's pose states them."""

    sigma_m: float = 0.0
    sigma_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.sigma_m < np.inf and 0 <= self.sigma_rad < np.inf):
            raise BadInputError(
                "bad_pose", f"sigma_m and sigma_rad must be 0 or more, got {self.sigma_m}, {self.sigma_rad}"
            )

    def at(self, range_m: Values, *, pixel_rad: float) -> Values:
        """(H, W) standard deviation of where what lies at a range appears, pixels; NaN where the range is."""
        nearest = np.maximum(range_m, np.float32(RANGE_MIN_M))
        return np.asarray(np.hypot(self.sigma_rad, self.sigma_m / nearest) / pixel_rad, np.float32)


def spread_ink(ink: Ink, sigma_px: Values) -> Ink:
    """(H, W, 4) ink, that of each pixel spread by its (H, W) standard deviation; sharp where that is NaN or small.

    The sum of the ink stays as it is, but for what leaves the image, and where spread ink adds up to more than full.
    """
    octaves = np.rint(2 * np.log2(np.maximum(np.nan_to_num(sigma_px), 1e-3)))
    octaves[~(sigma_px >= SHARP_PX)] = -np.inf
    total = np.zeros(ink.shape, np.float32)
    for octave in np.unique(octaves[ink[..., 3] > 0]):
        part = np.where((octaves == octave)[..., None], ink, 0).astype(np.float32)
        if octave > -np.inf:
            sigma = float(2 ** (octave / 2))
            part = np.asarray(cv2.GaussianBlur(part, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float32)
        total += part
    over = np.maximum(total[..., 3:] / 255, 1)
    return np.rint(total / over).astype(np.uint8)
