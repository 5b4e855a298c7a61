"""Range bias of a time-of-flight camera: a sum of a few shapes, and a number for each pixel.

    measured = true + offset_m + scale * true + radial_m * q + radial4_m * q^2                   q: off the middle
             + sum of wiggleK_cos_m * cos(K phi) + wiggleK_sin_m * sin(K phi)                    phi = 4 pi f true / c
             + faint_m * (usual amplitude / amplitude - 1) + offset of the pixel
    q = (distance from the image's middle / corner)^2

The offset is the same everywhere, the scale a modulation frequency's error, the radial part that of pixels further out
(their light goes another way through lens and illumination). Priors hold all free numbers small (`range_terms`);
where the boards do not reach the image's corners, the fourth power stays there and a warning says so. The other shapes
are there only where the boards' images show them (`range_choice.py`), pixels where they differ (`pixel_pattern.py`).

Scale and waves are of the true range, not of the measured one: residuals of a model with (1 - scale) * measured in it
shrink with the noise that they hold, and least squares then finds a scale where there is none (measured: 3.6 sigma).

`rig.json` states the solved bias with its camera; it is subtracted where ranges enter the fusion:

    "range_bias": {"version": 1, "offset_m": 0.024, "scale": 0.003, "radial_m": 0.012, "radial4_m": 0.0,
     "covariance_lower": [[4e-6], [-2e-6, 1e-6], [0.0, 0.0, 1e-6], [0.0, 0.0, 0.0, 4e-6]]}
"""

from typing import Annotated, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.rig.pixel_offsets import PixelOffsets
from cairn_calib.rig.range_terms import BIAS_NAMES, RangeTerms, off_middle, off_middle_image
from cairn_calib.rig.raster import Raster
from cairn_map.arrays import Floats

Real = TypeVar("Real", bound=np.floating)

MEAN_OFF_MIDDLE = 1 / 3
"""Mean of `off_middle` over an image of any size."""
INDEFINITE_SHARE = 1e-9
"""Share of the correlations' largest eigenvalue below which a negative one is rounding."""
WAVES_MAX = 4
STEEPEST = 0.5
"""Bound on the slope of all waves together, metres per metre: below it every measured range has one true range."""
NEWTON_STEPS = 4
"""Each squares the error, which begins with the waves' few centimetres."""
Metres = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Amplitude = Annotated[float, Field(gt=0, le=65535, allow_inf_nan=False)]


class Wave(BaseModel):
    """One wave of the circular error: its number in a turn of the light's phase, and its cosine and sine."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    harmonic: Annotated[int, Field(ge=1, le=8)]
    cos_m: Metres
    sin_m: Metres


class Wiggle(BaseModel):
    """The circular error, of the phase 4 pi modulation_hz range / c."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    modulation_hz: Annotated[float, Field(ge=1e5, le=1e10, allow_inf_nan=False)]
    waves: Annotated[tuple[Wave, ...], Field(min_length=1, max_length=WAVES_MAX)]


class ByAmplitude(BaseModel):
    """Offset of faint pixels: faint_m (at / amplitude - 1), with the amplitude clamped to `low` and `high`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    faint_m: Metres
    at: Amplitude
    """Usual amplitude, counts, at which the offset is 0, as it is where the amplitude is unknown."""
    low: Amplitude
    """Lowest amplitude of the boards, counts."""
    high: Amplitude
    """Highest amplitude of the boards, counts."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.low <= self.at <= self.high:
            raise ValueError(f"low <= at <= high must hold of amplitudes, got {self.low}, {self.at}, {self.high}")
        return self


