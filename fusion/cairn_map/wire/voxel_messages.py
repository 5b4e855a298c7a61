"""What a server says about one voxel, as JSON: its sums read under the map's model, and the commits that saw it."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.evidence.channels import ChannelKind
from cairn_map.wire.messages import CursorText, IdText

Triple = tuple[int, int, int]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ChannelReading(_Model):
    """One channel's samples in one voxel."""

    name: str
    kind: ChannelKind
    unit: str
    weight: int
    """0: nothing was measured."""
    mean: list[float]
    """In the unit, one number or three; empty without weight."""
    sigma: float | None
    """Standard deviation of the samples, of temperatures only."""


class VoxelCommit(_Model):
    """What one commit adds to the voxel."""

    id: IdText
    hits: int
    misses: int
    captured_s: tuple[float, float] | None
    """UTC seconds since 1970 of its first and last scan."""


class VoxelAnswer(_Model):
    """Answer to `GET /maps/{map}/main/voxels/{voxel}`."""

    voxel: Triple
    cell: Triple
    centre_m: tuple[float, float, float]
    hits: int
    misses: int
    probability: float | None
    """That it is occupied; None: nobody saw it."""
    channels: list[ChannelReading]
    lm: Annotated[int, Field(ge=0)]
    """Log entry that last changed its cell."""
    cursor: CursorText
    """State that all of this is of."""
    commits: list[VoxelCommit]
    """Those that saw it, the newest first; of what is kept and was looked at."""
    more: bool
    """Older commits touched its cell, which were not looked at."""
    gone: bool
    """Of some older commits the evidence is not kept any more: only their sum is known."""
