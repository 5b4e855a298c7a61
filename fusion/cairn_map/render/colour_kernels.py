"""Values as colours, and ink on an image, pixel by pixel; no checks."""

import numba as nb
import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Rgb

Values = npt.NDArray[np.float32]


@nb.njit(cache=True, nogil=True)
def paint_into(values: Values, palette: Rgb, low: float, high: float, unknown: Rgb, out: Rgb) -> None:
    """(N, 3) colours of (N,) values between the two ends of a palette (256, 3); NaN is `unknown` (3,)."""
    step = 255 / (high - low)
    for n in range(values.shape[0]):
        value = values[n]
        if np.isnan(value):
            for c in range(3):
                out[n, c] = unknown[c]
        else:
            level = int(min(max((value - low) * step, 0.0), 255.0) + 0.5)
            for c in range(3):
                out[n, c] = palette[level, c]


@nb.njit(cache=True, nogil=True)
def blend_into(image: Rgb, ink: Rgb, out: Rgb) -> None:
    """(N, 3) pixels under (N, 4) ink: its colours are multiplied by its cover already, which is the fourth."""
    for n in range(image.shape[0]):
        rest = 255 - int(ink[n, 3])
        for c in range(3):
            out[n, c] = min((image[n, c] * rest + 127) // 255 + int(ink[n, c]), 255)
