"""Temperatures painted over a picture, and the hottest place: the loops of `painting`."""

import math

import numba as nb
import numpy as np

from cairn_map.arrays import Bytes, Singles

OK = 0
"""Value of `cairn_fusion.transfer.transfer.Label`."""
HATCH_PERIOD, HATCH_WIDTH = 16, 3
"""Pixels from line to line, and of a line."""
HATCH_GREY = 150
HATCH_MIX = 128
"""Share of grey in a hatched line, of 256."""


@nb.njit(cache=True, nogil=True)
def paint_into(
    out: Bytes,
    base: Bytes,
    kelvin: Singles,
    labels: Bytes,
    palette: Bytes,
    low_k: float,
    high_k: float,
    from_k: float,
    to_k: float,
    alpha: float,
    first_row: int,
) -> None:
    """Blend temperatures into a picture; hatch it where none is known.

    Args:
        out: (H, W, 3) takes the picture.
        base: (H, W, 3) the picture beneath.
        kelvin: (H, W)
        labels: (H, W) temperatures count where the label is OK and they are numbers.
        palette: (256, 3) from `low_k` to `high_k`; temperatures outside have the colour of the nearer end.
        low_k: of the palette's first colour, kelvin.
        high_k: of its last colour, kelvin.
        from_k: colder is not painted.
        to_k: hotter is not painted.
        alpha: weight of the palette's colour, 0 to 1.
        first_row: number of the first row in the whole picture, so that the hatching is continuous.
    """
    f = np.float32
    height, width = labels.shape
    scale, low, start, stop = f(255.0 / (high_k - low_k)), f(low_k), f(from_k), f(to_k)
    mix = np.int32(round(256 * alpha))
    rest = np.int32(256) - mix
    for y in range(height):
        for x in range(width):
            # Unknown: hatched, never the cold end of the palette.
            t = kelvin[y, x]
            if labels[y, x] != OK or math.isnan(t):
                grey = (x + y + first_row) % HATCH_PERIOD < HATCH_WIDTH
                for c in range(3):
                    value = np.int32(base[y, x, c])
                    hatched = (value * (256 - HATCH_MIX) + HATCH_GREY * HATCH_MIX) >> 8
                    out[y, x, c] = hatched if grey else value
                continue
            # Outside the band of the emphasis: the picture as it is.
            if t < start or t > stop:
                for c in range(3):
                    out[y, x, c] = base[y, x, c]
                continue
            # Else blended, in whole numbers of 1/256.
            level = np.int32(min(max((t - low) * scale + f(0.5), f(0.0)), f(255.0)))
            for c in range(3):
                out[y, x, c] = (np.int32(base[y, x, c]) * rest + np.int32(palette[level, c]) * mix) >> 8


@nb.njit(cache=True, nogil=True)
def hottest_square(kelvin: Singles, labels: Bytes) -> tuple[int, int, float]:
    """x, y and mean of the hottest 3 x 3 pixels that all are OK and numbers; -1, -1, NaN for none."""
    height, width = labels.shape
    best, best_x, best_y = -np.inf, -1, -1
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            # A middle colder than the best mean is skipped. The hottest square's own may be; a neighbour is then found.
            if labels[y, x] != OK or not kelvin[y, x] > best:
                continue
            # A pixel that is not OK makes the sum NaN, which is never the best.
            total = 0.0
            for j in range(y - 1, y + 2):
                for i in range(x - 1, x + 2):
                    total += np.float64(kelvin[j, i]) if labels[j, i] == OK else np.nan
            if total / 9.0 > best:
                best, best_x, best_y = total / 9.0, x, y
    return best_x, best_y, best if best_x >= 0 else np.nan
