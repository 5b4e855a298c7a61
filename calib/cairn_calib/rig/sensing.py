"""How far a range camera can be trusted: its noise by range, when its pixels are full, what its silence means.

    "sensing": {"sigma_m": [[0, 0.005], [3, 0.01], [10, 0.03]], "saturated_amplitude": 65535, "no_return_clears_m": 30}

All of it is optional; what is not said is taken from what such a sensor usually does (`TIME_OF_FLIGHT`, `LIDAR`).
"""

from itertools import pairwise
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

Node = tuple[
    Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)],
    Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)],
]


class RangeSensing(BaseModel):
    """What a range camera's manufacturer, or a measurement, says of it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sigma_m: Annotated[tuple[Node, ...], Field(min_length=1, max_length=64)] | None = None
    """Range and standard deviation there, metres, by rising range: linear between two, constant beyond the ends."""
    saturated_amplitude: Annotated[int, Field(ge=1, le=65535)] | None = None
    """From this amplitude on too much light returned, and the range is worth nothing."""
    no_return_clears_m: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    """A beam to which nothing comes back has met nothing so far. Only of a sensor whose every surface within this
    range returns something: to a time-of-flight camera black, tilted or mirroring things return nothing."""

    @model_validator(mode="after")
    def _nodes_rise(self) -> Self:
        ranges_m = [range_m for range_m, _ in self.sigma_m or ()]
        if any(b <= a for a, b in pairwise(ranges_m)):
            raise ValueError(f"the ranges of sigma_m must rise, got {ranges_m}")
        return self

    def sigma_at(self, range_m: npt.NDArray[np.floating], *, usual: "RangeSensing") -> npt.NDArray[np.float64]:
        """(...) standard deviation at ranges, metres; by `usual` where this one does not say; NaN for NaN."""
        nodes = np.array(self.sigma_m or usual.sigma_m or ((0.0, 0.0),), dtype=np.float64)
        return np.asarray(np.interp(range_m, nodes[:, 0], nodes[:, 1]))


TIME_OF_FLIGHT = RangeSensing(sigma_m=((0.0, 0.005), (3.0, 0.01), (6.0, 0.03)))
"""5 mm at best, 1 cm at 3 m from a grey surface, growing with the square of the range: MESA SR4000 and its kind."""
LIDAR = RangeSensing(sigma_m=((0.0, 0.02),))
"""2 cm at every range, as data sheets of spinning lidars say."""
