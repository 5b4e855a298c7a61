"""Temperature scale: the colours of temperatures, the same in all pictures of a view so that they can be compared."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Bytes
from cairn_map.errors import BadInputError

ZERO_CELSIUS_K = 273.15
PERCENTILES = (1.0, 99.5)
"""Temperatures at the ends of a locked scale."""
LEAST_SPAN_K = 10.0
"""Least span of a scale that is locked on a picture: smaller differences are noise, or of no interest."""
ROUND_K = 1.0


def _palette() -> Bytes:
    """(256, 3) R, G, B: inferno, perceptually uniform, and readable without red or green."""
    levels = np.arange(256, dtype=np.uint8).reshape(-1, 1)
    return np.ascontiguousarray(np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), np.uint8)[:, 0, ::-1])


PALETTE = _palette()
PALETTE.setflags(write=False)


@dataclass(frozen=True, slots=True)
class TemperatureScale:
    """The palette's two ends, kelvin."""

    low_k: float
    high_k: float
    note: str = "fixed"
    """Origin of the scale, for the legend."""

    def __post_init__(self) -> None:
        if not (0 <= self.low_k < self.high_k < float("inf")):
            low, high = self.low_k - ZERO_CELSIUS_K, self.high_k - ZERO_CELSIUS_K
            raise BadInputError(
                "bad_scale", f"a temperature scale goes from a lower to a higher one, got {low:g} to {high:g} deg C"
            )

    def colours(self, kelvin: npt.NDArray[np.floating]) -> Bytes:
        """(..., 3) R, G, B of (...) temperatures; NaN has the colour of the lower end, so leave it out."""
        level = np.clip((kelvin - self.low_k) * (255 / (self.high_k - self.low_k)) + 0.5, 0, 255)
        return np.asarray(PALETTE[np.nan_to_num(level).astype(np.uint8)])


def locked_scale(kelvin: npt.NDArray[np.floating]) -> TemperatureScale:
    """Scale for a picture and the next ones: all temperatures except the outermost, in whole degrees.

    Args:
        kelvin: any shape; NaN for no temperature.

    Raises:
        BadInputError: there is no temperature at all.
    """
    known = kelvin[np.isfinite(kelvin)]
    if not known.size:
        raise BadInputError("no_temperature", "no temperature to take a scale from; give one")
    low, high = (float(value) - ZERO_CELSIUS_K for value in np.percentile(known, PERCENTILES))
    spare = max(0.0, LEAST_SPAN_K - (high - low)) / 2
    low, high = np.floor((low - spare) / ROUND_K) * ROUND_K, np.ceil((high + spare) / ROUND_K) * ROUND_K
    return TemperatureScale(max(0.0, low + ZERO_CELSIUS_K), high + ZERO_CELSIUS_K, "locked")
