"""Log-odds of one cell's bricks: the part of a reading that does not follow from its sums.

    steps [b, 512]   16 bits    rows as those of `BrickCounts.pool`

    log-odds = zero + 0.001 steps, clamped            zero: above it a voxel is occupied

So a voxel is occupied if and only if its steps are above 0, whatever was rounded, and the bounds of the sensor model
are exact: most voxels of a map are at one of them.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel, log_odds

Steps = npt.NDArray[np.int16]

STEPS_MAX = (1 << 15) - 1
"""Most steps to either side of the threshold: a probability of 1e-14 from one half, of the standard model."""


class BrickOdds:
    """Log-odds of the voxels of a cell's bricks, read under one sensor model."""

    __slots__ = ("model", "steps")

    def __init__(self, model: SensorModel, bricks: int) -> None:
        """Make the log-odds of a number of bricks, all at the threshold."""
        self.model = model
        self.steps: Steps = np.zeros((bricks, 512), np.int16)

    def grow(self, bricks: int) -> None:
        """Have this many bricks, the new ones at the threshold."""
        if bricks > len(self.steps):
            self.steps.resize((bricks, 512), refcheck=False)

    def values(self) -> Floats:
        """(B, 512) clamped log-odds; of any value where a voxel is unknown."""
        return odds_of_steps(self.steps, self.model)

    def copy(self) -> "BrickOdds":
        """The same log-odds in an array of their own."""
        copied = BrickOdds.__new__(BrickOdds)
        copied.model, copied.steps = self.model, self.steps.copy()
        return copied

    def check_model(self, model: SensorModel) -> None:
        """Refuse to be read under another sensor model than that of the reading.

        Raises:
            ValueError: it is another.
        """
        if model != self.model:
            raise ValueError(f"a reading under {self.model!r} cannot be read under {model!r}")


def steps_of_odds(odds: Floats, model: SensorModel) -> Steps:
    """Clamped log-odds in steps above the threshold; the sign is exact, and so are the model's bounds."""
    zero = log_odds(model.p_occupied)
    steps = (odds - zero) / LOG_ODDS_STEP
    # To the nearest; what is at a bound, to the step beyond it, from where clamping brings it back.
    rounded = np.rint(steps)
    rounded = np.where(odds <= log_odds(model.p_min), np.floor(steps), rounded)
    rounded = np.where(odds >= log_odds(model.p_max), np.ceil(steps), rounded)
    # Above the threshold or not.
    rounded = np.where(odds > zero, np.maximum(rounded, 1), np.minimum(rounded, 0))
    return np.clip(rounded, -STEPS_MAX, STEPS_MAX).astype(np.int16)


def odds_of_steps(steps: Steps, model: SensorModel) -> Floats:
    """Log-odds of steps; the mirror of `steps_of_odds`, to half a step."""
    odds = log_odds(model.p_occupied) + steps * LOG_ODDS_STEP
    return np.asarray(np.clip(odds, log_odds(model.p_min), log_odds(model.p_max)), np.float64)
