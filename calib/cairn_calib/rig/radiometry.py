"""Radiometry of a thermal camera: its response to a black body, both ways, and its covariance.

    kelvin  --counts_of-->  counts          "radiometry" of a thermal camera in rig.json (CONVENTIONS.md)
    kelvin  <--kelvin_of--  counts          its sources: response_fit.py, flir_file.py, flat_field.py

Two laws. `planck`: U = R / (exp(B / T) - F) + O, FLIR's form of Planck's law over the camera's band, for counts that
are proportional to the light received. `polynomial`: T = c0 + c1 U + c2 U^2, for cameras that compute a temperature
themselves. Both are refused where they do not rise all over their range; beyond it there is no temperature, since no
reference was measured there.
"""

from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, first_error

Finite = Annotated[float, Field(allow_inf_nan=False)]
Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]
AtLeast0 = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Kelvin = Annotated[float, Field(ge=50, le=5000, allow_inf_nan=False)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ZERO_C_K = 273.15


class PlanckResponse(BaseModel):
    """U = r / (exp(b_k / T) - f) + o, of a black body at T kelvin; r is FLIR's R1 / R2, o its O with the other sign."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    law: Literal["planck"] = "planck"
    r: Above0
    b_k: Above0
    f: Finite = 1.0
    o: Finite = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the response's numbers, in the order of their covariance."""
        return ("r", "b_k", "o")

    def counts_of(self, kelvin: npt.ArrayLike) -> Floats:
        """(...) counts, not rounded, of a black body; NaN at and below 0 K."""
        T = _positive(kelvin)
        return np.asarray(self.r * self._light(T) + self.o)

    def kelvin_of(self, counts: npt.ArrayLike) -> Floats:
        """The mirror of `counts_of`; NaN where no temperature gives the counts."""
        light = _positive(np.asarray(counts, np.float64) - self.o)
        return np.asarray(self.b_k / _positive(np.log(_positive(self.r / light + self.f))))

    def slope(self, kelvin: npt.ArrayLike) -> Floats:
        """(...) counts a kelvin."""
        T = _positive(kelvin)
        light = self._light(T)
        # (exp(x) without its overflow: exp(x) = 1 / light + f.)
        return np.asarray(self.r * light * light * (1 / light + self.f) * self.b_k / T**2)

    def by_parameters(self, kelvin: npt.ArrayLike) -> Floats:
        """(..., 3) counts a unit of each of `names`."""
        T = _positive(kelvin)
        light = self._light(T)
        return np.stack([light, -self.slope(T) * T / self.b_k, np.ones_like(light)], axis=-1)

    def _light(self, T: Floats) -> Floats:
        tail = np.exp(-self.b_k / T)
        return np.asarray(tail / (1 - self.f * tail))


class PolynomialResponse(BaseModel):
    """T = c0 + c1 v + c2 v^2 kelvin, v = (U - at_counts) / per_counts: counts of nearly even steps of temperature."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    law: Literal["polynomial"] = "polynomial"
    c0: Finite
    c1: Above0
    c2: Finite = 0.0
    at_counts: Finite
    """About the middle of the references, so that the coefficients stay of one size."""
    per_counts: Above0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the response's numbers, in the order of their covariance."""
        return ("c0", "c1", "c2")

    def kelvin_of(self, counts: npt.ArrayLike) -> Floats:
        """(...) kelvin of a black body that gives the counts; NaN beyond the turning point."""
        v = (np.asarray(counts, np.float64) - self.at_counts) / self.per_counts
        return np.asarray(np.where(self.c1 + 2 * self.c2 * v > 0, self.c0 + v * (self.c1 + v * self.c2), np.nan))

    def counts_of(self, kelvin: npt.ArrayLike) -> Floats:
        """The mirror of `kelvin_of`; NaN where no counts give the temperature."""
        up = np.asarray(kelvin, np.float64) - self.c0
        root = np.sqrt(_positive(self.c1**2 + 4 * self.c2 * up))
        return np.asarray(self.at_counts + self.per_counts * 2 * up / (self.c1 + root))

    def slope(self, kelvin: npt.ArrayLike) -> Floats:
        """(...) counts a kelvin."""
        up = np.asarray(kelvin, np.float64) - self.c0
        return np.asarray(self.per_counts / np.sqrt(_positive(self.c1**2 + 4 * self.c2 * up)))

    def by_parameters(self, kelvin: npt.ArrayLike) -> Floats:
        """(..., 3) counts a unit of each of `names`."""
        T = np.asarray(kelvin, np.float64)
        v = (self.counts_of(T) - self.at_counts) / self.per_counts
        return np.asarray(-self.slope(T)[..., None] * np.stack([np.ones_like(v), v, v * v], axis=-1))


Response = Annotated[PlanckResponse | PolynomialResponse, Field(discriminator="law")]


class MapsFile(BaseModel):
    """File next to rig.json with the differences of the pixels from their mean (`flat_field.py`)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    sha256: Sha256


class Housing(BaseModel):
    """Counts that the camera's own temperature adds: `counts_per_k` (T_housing - at_k)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_k: Kelvin
    """Temperature of the housing for which the response holds: the mean of the references."""
    counts_per_k: Finite
    covariance_row: tuple[Finite, Finite, Finite, AtLeast0]
    """Covariance of `counts_per_k` with the response's three numbers, and its own variance."""
    range_k: tuple[Kelvin, Kelvin]
    """Lowest and highest housing temperature of the references; outside, no temperature is given."""
    spread_k: AtLeast0
    """Standard deviation of the references' housings: the uncertainty of a housing whose temperature is unknown."""


class Radiometry(BaseModel):
    """Response of one camera, its range and covariance; `radiometry` in rig.json, or a file of its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["cairn-radiometry"] = "cairn-radiometry"
    version: Literal[1] = 1
    response: Response
    range_k: tuple[Kelvin, Kelvin]
    """Lowest and highest black body that was measured; colder or hotter things have no temperature."""
    covariance_lower: tuple[tuple[Finite, ...], ...] | None = None
    """Lower triangle of the covariance of the response's numbers, row by row; absent for a maker's own numbers."""
    accuracy_k: AtLeast0 = 0.0
    """Standard deviation that the maker states, the same error at all pixels; added to the covariance."""
    noise_counts: AtLeast0 = 0.0
    """Standard deviation of a pixel's counts from image to image."""
    pattern_counts: AtLeast0 = 0.0
    """Standard deviation of the pixels' own offsets that the maps leave."""
    housing: Housing | None = None
    """Effect of the housing's temperature; absent where it is unknown, or was always the same."""
    source: Annotated[str, Field(min_length=1, max_length=400)]
    """Origin of the numbers, for people."""
    maps: MapsFile | None = None

    @model_validator(mode="after")
    def _rises(self) -> Self:
        low_k, high_k = self.range_k
        if not low_k < high_k:
            raise ValueError(f"range_k must rise, got {low_k:g} to {high_k:g}")
        with np.errstate(all="ignore"):
            counts = self.response.counts_of(np.linspace(low_k, high_k, 101))
        if not (np.isfinite(counts).all() and (np.diff(counts) > 0).all()):
            raise ValueError(f"the response does not rise all the way from {low_k:g} to {high_k:g} K")
        return self

    @model_validator(mode="after")
    def _is_a_covariance(self) -> Self:
        if self.covariance_lower is not None and [len(row) for row in self.covariance_lower] != [1, 2, 3]:
            raise ValueError("covariance_lower must have rows of 1, 2 and 3 numbers")
        whole = np.zeros((4, 4))
        whole[:3, :3] = self.covariance
        if self.housing is not None:
            whole[3] = whole[:, 3] = self.housing.covariance_row
        sigma = np.sqrt(np.maximum(np.diag(whole), 0))
        safe = np.where(sigma > 0, sigma, 1)
        if np.linalg.eigvalsh(whole / safe[:, None] / safe)[0] < -1e-6:
            raise ValueError("the covariance, that of the housing included, has a negative eigenvalue")
        return self

    @property
    def covariance(self) -> Floats:
        """(3, 3) covariance of the response's `names`; zeros where it is unknown."""
        matrix = np.zeros((3, 3))
        for n, row in enumerate(self.covariance_lower or ()):
            matrix[n, : n + 1] = row
            matrix[: n + 1, n] = row
        return matrix

    def to_json(self) -> bytes:
        """The bytes of a file of its own; the mirror of `radiometry_from_json`."""
        return self.model_dump_json(indent=1, exclude_none=True).encode() + b"\n"


def radiometry_from_json(data: bytes) -> Radiometry:
    """The radiometry in a file's bytes.

    Raises:
        BadInputError: not JSON, another format or version, or numbers that cannot be; the message names the field.
    """
    try:
        return Radiometry.model_validate_json(data)
    except ValidationError as exc:
        raise BadInputError("bad_radiometry", f"radiometry: {first_error(exc)}") from exc


def _positive(values: npt.ArrayLike) -> Floats:
    """Values above 0; NaN for all others."""
    v = np.asarray(values, np.float64)
    return np.where(v > 0, v, np.nan)
