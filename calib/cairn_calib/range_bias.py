"""What a time-of-flight camera adds to every range: its model, as a sum of a few shapes.

    measured = true + offset_m + scale * true + radial_m * (distance from the image's middle / corner)^2

The offset is the same everywhere, the scale a modulation frequency's error, the radial part that of pixels further out
(their light goes another way through lens and illumination). What is free is known before to be small: BIAS_SIGMAS.

The scale is of the true range, not of the measured one: residuals of a model with (1 - scale) * measured in it shrink
with the noise that they hold, and least squares then finds a scale where there is none (measured: 3.6 sigma).
"""

import numpy as np
import numpy.typing as npt

from cairn_calib.lens import Lens

Floats = npt.NDArray[np.float64]

BIAS_NAMES = ("offset_m", "scale", "radial_m")
BIAS_SIGMAS = (0.1, 0.01, 0.05)
"""Before anything is measured: metres, metres a metre, metres at the corner."""
SCALE_AT = 1


def bias_shapes(lens: Lens, pixels: Floats, range_m: Floats) -> Floats:
    """(..., 3) what one unit of each of BIAS_NAMES adds to (...) true ranges, metres, at (..., 2) pixels."""
    return np.stack([np.ones_like(range_m), range_m, off_middle(lens, pixels)], axis=-1)


def off_middle(lens: Lens, pixels: Floats) -> Floats:
    """(...) squared distance of (..., 2) pixels from the image's middle, 1 at its corners."""
    middle = np.array([lens.width - 1, lens.height - 1]) / 2
    return np.asarray(np.sum((pixels - middle) ** 2, axis=-1) / float(np.sum(middle**2)))


def true_range(bias: Floats, lens: Lens, pixels: Floats, measured_m: Floats) -> Floats:
    """(...) ranges without the bias (3,), metres, of (...) measured at (..., 2) pixels."""
    offset_m, scale, radial_m = bias
    return np.asarray((measured_m - offset_m - radial_m * off_middle(lens, pixels)) / (1 + scale))
