"""Temperatures of surfaces that a thermal camera sees: counts, emissivity, reflections, and the air between.

    U = eps tau U(T) + (1 - eps) tau U(T_reflected) + (1 - tau) U(T_air) + h (T_housing - T_0)

U(T) and h are in radiometry.py. The equation is solved for T, with the standard deviation that the uncertainty of every
number in it leaves. Counts of a camera whose response is unknown come back as `NotRadiometric`: a type without kelvin.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.radiometry import ZERO_C_K, Radiometry
from cairn_calib.thermal.flat_field import FlatField
from cairn_map.arrays import Floats, Singles
from cairn_map.errors import BadInputError

EMISSIVITY_MIN = 0.3
"""Lowest emissivity: below it more than two thirds of the light are reflections, as on bare metal."""
WATER = (1.5587, 6.939e-2, -2.7816e-4, 6.8455e-7)
"""Logarithm of grams of water a cubic metre of saturated air, by powers of its temperature in Celsius; FLIR's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewing:
    """Surface and surroundings, each number with its standard deviation; the defaults are a black body."""

    emissivity: float = 1.0
    emissivity_sigma: float = 0.0
    reflected_k: float = 293.15
    """Apparent temperature of the surroundings that the surface mirrors."""
    reflected_sigma_k: float = 0.0
    transmission: float = 1.0
    """Transmission of the air, and of a window if there is one."""
    transmission_sigma: float = 0.0
    air_k: float = 293.15
    air_sigma_k: float = 0.0

    def __post_init__(self) -> None:
        if not (EMISSIVITY_MIN <= self.emissivity <= 1 and 0 < self.transmission <= 1):
            raise BadInputError(
                "bad_viewing",
                f"an emissivity must be {EMISSIVITY_MIN} to 1 (of less, as of bare metal, no camera can tell the "
                f"temperature: paint it or tape it) and a transmission above 0 to 1, got {self.emissivity:g} and "
                f"{self.transmission:g}",
            )
        sigmas = (self.emissivity_sigma, self.reflected_sigma_k, self.transmission_sigma, self.air_sigma_k)
        if not (all(0 <= sigma < np.inf for sigma in sigmas) and min(self.reflected_k, self.air_k) > 0):
            raise BadInputError("bad_viewing", "standard deviations must be 0 or more, temperatures above 0 K")


@dataclass(frozen=True, slots=True)
class Temperatures:
    """Temperatures of the pixels of an image."""

    kelvin: Singles
    """(H, W); NaN at bad pixels and beyond the range of the radiometry."""
    sigma_k: Singles
    """(H, W) standard deviation by all sources."""
    common_sigma_k: Singles
    """(H, W) the part that all pixels of the same temperature share: no mean over pixels makes it smaller."""


@dataclass(frozen=True, slots=True)
class NotRadiometric:
    """Counts that have no temperature, and the reason."""

    counts: Singles
    """(H, W) as the camera gave them."""
    reason: str


def temperatures(
    counts: npt.NDArray[np.generic],
    radiometry: Radiometry | None,
    *,
    viewing: Viewing | None = None,
    flat_field: FlatField | None = None,
    housing_k: float | None = None,
) -> Temperatures | NotRadiometric:
    """Temperatures of the surfaces in a thermal image.

    Args:
        counts: (H, W) as the camera gave them.
        radiometry: response of the camera; None where it is unknown.
        viewing: surface and surroundings; None: black, through clear air, so that temperatures are apparent.
        flat_field: differences of the pixels; None where the camera itself levels them.
        housing_k: temperature of the camera itself, kelvin; None where unknown, which makes the standard deviation
            larger.

    Returns:
        Counts alone where the response is unknown, or does not hold for so warm or cold a camera.

    Raises:
        BadInputError: a temperature of the viewing has no counts, or the flat field is of another size.
    """
    if radiometry is None:
        return NotRadiometric(np.asarray(counts, np.float32), "the camera has no radiometry: no reference was measured")
    if (refusal := _housing_refusal(radiometry, housing_k)) is not None:
        return NotRadiometric(np.asarray(counts, np.float32), refusal)
    seen, response, housing = viewing or Viewing(), radiometry.response, radiometry.housing
    warmer_k = 0.0 if housing is None or housing_k is None else housing_k - housing.at_k
    # Levelled counts U, without those that the housing adds.
    level = np.asarray(counts, np.float64) if flat_field is None else flat_field.level_counts(counts)
    maps_sigma = 0.0 if flat_field is None else flat_field.level_sigma(level)
    level = level - warmer_k * (housing.counts_per_k if housing else 0.0)
    # U(T) = (U - (1 - eps) tau U(T_reflected) - (1 - tau) U(T_air)) / (eps tau), then T within the response's range.
    eps, tau = seen.emissivity, seen.transmission
    mirrored, air = (_counts_at(radiometry, k) for k in (seen.reflected_k, seen.air_k))
    with np.errstate(invalid="ignore"):
        own = (level - (1 - eps) * tau * mirrored - (1 - tau) * air) / (eps * tau)
        kelvin = response.kelvin_of(own)
        low_k, high_k = radiometry.range_k
        kelvin = np.where((kelvin >= low_k) & (kelvin <= high_k), kelvin, np.nan)
    # Variances of U, one common to all pixels and one of each; dU / dT makes them kelvin.
    by_kelvin = eps * tau * response.slope(kelvin)
    common = _common_variance(radiometry, seen, kelvin, by_kelvin, own, housing_k)
    each = radiometry.noise_counts**2 + np.maximum(radiometry.pattern_counts, maps_sigma) ** 2
    return Temperatures(
        kelvin.astype(np.float32),
        (np.sqrt(np.maximum(common, 0) + each) / by_kelvin).astype(np.float32),
        (np.sqrt(np.maximum(common, 0)) / by_kelvin).astype(np.float32),
    )


