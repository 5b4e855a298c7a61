"""JSON message about one voxel: its sums read under the map's sensor model, and the commits that observed it."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.evidence.channels import ChannelKind
from cairn_map.wire.messages import CursorText, IdText

Triple = tuple[int, int, int]
MeasuredOrNone = Annotated[float | None, Field(exclude_if=lambda value: value is None)]
"""Time of samples; a client of the release before does not know it, nor any map that has it."""
ClassOrNone = Annotated[str | None, Field(exclude_if=lambda value: value is None)]
UnsureOrNone = Annotated[bool | None, Field(exclude_if=lambda value: value is None)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ChannelReading(_Model):
    """One channel's samples in one voxel."""

    name: str
    kind: ChannelKind
    unit: str
    weight: int
    """Sum of the samples' weights; 0: nothing was measured."""
    mean: list[float]
    """Mean in the unit, one number or three; empty without weight."""
    sigma: float | None
    """Standard uncertainty of one sample, the samples' spread and the camera's own; None but for temperatures."""
    measured_s: MeasuredOrNone = None
    """First instant of the epoch of the newest samples, UTC seconds since 1970; None, and not in JSON: unknown."""
    class_name: ClassOrNone = None
    """Class with the most votes, whose number is the mean; None, and not in JSON: no votes, or another kind."""
    unsure: UnsureOrNone = None
    """True if the class leads the next by less than two votes; None, and not in JSON, as `class_name`."""


class VoxelCommit(_Model):
    """Contribution of one commit to the voxel."""

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
    """Probability that it is occupied; None: unknown."""
    channels: list[ChannelReading]
    lm: Annotated[int, Field(ge=0)]
    """Log entry that last changed its cell."""
    cursor: CursorText
    """State of the map of which this is true."""
    commits: list[VoxelCommit]
    """Commits that observed it, the newest first, among those that are kept and were searched."""
    more: bool
    """True if older commits that touched its cell were not searched."""
    gone: bool
    """True if the evidence of some older commits is not kept any more: only their sum is known."""
