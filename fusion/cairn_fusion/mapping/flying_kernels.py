"""Flying pixels: ranges between a near and a far surface, where there is neither.

A time-of-flight pixel that sees an edge adds up both waves, and reports a place in the air. On a line of the image its
range lies between its neighbours', and far from both; beyond them the surfaces are smooth again:

    o---o                         near surface
          x                       the steps to x and from x are both large
             o---o                far surface; the steps beyond are small

On a floor seen at a slant steps are large too, but all of them alike. tests/cairn_fusion/mapping/test_flying.py has
the slow twin.
"""

import numba as nb
import numpy as np
import numpy.typing as npt

Ranges = npt.NDArray[np.float32]

SLANT_SHARE = 2.0
"""A flying pixel's own steps exceed the steps beyond its neighbours by more than this factor."""
BORDER = 2
"""Neighbours to each side that a pixel is compared with."""


@nb.njit(cache=True, nogil=True)
def flying_pixels(range_m: Ranges, step_m: float) -> npt.NDArray[np.bool_]:
    """(H, W) true for flying pixels.

    Args:
        range_m: (H, W) metres along the beam; NaN where nothing came back, next to which no pixel flies.
        step_m: both its steps exceed this plus `SLANT_SHARE` times the steps beyond.
    """
    height, width = range_m.shape
    flying, wide = np.zeros((height, width), np.bool_), width + 2 * BORDER
    # With a border of NaN, so that no neighbour is missing and rows become vector instructions.
    padded = np.full((height + 2 * BORDER, wide), np.float32(np.nan))
    padded[BORDER : BORDER + height, BORDER : BORDER + width] = range_m
    flat = padded.ravel()
    for y in range(height):
        # Along the row, then along the column.
        for stride in (1, wide):
            first = (y + BORDER) * wide + BORDER
            a, b = flat[first - 2 * stride :][:width], flat[first - stride :][:width]
            c = flat[first:][:width]
            d, e = flat[first + stride :][:width], flat[first + 2 * stride :][:width]
            _line_into(flying[y], a, b, c, d, e, step_m)
    return flying


@nb.njit(cache=True, nogil=True)
def _line_into(
    flying: npt.NDArray[np.bool_], a: Ranges, b: Ranges, c: Ranges, d: Ranges, e: Ranges, step_m: float
) -> None:
    """Mark the pixels `c` that fly, between the pixels `a`, `b` before and `d`, `e` after them on their lines."""
    for x in range(len(flying)):
        # A comparison with NaN is false, and so is the whole condition.
        before, after = np.float64(c[x]) - np.float64(b[x]), np.float64(d[x]) - np.float64(c[x])
        one, other = abs(np.float64(b[x]) - np.float64(a[x])), abs(np.float64(e[x]) - np.float64(d[x]))
        beyond = one if one > 0.0 else 0.0
        beyond = other if other > beyond else beyond
        least = step_m + SLANT_SHARE * beyond
        # Between its neighbours: both steps have the same sign.
        flying[x] |= (before * after > 0.0) & (abs(before) > least) & (abs(after) > least)
