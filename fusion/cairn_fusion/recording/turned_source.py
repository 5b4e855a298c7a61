"""Source of scans in another frame of the map: its world turned so that z points up, or moved by a known transform.

    --up -y             the poses' frame has y down: -y becomes the map's z
    --T-map-world FILE  T_map_world of the poses' frame

Ceilings, heights and horizontal slices are of the map's z axis; a world that lies on its back makes them useless.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.pose_files import body_sensor_of
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_bytes import move_scan
from cairn_map.errors import BadInputError

AXES_UP = ("x", "-x", "y", "-y", "z", "-z")
"""Axes of the poses' frame that may point up."""


@dataclass(frozen=True, slots=True)
class TurnedSource:
    """Scans of a source with `T_map_world` before their poses; see `recording.ScanSource`."""

    source: ScanSource
    T_map_world: Transform
    text: str
    """The transform in words, for people and for commits."""

    def __len__(self) -> int:
        return len(self.source)

    def __iter__(self) -> Iterator[Scan]:
        return map(self.scan, range(len(self)))

    @property
    def name(self) -> str:
        """Name of the source."""
        return self.source.name

    @property
    def rig(self) -> Rig:
        """The cameras of every scan."""
        return self.source.rig

    @property
    def rounding(self) -> PoseRounding:
        """Poses of the source that were not quite rotations."""
        return self.source.rounding

    @property
    def pose_notes(self) -> Sequence[str]:
        """Sentences about the poses, and the one about this transform."""
        return (*self.source.pose_notes, self.text)

    @property
    def has_times(self) -> bool:
        """False if the scans' times are made up."""
        return self.source.has_times

    def measurements(self) -> Sequence[range]:
        """The scan indices of each measurement."""
        return self.source.measurements()

    def place(self, index: int, /) -> tuple[float, Transform]:
        """Time and `T_map_rig` of the scan of an index, in the map's frame."""
        time_s, T_world_rig = self.source.place(index)
        return time_s, self.T_map_world @ T_world_rig

    def scan(self, index: int, /) -> Scan:
        """The scan of an index, 0 .. len - 1, in the map's frame."""
        scan = self.source.scan(index)
        return move_scan(scan, self.T_map_world @ scan.T_map_rig)


def turned_source(source: ScanSource, *, up: str | None = None, T_map_world: Path | None = None) -> ScanSource:
    """A source in the frame of the map; arguments and errors are those of `map_from_world`."""
    turn = map_from_world(up=up, T_map_world=T_map_world)
    return source if turn is None else TurnedSource(source, *turn)


def map_from_world(*, up: str | None = None, T_map_world: Path | None = None) -> tuple[Transform, str] | None:
    """`T_map_world` from the frame of poses to that of the map, and the same in words; None: they are one frame.

    Args:
        up: axis of the poses' frame that points up, of `AXES_UP`; None or z: it is z.
        T_map_world: file with the transform from that frame to the map's, 16 or 12 numbers.

    Raises:
        BadInputError: both are given, or the file holds no transform.
    """
    if up is not None and T_map_world is not None:
        raise BadInputError("bad_option", "--up and --T-map-world are two statements of the same; give one of them")
    if T_map_world is not None:
        return body_sensor_of(T_map_world), f"T_map_world of {T_map_world.name} moves all poses"
    if up in (None, "z"):
        return None
    return rotation_up(up or "z"), f"up is {up} of the poses' frame: it becomes the map's z"


def rotation_up(up: str) -> Transform:
    """(4, 4) the rotation of a world in which an axis points up to one in which z does; entries are 0, 1 and -1.

    The axis that comes next in the order x, y, z, x becomes the map's x axis.
    """
    axis, sign = "xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0
    R = np.zeros((3, 3))
    R[2, axis] = sign
    R[0, (axis + 1) % 3] = 1.0
    # The last axis makes the system right-handed.
    R[1] = np.cross(R[2], R[0])
    T = np.eye(4)
    T[:3, :3] = R
    return T
