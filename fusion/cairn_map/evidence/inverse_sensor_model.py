"""The inverse sensor model: from a voxel's counts of hits and misses to log-odds and probability.

OctoMap's model with OctoMap's defaults (Hornung et al., "OctoMap", Autonomous Robots 2013):

    l(p)  =  ln(p / (1 - p))                                            log-odds, Eq. 3
    L(n)  =  sum over all measurements z of L(n | z)                    Eq. 2, with a prior of 0.5
          =  hits * l(p_hit) + misses * l(p_miss)
    L     =  clamp(L(n), l(p_min), l(p_max))                            Eq. 4
    P     =  1 / (1 + exp(-L))

The one difference to OctoMap: it clamps after each measurement, so that the order of measurements matters. Here the map
keeps the counts, which commute; the model is applied when the map is read, never while it is merged. So the model is
part of the map's metadata and may be changed at any time.
"""

import math
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

LOG_ODDS_STEP = 0.001
"""Step in which log-odds are rounded where they are kept as 16 bits."""
Probability = Annotated[float, Field(gt=0, lt=1)]


class SensorModel(BaseModel, frozen=True):
    """Inverse sensor model: the evidence of one hit and one miss, the bounds of certainty, and the threshold."""

    model_config = ConfigDict(extra="forbid")

    p_hit: Probability = 0.7
    """P(n | z) of a voxel in which one beam ended; above 0.5."""
    p_miss: Probability = 0.4
    """P(n | z) of a voxel through which one beam passed; below 0.5."""
    p_min: Probability = 0.12
    """Lower clamping bound of the probability."""
    p_max: Probability = 0.97
    """Upper clamping bound of the probability."""
    p_occupied: Probability = 0.5
    """Probability above which a voxel is occupied."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not (self.p_miss < 0.5 < self.p_hit and self.p_min < self.p_occupied < self.p_max):
            raise ValueError("p_miss < 0.5 < p_hit and p_min < p_occupied < p_max must hold")
        return self

    def log_odds(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(N,) clamped log-odds of (N, 2) hits and misses; 0 for unknown voxels too, so ask `known` first."""
        # Eq. 2, the sum of all measurements; then Eq. 4, the clamp.
        raw = counts[:, 0] * log_odds(self.p_hit) + counts[:, 1] * log_odds(self.p_miss)
        return np.clip(raw, log_odds(self.p_min), log_odds(self.p_max))

    def probability(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(N,) probability of (N, 2) hits and misses; NaN where both are zero: unknown is not p = 0.5."""
        p = 1 / (1 + np.exp(-self.log_odds(counts)))
        return np.where(known(counts), p, np.nan)

    def occupied(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(N,) True where the probability is above `p_occupied`; False for unknown voxels."""
        return known(counts) & (self.log_odds(counts) > log_odds(self.p_occupied))


def known(counts: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """(N,) True where a voxel has any hit or miss."""
    return np.asarray((counts != 0).any(axis=1))


def log_odds(p: float) -> float:
    """Log-odds of a probability: l = ln(p / (1 - p))."""
    # Eq. 3
    return math.log(p / (1 - p))
