"""Channels: the quantities that a voxel can hold besides occupancy, as sums of fixed-point integers.

    kind          planes (one int64 sum each)            reading
    colour        red  green  blue            weight     mean sRGB = sum / weight
    intensity     sum                         weight     mean time-of-flight amplitude
    temperature   sum  square_sum             weight     mean and spread, kelvin
    scalar        sum                         weight     mean, in the channel's unit (dose, gas, ...)
    classes       votes of each named class   weight     class with the most votes; `weight` is all votes

A sample is `integer = round((value - zero) / step)`, never negative; each scan adds at most one sample
(of weight 1 or more) to a voxel. Occupancy (hits, misses) is in every map and needs no descriptor. Classes have votes
instead of samples: one of weight 1 to 4 for a voxel, camera and commit (decision 042). The last class, `other`, has no
plane: its votes are the weight less those of the others.
"""

import colorsys
import re
from enum import StrEnum
from functools import lru_cache
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from cairn_map.errors import BadInputError, first_error

SAMPLE_MAX = (1 << 20) - 1
"""Largest single sample: its square times 2^22 of them still fits an int64 sum."""


class ChannelKind(StrEnum):
    """Kind of a channel; it decides which sums are kept."""

    COLOUR = "colour"
    INTENSITY = "intensity"
    TEMPERATURE = "temperature"
    SCALAR = "scalar"
    CLASSES = "classes"


CODE_OF_KIND = {
    ChannelKind.COLOUR: 1,
    ChannelKind.INTENSITY: 2,
    ChannelKind.TEMPERATURE: 3,
    ChannelKind.SCALAR: 4,
    ChannelKind.CLASSES: 5,
}
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
"""Planes of the kinds that always have the same ones; a channel of classes has one for each named class."""

CLASSES_MAX = 64
"""Classes of a channel, `other` included."""
OTHER = "other"
"""The last class of each list: all that is of none of the others."""
VOTE_MAX = 4
"""Largest weight of one vote: that of a voxel, a camera and a commit."""
GOLDEN_TURN = 0.6180339887498949
"""Golden angle, in turns: multiples of it are spread over the circle evenly, however many there are."""
SHADES = (0.95, 0.75, 0.55)
"""Brightness of three classes in turn, 0 to 1."""
OTHER_GREY = 150
"""Red, green and blue of `other`, and of no class that has a hue."""
CLASS_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""All of a class's name."""
ClassName = Annotated[str, Field(pattern=f"^{CLASS_NAME.pattern}$")]


class Channel(BaseModel, frozen=True):
    """One quantity that a map's voxels can hold, and its fixed-point scale."""

    model_config = ConfigDict(extra="forbid")

    kind: ChannelKind
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
    unit: Annotated[str, Field(max_length=16)] = ""
    step: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    zero: Annotated[float, Field(allow_inf_nan=False), AfterValidator(lambda value: value + 0.0)] = 0.0
    """Value of the sample 0; never -0.0, which is the same number with another digest."""
    classes: Annotated[tuple[ClassName, ...], Field(max_length=CLASSES_MAX, exclude_if=lambda names: not names)] = ()
    """Names of the classes, in the order of their numbers, the last one `other`; of the kind `classes` alone. Other
    kinds are written without the field: digests are over what is written, and older readers refuse what is new."""

    @model_validator(mode="after")
    def _classes_are_a_list(self) -> Self:
        if self.kind is not ChannelKind.CLASSES:
            if self.classes:
                raise ValueError(f"a channel of kind {self.kind} has no classes")
            return self
        if len(self.classes) < 2 or self.classes[-1] != OTHER or len(set(self.classes)) != len(self.classes):
            raise ValueError(f"classes are 2 to {CLASSES_MAX} names that differ, the last one {OTHER!r}")
        if self.unit or self.step != 1.0 or self.zero != 0.0:
            raise ValueError("classes have no unit, the step 1 and the zero 0")
        return self

    @model_validator(mode="after")
    def _unit_is_short(self) -> Self:
        if len(self.unit.encode()) > 64:
            raise ValueError("unit must be at most 64 bytes of UTF-8")
        return self

    @property
    def value_count(self) -> int:
        """Numbers in one sample: 3 for colour, one for each named class, else 1."""
        return len(self.classes) - 1 if self.classes else len(VALUE_PLANES[self.kind])

    @property
    def planes(self) -> tuple[str, ...]:
        """Names of the sums kept, in the order of the sample matrix's columns; the weight is last."""
        votes = tuple(f"votes of {name}" for name in self.classes[:-1])
        return (*votes, "weight") if votes else PLANES[self.kind]

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
    """(channels, 3) planes of each channel, how many are sums of squares, 1 if they are votes for classes, else 0."""
    return _planes_and_squares(tuple((channel.kind, len(channel.planes)) for channel in channels))


@lru_cache(maxsize=16)
def _planes_and_squares(kinds: tuple[tuple[ChannelKind, int], ...]) -> npt.NDArray[np.int64]:
    rows = [(count, int(kind is ChannelKind.TEMPERATURE), int(kind is ChannelKind.CLASSES)) for kind, count in kinds]
    return np.array(rows, np.int64).reshape(-1, 3)


def classes_channel(names: tuple[str, ...], *, name: str = "classes") -> Channel:
    """A channel of named classes; `other` is put last where the names lack it.

    Raises:
        BadInputError: kind `bad_classes`: no name, more than 63 next to `other`, a name twice, `other` not last, or a
            name that is not a letter, then a-z, 0-9 and _, at most 32.
    """
    listed = names if names and names[-1] == OTHER else (*names, OTHER)
    try:
        return Channel(kind=ChannelKind.CLASSES, name=name, classes=listed)
    except ValidationError as exc:
        raise BadInputError("bad_classes", f"the classes cannot be: {first_error(exc)}") from exc


def class_colours(count: int) -> npt.NDArray[np.uint8]:
    """(count, 3) sRGB 0 to 255 by which the classes of a channel are drawn, the last one `other`, in grey.

    Neighbouring numbers are far apart in hue, and differ in brightness; a longer list keeps the colours of its first.
    """
    colours: npt.NDArray[np.uint8] = _hues()[:count].copy()
    colours[-1:] = OTHER_GREY
    return colours


@lru_cache(maxsize=1)
def _hues() -> npt.NDArray[np.uint8]:
    found = [colorsys.hsv_to_rgb(n * GOLDEN_TURN % 1.0, 0.8, SHADES[n % len(SHADES)]) for n in range(CLASSES_MAX)]
    colours: npt.NDArray[np.uint8] = np.rint(np.array(found) * 255).astype(np.uint8)
    return colours
