"""Body of the robot, as boxes: returns of a range camera from it are no part of the map.

    "body": {"frame": "robot", "boxes": [{"name": "mast", "low_m": [-0.1, -0.1, 0.3], "high_m": [0.1, 0.1, 1.2]}]}

The boxes lie along the axes of the body's frame, whose pose is the scan's `T_map_body`; without it that of the rig is
taken, as for a head that is fixed on the body. State boxes larger than the body by the noise of the range camera.
"""

from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_map.arrays import Flags, Floats

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Place = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
Corner = tuple[Place, Place, Place]
PARALLEL = 1e-12
"""Share of a direction below which it does not leave a slab; such a beam gets nowhere in 100 m."""


class BodyBox(BaseModel):
    """One box, by its lowest and highest corner in the body's frame, metres."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Name
    low_m: Corner
    high_m: Corner

    @model_validator(mode="after")
    def _has_volume(self) -> Self:
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(f"low_m must be below high_m on every axis, got {self.low_m} and {self.high_m}")
        return self


class Body(BaseModel):
    """The boxes of one body, in a frame that has a name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frame: Name
    boxes: Annotated[tuple[BodyBox, ...], Field(min_length=1, max_length=64)]

    def holds(self, points: Floats) -> Flags:
        """(...) which of (..., 3) points of the body's frame lie in a box, its faces included; False for NaN."""
        held = np.zeros(points.shape[:-1], bool)
        for box in self.boxes:
            held |= ((points >= np.array(box.low_m)) & (points <= np.array(box.high_m))).all(axis=-1)
        return held

    def stops(self, origin: Floats, directions: Floats, reach_m: float) -> Flags:
        """(...) which beams from one (3,) origin, along (..., 3) unit directions, meet a box within a reach.

        All in the body's frame; False for NaN. A beam that starts in a box does not leave it unseen: it meets it.
        """
        met = np.zeros(directions.shape[:-1], bool)
        safe = np.where(np.abs(directions) < PARALLEL, PARALLEL, directions)
        for box in self.boxes:
            one, other = (np.array(box.low_m) - origin) / safe, (np.array(box.high_m) - origin) / safe
            entry_m = np.minimum(one, other).max(axis=-1)
            exit_m = np.maximum(one, other).min(axis=-1)
            met |= (np.maximum(entry_m, 0.0) <= exit_m) & (entry_m <= reach_m)
        return met
