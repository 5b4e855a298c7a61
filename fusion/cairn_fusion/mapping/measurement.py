"""Measurement: the sum of the scans of one stop, and the facts about them that a commit states."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, check_transform, quaternions_from_transforms
from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.beam_returns import ReturnCounts
from cairn_fusion.mapping.integrate import Integration, Integrator
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.scan_units import check_time
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry

SCANS_MAX = 4096
"""Poses that a commit can state."""


@dataclass(slots=True)
class Measurement:
    """Sum of the scans added so far; `diff` is their evidence."""

    rig: Rig
    geometry: Geometry
    integrator: Integrator = field(default_factory=Integrator)
    _integration: Integration = field(init=False)
    _poses: list[ScanPose] = field(init=False, default_factory=list)
    _newest: list[tuple[float, Transform]] = field(init=False, default_factory=list)
    """Times and poses of the scans that are not in `_poses` yet."""

    def __post_init__(self) -> None:
        self._integration = Integration(self.rig, self.geometry, self.integrator)

    def __len__(self) -> int:
        return len(self._poses) + len(self._newest)

    @property
    def poses(self) -> list[ScanPose]:
        """Poses of the rig for the scans added so far, as a commit states them."""
        # Many at once: one by one they take a tenth of what integrating a small scan does.
        self._poses += scan_poses(self._newest)
        self._newest = []
        return self._poses

    def add(self, scan: Scan) -> None:
        """Add a scan.

        Raises:
            BadInputError: the scan does not fit the rig or the map, or the measurement is full; nothing was added.
        """
        self._check_room()
        self._integration.add(scan)
        self._note_pose(scan.time_s, scan.T_map_rig)

    def add_points(
        self,
        points: npt.NDArray[np.floating],
        T_map_sensor: Transform,
        *,
        T_map_rig: Transform,
        time_s: float,
        range_camera: str | None = None,
        T_map_body: Transform | None = None,
    ) -> None:
        """Add a sweep of unordered points as `Integration.add_points`; the commit states the rig's pose.

        A body without a pose of its own is in the rig's frame.

        Raises:
            BadInputError: not (N, 3) points, a pose or time that is none, or the measurement is full; nothing was
                added.
        """
        self._check_room()
        check_time(time_s)
        T_map_rig = check_transform(T_map_rig, name="T_map_rig")  # a copy: the caller may write over its own
        body = T_map_rig if T_map_body is None else T_map_body
        self._integration.add_points(points, T_map_sensor, range_camera=range_camera, T_map_body=body)
        self._note_pose(time_s, T_map_rig)

    def _check_room(self) -> None:
        if len(self) == SCANS_MAX:
            raise BadInputError("measurement_full", f"a measurement has at most {SCANS_MAX} scans; commit it first")

    def _note_pose(self, time_s: float, T_map_rig: Transform) -> None:
        self._newest.append((time_s, T_map_rig))

    def diff(self) -> dict[CellKey, Evidence]:
        """The evidence of all scans, by cell."""
        return self._integration.diff()

    @property
    def counts(self) -> ReturnCounts:
        """Count of the pixels of all scans, by what became of them."""
        return self._integration.counts

    @property
    def captured_s(self) -> tuple[float, float] | None:
        """First and last scan's time, UTC seconds; None without scans."""
        times = [pose.time_s for pose in self.poses]
        return (min(times), max(times)) if times else None


def scan_pose(time_s: float, T_map_rig: Transform) -> ScanPose:
    """Pose of the rig for one scan, as a commit states it."""
    return scan_poses([(time_s, T_map_rig)])[0]


def scan_poses(scans: Sequence[tuple[float, Transform]]) -> list[ScanPose]:
    """Poses of the rig for scans of these times, as a commit states them."""
    if not scans:
        return []
    T_map_rig = np.array([T for _, T in scans])
    stated = zip(T_map_rig[:, :3, 3].tolist(), quaternions_from_transforms(T_map_rig).tolist(), strict=True)
    return [
        ScanPose(time_s=time_s, t_map_rig=(t[0], t[1], t[2]), q_map_rig=(q[0], q[1], q[2], q[3]))
        for (time_s, _), (t, q) in zip(scans, stated, strict=True)
    ]
