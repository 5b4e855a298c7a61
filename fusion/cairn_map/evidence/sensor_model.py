"""What counts mean: log-odds and probability, computed when a map is read, never while it is merged.

OctoMap's defaults (Hornung et al. 2013). The model is part of the map's metadata and may be chosen anew at any
time, because the map keeps the counts.
"""

import math
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

Probability = Annotated[float, Field(gt=0, lt=1)]


class SensorModel(BaseModel, frozen=True):
    """Inverse sensor model: how much a hit and a miss say, and where certainty ends."""

    model_config = ConfigDict(extra="forbid")

    p_hit: Probability = 0.7
    p_miss: Probability = 0.4
    p_min: Probability = 0.12
    p_max: Probability = 0.97
    p_occupied: Probability = 0.5
    """A voxel is occupied above this."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not (self.p_miss < 0.5 < self.p_hit and self.p_min < self.p_occupied < self.p_max):
            raise ValueError("p_miss < 0.5 < p_hit and p_min < p_occupied < p_max must hold")
        return self

    def log_odds(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(N,) clamped log-odds of (N, 2) hits and misses; 0 for unknown voxels too, so ask `known` first."""
        raw = counts[:, 0] * log_odds(self.p_hit) + counts[:, 1] * log_odds(self.p_miss)
        return np.clip(raw, log_odds(self.p_min), log_odds(self.p_max))

    def probability(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """(N,) probability of (N, 2) hits and misses; NaN where both are zero: unknown is not p = 0.5."""
        p = 1 / (1 + np.exp(-self.log_odds(counts)))
        return np.where(known(counts), p, np.nan)

    def occupied(self, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(N,) whether the probability is above `p_occupied`; False for unknown voxels."""
        return known(counts) & (self.log_odds(counts) > log_odds(self.p_occupied))


def known(counts: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """(N,) whether a voxel was seen at all."""
    return np.asarray((counts != 0).any(axis=1))


def log_odds(p: float) -> float:
    """ln(p / (1 - p))."""
    return math.log(p / (1 - p))
