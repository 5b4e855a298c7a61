"""JSON message about the values of a whole map: how high its surfaces lie, and how warm they are."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.wire.messages import CursorText

BINS_MAX = 1024
"""Most bins of a histogram: its step doubles until they are enough."""
Count = Annotated[int, Field(ge=0)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Spread(_Model):
    """Values of the occupied voxels of a map, as a histogram."""

    unit: str
    least: float
    most: float
    begin: float
    """Lower edge of the first bin."""
    step: Annotated[float, Field(gt=0)]
    """Width of each bin."""
    counts: Annotated[list[Count], Field(min_length=1, max_length=BINS_MAX)]
    """Voxels in each bin; the first and the last bin have some."""


class SpreadAnswer(_Model):
    """Answer to `GET /maps/{map}/main/spread`."""

    cursor: CursorText
    """State of the map of which this is true."""
    complete: bool
    """False if cells are left out that take longer than one request may: asking again goes on with them."""
    cells: Count
    """Cells whose voxels are counted."""
    height: Spread | None
    """Heights of voxels' centres, metres, map frame; None: no voxel is occupied."""
    temperature: Spread | None
    """Means of the map's first temperature channel; None: no occupied voxel has samples of one."""
