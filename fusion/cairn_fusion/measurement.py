"""A measurement: the scans of one stop, summed, and what a commit must say about them."""

from dataclasses import dataclass, field

from cairn_calib.poses import quaternion_from_transform
from cairn_calib.rig import Rig
from cairn_fusion.integrate import Integrator, integrate_scan
from cairn_fusion.scan import Scan
from cairn_map.commit import ScanPose
from cairn_map.errors import BadInputError
from cairn_map.evidence import Evidence
from cairn_map.evidence_map import EvidenceMap
from cairn_map.grid import CellKey, Geometry

SCANS_MAX = 4096
"""Poses that a commit can state."""


@dataclass(slots=True)
class Measurement:
    """Scans added so far; `diff` is their evidence."""

    rig: Rig
    geometry: Geometry
    integrator: Integrator = field(default_factory=Integrator)
    poses: list[ScanPose] = field(default_factory=list)
    _sum: EvidenceMap = field(init=False)

    def __post_init__(self) -> None:
        self._sum = EvidenceMap(self.geometry)

    def __len__(self) -> int:
        return len(self.poses)

    def add(self, scan: Scan) -> dict[CellKey, Evidence]:
        """Add a scan; returns its own evidence.

        Raises:
            BadInputError: the scan does not fit the rig or the map, or the measurement is full; nothing was added.
        """
        if len(self) == SCANS_MAX:
            raise BadInputError("measurement_full", f"a measurement has at most {SCANS_MAX} scans; commit it first")
        evidence = integrate_scan(scan, self.rig, self.geometry, integrator=self.integrator)
        self._sum.merge(evidence)
        x, y, z = (float(v) for v in scan.T_map_rig[:3, 3])
        q = [float(v) for v in quaternion_from_transform(scan.T_map_rig)]
        self.poses.append(ScanPose(time_s=scan.time_s, t_map_rig=(x, y, z), q_map_rig=(q[0], q[1], q[2], q[3])))
        return evidence

    def diff(self) -> dict[CellKey, Evidence]:
        """The evidence of all scans, by cell."""
        return self._sum.packed()

    @property
    def captured_s(self) -> tuple[float, float] | None:
        """First and last scan's time, UTC seconds; None without scans."""
        times = [pose.time_s for pose in self.poses]
        return (min(times), max(times)) if times else None
