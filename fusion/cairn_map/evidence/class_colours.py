"""Colours by which classes are drawn: one for each number, told apart at a glance, `other` in grey.

Neighbouring numbers are far apart in hue (steps of the golden angle), and every third is darker, so that a list that is
made longer keeps the colours of its first classes.
"""

import colorsys
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from cairn_map.evidence.channels import CLASSES_MAX

GOLDEN_TURN = 0.6180339887498949
"""Golden angle, in turns: multiples of it are spread over the circle evenly, however many there are."""
SHADES = (0.95, 0.75, 0.55)
"""Brightness of three classes in turn, 0 to 1."""
OTHER_GREY = 150
"""Red, green and blue of `other`, and of no class that has a hue."""


def class_colours(count: int) -> npt.NDArray[np.uint8]:
    """(count, 3) sRGB 0 to 255 of the classes of a channel that has so many, the last one `other`."""
    colours: npt.NDArray[np.uint8] = _hues()[:count].copy()
    colours[-1:] = OTHER_GREY
    return colours


@lru_cache(maxsize=1)
def _hues() -> npt.NDArray[np.uint8]:
    found = [colorsys.hsv_to_rgb(n * GOLDEN_TURN % 1.0, 0.8, SHADES[n % len(SHADES)]) for n in range(CLASSES_MAX)]
    colours: npt.NDArray[np.uint8] = np.rint(np.array(found) * 255).astype(np.uint8)
    return colours
