"""Flying pixels: ranges between a near and a far surface, where there is neither.

A time-of-flight pixel that sees an edge adds up both waves, and reports a place in the air. On a line of the image its
range lies between its neighbours', and far from both; beyond them the surfaces are smooth again:

    o---o                         near surface
          x                       the steps to x and from x are both large
             o---o                far surface; the steps beyond are small

On a floor seen at a slant steps are large too, but all of them alike. `samples` is the caller;
tests/cairn_fusion/test_flying.py has the slow twin.
"""

import math

import numba as nb
import numpy as np
import numpy.typing as npt

Ranges = npt.NDArray[np.float32]

SLANT_SHARE = 2.0
"""How many times the steps beyond its neighbours a flying pixel's own steps must exceed."""


@nb.njit(cache=True, nogil=True)
def flying_pixels(range_m: Ranges, step_m: float) -> npt.NDArray[np.bool_]:
    """(H, W) whether a pixel flies.

    Args:
        range_m: (H, W) metres along the beam; NaN where nothing came back: next to it nothing flies.
        step_m: what both its steps must exceed, besides `SLANT_SHARE` of the steps beyond.
    """
    height, width = range_m.shape
    flying = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            for dy, dx in ((0, 1), (1, 0)):
                if y < dy or x < dx or y + dy >= height or x + dx >= width:
                    continue
                here = np.float64(range_m[y, x])
                before = here - np.float64(range_m[y - dy, x - dx])
                after = np.float64(range_m[y + dy, x + dx]) - here
                # A comparison with NaN is false: so is all of this.
                if not before * after > 0.0:
                    continue
                own = min(abs(before), abs(after))
                if own <= step_m:
                    continue
                beyond = 0.0
                if y >= 2 * dy and x >= 2 * dx:
                    one = abs(np.float64(range_m[y - dy, x - dx]) - np.float64(range_m[y - 2 * dy, x - 2 * dx]))
                    beyond = 0.0 if math.isnan(one) else one
                if y + 2 * dy < height and x + 2 * dx < width:
                    other = abs(np.float64(range_m[y + 2 * dy, x + 2 * dx]) - np.float64(range_m[y + dy, x + dx]))
                    beyond = max(beyond, 0.0 if math.isnan(other) else other)
                if own > step_m + SLANT_SHARE * beyond:
                    flying[y, x] = True
    return flying
