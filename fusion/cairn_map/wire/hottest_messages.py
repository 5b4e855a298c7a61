"""JSON message about the hottest voxels of a map."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.wire.messages import CursorText
from cairn_map.wire.voxel_messages import MeasuredOrNone

Triple = tuple[int, int, int]
HOTTEST_MAX = 1000
"""Most voxels in an answer."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class HotVoxel(_Model):
    """One occupied voxel, and its temperature."""

    voxel: Triple
    cell: Triple
    point_m: tuple[float, float, float]
    """Its centre, metres, map frame."""
    confirmed: bool
    """True if it was hit in two scans, or touches a surface; else it may be a ghost behind an edge."""
    probability: float
    hits: int
    misses: int
    mean: float
    """Mean of its samples in `unit`, apparent temperature."""
    unit: str
    celsius: float
    """`mean` in degrees Celsius, for people."""
    weight: int
    spread: float
    """Standard deviation of the samples."""
    sigma: float
    """Standard uncertainty of one sample, the spread and the camera's own."""
    measured_s: MeasuredOrNone = None
    """First instant of the epoch of the newest samples, UTC seconds since 1970; None, and not in JSON: unknown."""


class HottestAnswer(_Model):
    """Answer to `GET /maps/{map}/main/hottest`."""

    cursor: CursorText
    """State of the map of which this is true."""
    complete: bool
    """False if the search ended at its bounds: there may be hotter voxels, or more that are confirmed."""
    searched: Annotated[int, Field(ge=0)]
    """Cells whose voxels were looked at."""
    voxels: list[HotVoxel]
    """Confirmed voxels first, then the others, each hottest first."""
