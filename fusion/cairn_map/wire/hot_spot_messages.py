"""JSON message about the hot spots of a map."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.wire.messages import CursorText, IdText
from cairn_map.wire.voxel_messages import MeasuredOrNone

Triple = tuple[int, int, int]
Place = tuple[float, float, float]
SPOTS_MAX = 1000
"""Most hot spots in an answer."""
VOXELS_MAX = 1 << 20
"""Greatest least number of voxels that may be asked for."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class HotSpotEntry(_Model):
    """Connected voxels above a threshold, with what is known of the hottest one."""

    voxel: Triple
    """Number of the hottest voxel."""
    point_m: Place
    """Its centre, metres, map frame."""
    kelvin: float
    """Mean of its samples, apparent temperature."""
    celsius: float
    """The same in degrees Celsius, for people."""
    sigma: float
    """Standard uncertainty of one of its samples, the spread and the camera's own; kelvin."""
    weight: int
    hits: int
    misses: int
    confirmed: bool
    """True if one of its voxels was hit in two scans, or it is a surface; else it may be a ghost behind an edge."""
    voxels: int
    """Number of its voxels."""
    low_m: Place
    """Lowest corner of the box around them, metres, map frame."""
    high_m: Place
    over_floor_m: float | None
    """Height of the hottest voxel over the floor below it; None: no floor is known there."""
    measured_s: MeasuredOrNone = None
    """First instant of the epoch of the newest samples, UTC seconds since 1970; None, and not in JSON: unknown."""
    commit: IdText | None = None
    """Newest commit that measured the hottest voxel; None: not known, or not looked for in the time that there is."""
    captured_s: tuple[float, float] | None = None
    """UTC seconds since 1970 of that commit's first and last scan."""


class HotSpotsAnswer(_Model):
    """Answer to `GET /maps/{map}/main/hotspots`."""

    cursor: CursorText
    """State of the map of which this is true."""
    over_k: float
    """Threshold, kelvin."""
    complete: bool
    """False if the search ended at its bounds: there may be more spots, or these may be parts of larger ones."""
    read: Annotated[int, Field(ge=0)]
    """Cells that were read for this answer; the others were known since an earlier one."""
    total: Annotated[int, Field(ge=0)]
    """Number of the spots, of which this answer may have the first ones alone."""
    spots: list[HotSpotEntry]
    """Confirmed ones first, then the others, each hottest first."""
