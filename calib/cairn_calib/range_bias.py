"""What a time-of-flight camera adds to every range: its model, as a sum of a few shapes.

    measured = true + offset_m + scale * true + radial_m * q + radial4_m * q^2
    q = (distance from the image's middle / corner)^2

The offset is the same everywhere, the scale a modulation frequency's error, the radial part that of pixels further out
(their light goes another way through lens and illumination). What is free is known before to be small: BIAS_SIGMAS;
where the boards do not reach the image's corners, the fourth power stays there and a warning says so.

The scale is of the true range, not of the measured one: residuals of a model with (1 - scale) * measured in it shrink
with the noise that they hold, and least squares then finds a scale where there is none (measured: 3.6 sigma).

What a solve found stands in `rig.json` at its camera, and is taken off where ranges enter the fusion:

    "range_bias": {"version": 1, "offset_m": 0.024, "scale": 0.003, "radial_m": 0.012, "radial4_m": 0.0,
     "covariance_lower": [[4e-6], [-2e-6, 1e-6], [0.0, 0.0, 1e-6], [0.0, 0.0, 0.0, 4e-6]]}
"""

from functools import lru_cache
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.raster import Raster

Floats = npt.NDArray[np.float64]
Real = TypeVar("Real", bound=np.floating)

BIAS_NAMES = ("offset_m", "scale", "radial_m", "radial4_m")
BIAS_SIGMAS = (0.1, 0.01, 0.05, 0.02)
"""Before anything is measured: metres, metres a metre, metres at the corner, likewise."""
SCALE_AT = 1
MEAN_OFF_MIDDLE = 1 / 3
"""Of `off_middle` over an image, whatever its sides."""
INDEFINITE_SHARE = 1e-9
"""Of the largest eigenvalue of the correlations: a smaller negative one is rounding."""
Metres = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Lower = tuple[
    tuple[Finite], tuple[Finite, Finite], tuple[Finite, Finite, Finite], tuple[Finite, Finite, Finite, Finite]
]


class RangeBias(BaseModel, frozen=True):
    """What one range camera adds to its ranges, and how certain that is."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    offset_m: Metres
    scale: Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)]
    radial_m: Metres
    radial4_m: Metres = 0.0
    covariance_lower: Lower | None = None
    """Lower triangle of the covariance, in the order of BIAS_NAMES, row by row; None: not known."""

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        matrix = self.covariance
        if (np.diag(matrix) < 0).any():
            raise ValueError("covariance_lower is no covariance: it has a negative variance")
        sigmas = np.sqrt(np.diag(matrix))
        safe = np.where(sigmas > 0, sigmas, 1)
        with np.errstate(over="ignore", invalid="ignore"):
            correlations = matrix / safe[:, None] / safe
        if not np.isfinite(correlations).all() or np.linalg.eigvalsh(correlations)[0] < -INDEFINITE_SHARE:
            raise ValueError("covariance_lower is no covariance: it has a negative eigenvalue")
        return self

    @property
    def values(self) -> Floats:
        """(4,) in the order of BIAS_NAMES."""
        return np.array([self.offset_m, self.scale, self.radial_m, self.radial4_m])

    @property
    def covariance(self) -> Floats:
        """(4, 4) in the order of BIAS_NAMES; 0 where it is not known."""
        matrix = np.zeros((4, 4))
        for n, row in enumerate(self.covariance_lower or ()):
            matrix[n, : n + 1] = matrix[: n + 1, n] = row
        return matrix

    def sigma_at(self, range_m: npt.NDArray[np.floating]) -> Floats:
        """(...) standard deviation, metres, that it leaves to (...) true ranges: with `MEAN_OFF_MIDDLE`."""
        d = np.asarray(range_m, np.float64)
        shapes = _shapes(d, np.full_like(d, MEAN_OFF_MIDDLE))
        return np.asarray(np.sqrt(np.maximum(np.einsum("...i,ij,...j", shapes, self.covariance, shapes), 0.0)))

    def true_image(self, raster: Raster, range_m: npt.NDArray[Real]) -> npt.NDArray[Real]:
        """(H, W) ranges of a camera without it, metres, of (H, W) measured; NaN where those are.

        Raises:
            BadInputError: the image has another size.
        """
        raster.check_image(range_m, name="range image")
        off = _off_middle_image(raster.width, raster.height)
        return _without(self.values, off, range_m.astype(np.float64)).astype(range_m.dtype)


def bias_from_matrix(values: Floats, covariance: Floats) -> RangeBias:
    """The bias of (4,) values, in the order of BIAS_NAMES, with their (4, 4) covariance."""
    mean = (covariance + covariance.T) / 2
    known: dict[str, object] = dict(zip(BIAS_NAMES, values.tolist(), strict=True))
    return RangeBias.model_validate(known | {"covariance_lower": [row[: n + 1] for n, row in enumerate(mean.tolist())]})


def bias_shapes(raster: Raster, pixels: Floats, range_m: Floats) -> Floats:
    """(..., 4) what one unit of each of BIAS_NAMES adds to (...) true ranges, metres, at (..., 2) pixels."""
    return _shapes(range_m, off_middle(raster, pixels))


def off_middle(raster: Raster, pixels: Floats) -> Floats:
    """(...) squared distance of (..., 2) pixels from the image's middle, 1 at its corners."""
    return _off_middle(raster.width, raster.height, pixels)


def true_range(bias: Floats, raster: Raster, pixels: Floats, measured_m: Floats) -> Floats:
    """(...) ranges without the bias (4,), metres, of (...) measured at (..., 2) pixels."""
    return _without(bias, off_middle(raster, pixels), measured_m)


def _without(bias: Floats, off: Floats, measured_m: Floats) -> Floats:
    offset_m, scale, radial_m, radial4_m = bias
    return np.asarray((measured_m - offset_m - radial_m * off - radial4_m * off**2) / (1 + scale))


def _shapes(range_m: Floats, off: Floats) -> Floats:
    return np.stack([np.ones_like(range_m), range_m, off, off**2], axis=-1)


def _off_middle(width: int, height: int, pixels: Floats) -> Floats:
    middle = np.array([width - 1, height - 1]) / 2
    # The single pixel of an image of one is its middle.
    return np.asarray(np.sum((pixels - middle) ** 2, axis=-1) / (float(np.sum(middle**2)) or 1.0))


@lru_cache(maxsize=16)
def _off_middle_image(width: int, height: int) -> Floats:
    y, x = np.mgrid[:height, :width]
    off = _off_middle(width, height, np.stack([x, y], axis=-1).astype(np.float64))
    off.setflags(write=False)
    return off
