"""JSON message about what changed in a map between two times."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.wire.messages import CursorText

Triple = tuple[int, int, int]
Place = tuple[float, float, float]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CellVoxels(_Model):
    """Voxels of one cell that changed in the same way."""

    cell: Triple
    centres_m: list[Place]
    """Centres of the voxels, metres, map frame."""


class ChangeCounts(_Model):
    """Counts of voxels by the way in which they changed."""

    appeared: Annotated[int, Field(ge=0)]
    gone: Annotated[int, Field(ge=0)]
    moved: Annotated[int, Field(ge=0)]
    warmer: Annotated[int, Field(ge=0)]
    colder: Annotated[int, Field(ge=0)]


class ChangesAnswer(_Model):
    """Answer to `GET /maps/{map}/main/changes`; the ways are those of `cairn_map.epochs.changes`."""

    cursor: CursorText
    """State of the map of which this is true."""
    since_s: float
    """End of the time before, UTC seconds since 1970: that of its epoch, in a map with epochs."""
    until_s: float | None
    """End of the time after; None: now."""
    counts: ChangeCounts
    appeared: list[CellVoxels]
    """Voxels that are occupied now, and were not before."""
    gone: list[CellVoxels]
    """Voxels that were occupied before, and are not now."""
    moved: list[CellVoxels]
    """Either of the two next to a surface that was or is there: mostly a pose that is off by a voxel."""
    warmer: list[CellVoxels]
    colder: list[CellVoxels]


class RetractChangeCounts(_Model):
    """Counts of voxels by the way in which a retract would change them."""

    gone: Annotated[int, Field(ge=0)]
    appeared: Annotated[int, Field(ge=0)]
    warmer: Annotated[int, Field(ge=0)]
    colder: Annotated[int, Field(ge=0)]
    otherwise: Annotated[int, Field(ge=0)]


class RetractChanges(_Model):
    """Answer to `POST /maps/{map}/main/changes`: the voxels that a retract would change, as views show them."""

    cursor: CursorText
    """State of the map of which this is true."""
    commits: Annotated[int, Field(ge=0)]
    """Count of the commits whose evidence would go."""
    counts: RetractChangeCounts
    gone: list[CellVoxels]
    """Occupied now, and not without these commits."""
    appeared: list[CellVoxels]
    """Occupied without these commits, and not now."""
    warmer: list[CellVoxels]
    colder: list[CellVoxels]
    otherwise: list[CellVoxels]
    """Voxels of another probability or colour, or with a temperature in one of the two alone."""