def _housing_refusal(radiometry: Radiometry, housing_k: float | None) -> str | None:
    """Reason why the response does not hold for a camera as warm as `housing_k`, or None."""
    if radiometry.housing is None or housing_k is None:
        return None
    # References were measured with the housing in this range only.
    low_k, high_k = radiometry.housing.range_k
    if low_k <= housing_k <= high_k:
        return None
    return (
        f"the camera's housing was at {housing_k - ZERO_C_K:.1f} C, and references were taken at "
        f"{low_k - ZERO_C_K:.1f} to {high_k - ZERO_C_K:.1f} C"
    )


def _common_variance(
    radiometry: Radiometry, seen: Viewing, kelvin: Floats, by_kelvin: Floats, own: Floats, housing_k: float | None
) -> Floats:
    """(H, W) variance, counts squared, of the part of U that all pixels of one temperature share.

    The model is F(T, everything) = U, so T moves with each of the other numbers by -(dF / d other) / (dF / dT).
    """
    response, eps, tau = radiometry.response, seen.emissivity, seen.transmission
    mirrored, air = (_counts_at(radiometry, k) for k in (seen.reflected_k, seen.air_k))
    # The response's own numbers, at the three temperatures of the model.
    weights = (((1 - eps) * tau, seen.reflected_k), (1 - tau, seen.air_k))
    by_response = eps * tau * response.by_parameters(kelvin)
    for weight, k in weights:
        by_response = by_response + weight * response.by_parameters(k)
    common = np.einsum("...i,ij,...j", by_response, radiometry.covariance, by_response)
    common += (by_kelvin * radiometry.accuracy_k) ** 2
    # The housing: h, which is correlated with the response, and the housing's temperature where it is unknown.
    housing = radiometry.housing
    if housing is not None:
        warmer_k, warmer_sigma_k = (0.0, housing.spread_k) if housing_k is None else (housing_k - housing.at_k, 0.0)
        *with_response, variance = housing.covariance_row
        common += warmer_k * (2 * by_response @ np.array(with_response) + warmer_k * variance)
        common += (housing.counts_per_k * warmer_sigma_k) ** 2
    # Emissivity, transmission, and the temperatures around.
    common += (tau * (own - mirrored) * seen.emissivity_sigma) ** 2
    common += ((eps * own + (1 - eps) * mirrored - air) * seen.transmission_sigma) ** 2
    for (weight, k), sigma_k in zip(weights, (seen.reflected_sigma_k, seen.air_sigma_k), strict=True):
        common += (weight * float(response.slope(k)) * sigma_k) ** 2 if weight else 0.0
    return np.asarray(common)


def seen_counts(kelvin: npt.ArrayLike, radiometry: Radiometry, viewing: Viewing) -> Floats:
    """(...) counts of surfaces at temperatures: the model forwards, the mirror of `temperatures`."""
    eps, tau = viewing.emissivity, viewing.transmission
    mirrored, air = (_counts_at(radiometry, k) for k in (viewing.reflected_k, viewing.air_k))
    # The equation of this module's head, without the housing.
    own = radiometry.response.counts_of(kelvin)
    return np.asarray(eps * tau * own + (1 - eps) * tau * mirrored + (1 - tau) * air)


def air_transmission(
    distance_m: float, *, air_k: float, humidity: float, constants: tuple[float, float, float, float, float]
) -> float:
    """Share of thermal light that air lets through, 0 to 1; FLIR's formula, as in Minkina and Dudzik (2009).

    Args:
        distance_m: from 0.
        air_k: kelvin.
        humidity: relative, 0 to 1.
        constants: alpha 1, alpha 2, beta 1, beta 2, x; FLIR writes them into its files.
    """
    alpha_1, alpha_2, beta_1, beta_2, x = constants
    # Root of the water in the air, then two exponentials of distance and water.
    water = np.sqrt(humidity * np.exp(np.polynomial.polynomial.polyval(air_k - 273.15, WATER)))
    root = np.sqrt(distance_m)
    parts = (np.exp(-root * (a + b * water)) for a, b in ((alpha_1, beta_1), (alpha_2, beta_2)))
    first, second = (float(part) for part in parts)
    # FLIR's usual x is 1.9, so the second share is negative; a transmission is at most 1.
    return min(1.0, x * first + (1 - x) * second)


def _counts_at(radiometry: Radiometry, kelvin: float) -> float:
    """Counts of a black body at the temperature of surroundings."""
    counts = float(radiometry.response.counts_of(kelvin))
    if not np.isfinite(counts):
        raise BadInputError("bad_viewing", f"the camera's response says nothing of surroundings at {kelvin:g} K")
    return counts
