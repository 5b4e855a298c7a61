"""Units of a scan's numbers: those that no sensor gives, but that the same numbers in another unit would be.

    range image    median 2400       millimetres: a range camera's are 0.1 to 10 m, a lidar's to 300 m
    thermal image  median 23.4       degrees Celsius, or Fahrenheit: the coldest place on Earth had 184 K
    time           1 760 000 000 000  milliseconds: seconds are in the year 57 742

A scan that is refused here would have become evidence of another world, in the map for all robots.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError

LONGEST_RANGE_M = 1000.0
COLDEST_K = 150.0
LATEST_S = 1e10
"""In the year 2286."""
LOOK_AT = 2048
"""Pixels looked at, evenly spread over an image: enough for a median."""
CELSIUS_0_K = 273.15


def kelvin_from_celsius(celsius: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Temperatures in kelvin of those in degrees Celsius; NaN, no reading, stays NaN."""
    return (np.asarray(celsius, np.float64) + CELSIUS_0_K).astype(np.float32)


def check_time(time_s: float) -> None:
    """Refuse a time that is none in seconds.

    Raises:
        BadInputError: kind `bad_units`, with the likely unit.
    """
    # Written so that NaN is refused, too.
    if not abs(time_s) <= LATEST_S:
        raise BadInputError(
            "bad_units",
            f"time_s is {time_s:.0f}: milliseconds, microseconds or nanoseconds? It is UTC seconds since 1970",
        )


def check_ranges(camera: str, range_m: npt.NDArray[np.float32]) -> None:
    """Refuse ranges that no sensor measures.

    Raises:
        BadInputError: kind `bad_units`, with the numbers and the likely unit.
    """
    some = _some(range_m)
    # No median exceeds what no number does, and of nearly every image none does.
    if not (some > LONGEST_RANGE_M).any():
        return
    found = _median(some, least=0.0)
    if found is None or found <= LONGEST_RANGE_M:
        return
    known, beyond = int((range_m > 0).sum()), int((range_m > LONGEST_RANGE_M).sum())
    raise BadInputError(
        "bad_units",
        f"{beyond} of {known} ranges of {camera} lie beyond {LONGEST_RANGE_M:g} m, median {found:.0f}: millimetres? "
        "Ranges are metres: divide by 1000",
    )


def check_temperatures(camera: str, kelvin: npt.NDArray[np.float32]) -> None:
    """Refuse temperatures that no scene has.

    Raises:
        BadInputError: kind `bad_units`, with the numbers and the likely unit.
    """
    some = _some(kelvin)
    if not (some < COLDEST_K).any():
        return
    found = _median(some, least=-np.inf)
    if found is None or found >= COLDEST_K:
        return
    known, below = int(np.isfinite(kelvin).sum()), int((kelvin < COLDEST_K).sum())
    raise BadInputError(
        "bad_units",
        f"{below} of {known} temperatures of {camera} lie below {COLDEST_K:g} K, median {found:.1f}: degrees Celsius "
        "or Fahrenheit? Temperatures are kelvin: cairn.kelvin_from_celsius(image)",
    )


def _some(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Some of an image's pixels, evenly spread."""
    return image.ravel()[:: max(1, image.size // LOOK_AT)]


def _median(some: npt.NDArray[np.float32], *, least: float) -> float | None:
    """Median of the numbers that are finite and above `least`; None if there are none."""
    some = some[np.isfinite(some) & (some > least)]
    return float(np.median(some)) if len(some) else None