class RangeBias(BaseModel, frozen=True):
    """Metres that one range camera adds to its ranges, with their covariance."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    offset_m: Metres
    scale: Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False)]
    radial_m: Metres
    radial4_m: Metres = 0.0
    wiggle: Wiggle | None = None
    by_amplitude: ByAmplitude | None = None
    parameters: Annotated[tuple[str, ...], Field(max_length=16)] | None = None
    """Names of the covariance's rows, which must be `names`; None: not stated."""
    covariance_lower: Annotated[tuple[tuple[Finite, ...], ...], Field(max_length=16)] | None = None
    """Lower triangle of the covariance, in the order of `names`, row by row; None: unknown."""
    pixel_offsets: PixelOffsets | None = None
    """Offsets that single pixels add to it."""

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        rows, count = self.covariance_lower, len(self.names)
        if rows is not None and [len(row) for row in rows] != list(range(1, count + 1)):
            raise ValueError(
                f"covariance_lower must be {count} rows of 1 to {count} numbers, of {', '.join(self.names)}"
            )
        if self.parameters is not None and self.parameters != self.names:
            raise ValueError(f"parameters must be {', '.join(self.names)}")
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

    @model_validator(mode="after")
    def _ranges_rise(self) -> Self:
        terms = self.terms
        waves = () if self.wiggle is None else self.wiggle.waves
        if len(set(terms.harmonics)) < len(terms.harmonics):
            raise ValueError("wiggle.waves: a harmonic is listed twice")
        steepest = sum(terms.phase_a_metre(each.harmonic) * float(np.hypot(each.cos_m, each.sin_m)) for each in waves)
        if steepest > STEEPEST * (1 + self.scale):
            raise ValueError(f"wiggle: waves as steep as {steepest:.2g} give one measured range for several true ones")
        return self

    @property
    def terms(self) -> RangeTerms:
        """Its shapes."""
        waves = () if self.wiggle is None else self.wiggle.waves
        return RangeTerms(
            None if self.wiggle is None else self.wiggle.modulation_hz,
            tuple(each.harmonic for each in waves),
            None if self.by_amplitude is None else self.by_amplitude.at,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """(B,) of the numbers."""
        return self.terms.names

    @property
    def values(self) -> Floats:
        """(B,) in the order of `names`."""
        waves = () if self.wiggle is None else self.wiggle.waves
        parts = [part for each in waves for part in (each.cos_m, each.sin_m)]
        faint = [] if self.by_amplitude is None else [self.by_amplitude.faint_m]
        return np.array([self.offset_m, self.scale, self.radial_m, self.radial4_m, *parts, *faint])

    @property
    def covariance(self) -> Floats:
        """(B, B) covariance in the order of `names`; 0 where it is unknown."""
        matrix = np.zeros((len(self.names), len(self.names)))
        for n, row in enumerate(self.covariance_lower or ()):
            matrix[n, : n + 1] = matrix[: n + 1, n] = row
        return matrix

    def sigma_at(self, range_m: npt.NDArray[np.floating]) -> Floats:
        """(...) standard deviation, metres, that it leaves to (...) true ranges of a pixel like any other.

        That is with `MEAN_OFF_MIDDLE`, the usual amplitude and the mean variance of the pixels' offsets.
        """
        d = np.asarray(range_m, np.float64)
        of_pixels = 0.0 if self.pixel_offsets is None else self.pixel_offsets.mean_variance_m2
        return self._sigma(d, np.full_like(d, MEAN_OFF_MIDDLE), of_pixels)

    def sigma_image(self, raster: Raster, range_m: npt.NDArray[np.floating]) -> Floats:
        """(H, W) standard deviation of the bias at (H, W) ranges, metres, with that of each pixel's own offset."""
        of_pixels = 0.0 if self.pixel_offsets is None else self.pixel_offsets.sigma_m**2
        return self._sigma(np.asarray(range_m, np.float64), off_middle_image(raster.width, raster.height), of_pixels)

    def _sigma(self, d: Floats, off: Floats, more_m2: Floats | float) -> Floats:
        with np.errstate(invalid="ignore"):  # the wave of an endless range
            shapes = self.terms.shapes(d, off, np.zeros_like(d))
            variance = np.einsum("...i,ij,...j", shapes, self.covariance, shapes, optimize=True)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0) + more_m2))

    def true_image(
        self, raster: Raster, range_m: npt.NDArray[Real], amplitude: npt.NDArray[np.generic] | None = None
    ) -> npt.NDArray[Real]:
        """(H, W) ranges of a camera without it, metres, of (H, W) measured; NaN where those are.

        Args:
            raster: the camera.
            range_m: (H, W) measured, metres.
            amplitude: (H, W) counts; None: as if it were the usual one everywhere.

        Raises:
            BadInputError: an image has another size.
        """
        raster.check_image(range_m, name="range image")
        added_m = self._smooth(off_middle_image(raster.width, raster.height))
        if self.pixel_offsets is not None:
            added_m = added_m + self.pixel_offsets.offset_m
        if self.by_amplitude is not None and amplitude is not None:
            raster.check_image(amplitude, name="amplitude image")
            held = np.clip(amplitude.astype(np.float64), self.by_amplitude.low, self.by_amplitude.high)
            added_m = added_m + self.by_amplitude.faint_m * self.terms.faintness(held)
        return self._remove_scale_and_waves(range_m.astype(np.float64) - added_m).astype(range_m.dtype)

    def true_at(self, raster: Raster, pixels: Floats, range_m: Floats) -> Floats:
        """(N,) ranges without it, metres, of (N,) measured at (N, 2) pixels, at the usual amplitude."""
        added_m = self._smooth(off_middle(raster, pixels))
        if self.pixel_offsets is not None:
            x, y = np.clip(np.rint(pixels), 0, (raster.width - 1, raster.height - 1)).astype(np.intp).T
            added_m = added_m + self.pixel_offsets.offset_m[y, x]
        return self._remove_scale_and_waves(range_m - added_m)

    def _smooth(self, off: Floats) -> Floats:
        """(...) what does not depend on the range, metres."""
        return self.offset_m + self.radial_m * off + self.radial4_m * off**2

    def _remove_scale_and_waves(self, level_m: Floats) -> Floats:
        """(...) true ranges where (1 + scale) true + waves(true) is `level_m`."""
        true_m = np.asarray(level_m / (1 + self.scale))
        if self.wiggle is None:
            return true_m
        terms, values = self.terms, self.values
        # Only what depends on the range.
        values = np.where([name.startswith(("scale", "wiggle")) for name in terms.names], values, 0.0)
        nothing = np.zeros_like(true_m)
        with np.errstate(invalid="ignore"):
            for _ in range(NEWTON_STEPS):
                miss = true_m + terms.shapes(true_m, nothing, nothing) @ values - level_m
                true_m = true_m - miss / (1 + terms.slopes(true_m) @ values)
        return true_m


def bias_from_matrix(
    terms: RangeTerms, values: Floats, covariance: Floats, *, amplitudes: tuple[float, float] | None = None
) -> RangeBias:
    """The bias of (B,) values, in the order of `terms.names`, with their (B, B) covariance.

    `amplitudes` are the lowest and highest that were seen, where there is a shape for it.
    """
    mean = (covariance + covariance.T) / 2
    by_name = dict(zip(terms.names, values.tolist(), strict=True))
    known: dict[str, object] = {name: by_name[name] for name in BIAS_NAMES}
    if terms.harmonics:
        waves = [
            {"harmonic": k, **{f"{part}_m": by_name[f"wiggle{k}_{part}_m"] for part in ("cos", "sin")}}
            for k in terms.harmonics
        ]
        known["wiggle"] = {"modulation_hz": terms.modulation_hz, "waves": waves}
    if terms.amplitude_at is not None and amplitudes is not None:
        low, high = amplitudes
        known["by_amplitude"] = {"faint_m": by_name["faint_m"], "at": terms.amplitude_at, "low": low, "high": high}
    known |= {"parameters": terms.names, "covariance_lower": [row[: n + 1] for n, row in enumerate(mean.tolist())]}
    return RangeBias.model_validate(known)
