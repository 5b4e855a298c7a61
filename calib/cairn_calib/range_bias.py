"""What a time-of-flight camera adds to every range: its model, as a sum of a few shapes.

    measured = true + offset_m + scale * measured + radial_m * (distance from the image's middle / corner)^2

The offset is the same everywhere, the scale a modulation frequency's error, the radial part that of pixels further out
(their light goes another way through lens and illumination). What is free is known before to be small: BIAS_SIGMAS.
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.lens import Lens

Floats = npt.NDArray[np.float64]

BIAS_NAMES = ("offset_m", "scale", "radial_m")
BIAS_SIGMAS = (0.1, 0.01, 0.05)
"""Before anything is measured: metres, metres a metre, metres at the corner."""


def bias_shapes(lens: Lens, pixels: Floats, range_m: Floats) -> Floats:
    """(..., 3) what one unit of each of BIAS_NAMES adds to (...) measured ranges, metres, at (..., 2) pixels."""
    middle = np.array([lens.width - 1, lens.height - 1]) / 2
    off = np.sum((pixels - middle) ** 2, axis=-1) / float(np.sum(middle**2))
    return np.stack([np.ones_like(range_m), range_m, off], axis=-1)
