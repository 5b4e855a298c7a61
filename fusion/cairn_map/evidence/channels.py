"""Channels: the quantities that a voxel can hold besides occupancy, as sums of fixed-point integers.

    kind          planes (one int64 sum each)            reading
    colour        red  green  blue            weight     mean sRGB = sum / weight
    intensity     sum                         weight     mean time-of-flight amplitude
    temperature   sum  square_sum             weight     mean and spread, kelvin
    scalar        sum                         weight     mean, in the channel's unit (dose, gas, ...)

A sample is `integer = round((value - zero) / step)`, never negative; each scan adds at most one sample
(of weight 1 or more) to a voxel. Occupancy (hits, misses) is in every map and needs no descriptor.
"""

from enum import StrEnum
from functools import lru_cache
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from cairn_map.errors import BadInputError

SAMPLE_MAX = (1 << 20) - 1
"""Largest single sample: its square times 2^22 of them still fits an int64 sum."""


class ChannelKind(StrEnum):
    """Kind of a channel; it decides which sums are kept."""

    COLOUR = "colour"
    INTENSITY = "intensity"
    TEMPERATURE = "temperature"
    SCALAR = "scalar"


CODE_OF_KIND = {ChannelKind.COLOUR: 1, ChannelKind.INTENSITY: 2, ChannelKind.TEMPERATURE: 3, ChannelKind.SCALAR: 4}
"""Byte that stands for the kind in a cell's header (FORMAT.md)."""

VALUE_PLANES = {
    ChannelKind.COLOUR: ("red", "green", "blue"),
    ChannelKind.INTENSITY: ("sum",),
    ChannelKind.TEMPERATURE: ("sum",),
    ChannelKind.SCALAR: ("sum",),
}
PLANES = {
    kind: (*planes, *(("square_sum",) if kind is ChannelKind.TEMPERATURE else ()), "weight")
    for kind, planes in VALUE_PLANES.items()
}


class Channel(BaseModel, frozen=True):
    """One quantity that a map's voxels can hold, and its fixed-point scale."""

    model_config = ConfigDict(extra="forbid")

    kind: ChannelKind
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
    unit: Annotated[str, Field(max_length=16)] = ""
    step: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    zero: Annotated[float, Field(allow_inf_nan=False), AfterValidator(lambda value: value + 0.0)] = 0.0
    """Value of the sample 0; never -0.0, which is the same number with another digest."""

    @model_validator(mode="after")
    def _unit_is_short(self) -> Self:
        if len(self.unit.encode()) > 64:
            raise ValueError("unit must be at most 64 bytes of UTF-8")
        return self

    @property
    def value_count(self) -> int:
        """Numbers in one sample: 3 for colour, else 1."""
        return len(VALUE_PLANES[self.kind])

    @property
    def planes(self) -> tuple[str, ...]:
        """Names of the sums kept, in the order of the sample matrix's columns; the weight is last."""
        return PLANES[self.kind]

    def quantise(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
        """Samples as integers, rounded half to even.

        Raises:
            BadInputError: a value is not finite, below the channel's zero or above its range.
        """
        samples = np.rint((np.asarray(values, dtype=np.float64) - self.zero) / self.step)
        if not (np.isfinite(samples).all() and (samples >= 0).all() and (samples <= SAMPLE_MAX).all()):
            top = self.zero + SAMPLE_MAX * self.step
            raise BadInputError(
                "sample_range", f"channel {self.name} takes values from {self.zero} to {top:.6g} {self.unit}"
            )
        return samples.astype(np.int64)


COLOUR = Channel(kind=ChannelKind.COLOUR, name="colour", unit="sRGB")
INTENSITY = Channel(kind=ChannelKind.INTENSITY, name="intensity", unit="counts")
TEMPERATURE = Channel(kind=ChannelKind.TEMPERATURE, name="temperature", unit="K", step=0.05)
"""0.05 K is the resolution of the paper's thermal cameras."""

HEIGHT_OFFSET = Channel(kind=ChannelKind.SCALAR, name="height", unit="mm", step=5.0)
"""Height of a surface above its voxel's lower face, in level layers; a sample is a vote of one scan.
Its step of 5 mm is a tenth of a usual bin, and a layer has a tenth fewer bytes with it than with 1 mm."""

STANDARD_CHANNELS = (COLOUR, INTENSITY, TEMPERATURE)


def planes_and_squares(channels: tuple[Channel, ...]) -> npt.NDArray[np.int64]:
    """(channels, 2) planes of each channel, and the number of those that are sums of squares: the form for kernels."""
    return _planes_and_squares(tuple(channel.kind for channel in channels))


@lru_cache(maxsize=16)
def _planes_and_squares(kinds: tuple[ChannelKind, ...]) -> npt.NDArray[np.int64]:
    rows = [(len(PLANES[kind]), PLANES[kind].count("square_sum")) for kind in kinds]
    return np.array(rows, np.int64).reshape(-1, 2)
