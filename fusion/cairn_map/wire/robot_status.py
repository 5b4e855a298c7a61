"""What a robot tells of itself between commits: where it is, what waits, how it is doing; only the last one counts."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.commits.commit import ScanPose

Mode = Literal["high-end", "low-end", "viewer"]
Count = Annotated[int, Field(ge=0, lt=1 << 53)]
Seconds = Annotated[float, Field(ge=0, le=1e11, allow_inf_nan=False)]
"""UTC since 1970; to the year 5138."""


class RobotStatus(BaseModel):
    """Body of `PUT /maps/{map}/branches/{branch}/status`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    time_s: Seconds
    """When it was so, by the robot's clock."""
    pose: ScanPose | None = None
    """Where its rig is in the map, and how surely."""
    mode: Mode | None = None
    waiting: Count = 0
    """Commits that the server has not acknowledged."""
    waiting_bytes: Count = 0
    battery: Annotated[float, Field(ge=0, le=1)] | None = None
    """Charge, 1 = full."""
    note: Annotated[str, Field(max_length=256)] = ""
    """Anything else, for people."""
