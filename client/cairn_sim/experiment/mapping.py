"""Maps of one drive at several resolutions: each measurement is taken once, and becomes a commit on every map.

A robot's commits are numbered and chained as a real robot's are; the map is their sum, so its bytes do not
depend on the order of the robots, and a test adds them up again.
"""

import hashlib
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cairn_calib.rig.rig import Rig
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.mapping.measurement import scan_pose
from cairn_fusion.recording.scan import Scan
from cairn_map.commits.commit import Commit, CommitMeta, make_commit
from cairn_map.commits.ids import Author, CommitId, Incarnation, robot_name
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_sim.experiment.figures import MeasurementFigures
from cairn_sim.experiment.robots import ExperimentRobot


@dataclass(slots=True)
class GrowingMap:
    """One map that grows, and the figures of each commit on it."""

    geometry: Geometry
    integrator: Integrator = field(default_factory=Integrator)
    measurements: list[MeasurementFigures] = field(default_factory=list)
    map: EvidenceMap = field(init=False)
    _last: dict[str, Commit] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.map = EvidenceMap(self.geometry)

    def add(self, robot: ExperimentRobot, stop: int, scans: Sequence[Scan], *, threads: int) -> Commit:
        """One stop's scans as a commit; the map holds it afterwards.

        Raises:
            BadInputError: the scans do not fit the rig, or their evidence is more than one commit may hold.
        """
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        diff = integrate_scans(scans, robot.rig, self.geometry, integrator=self.integrator, threads=threads)
        integrated_s, integrated_cpu_s = time.perf_counter(), time.process_time()
        commit = make_commit(self._meta(robot, scans), diff, self.geometry)
        committed_s = time.perf_counter()
        self.map.merge(diff)
        merged_s = time.perf_counter()
        self._last[robot.name] = commit
        self.measurements.append(
            MeasurementFigures(
                robot=robot.name,
                stop=stop,
                scans=len(scans),
                rays=sum(self._rays(scan, robot.rig) for scan in scans),
                integrate_s=integrated_s - start_s,
                integrate_cpu_s=integrated_cpu_s - start_cpu_s,
                commit_s=committed_s - integrated_s,
                merge_s=merged_s - committed_s,
                commit_bytes=len(commit.data),
                cells=len(commit.cells),
                voxels=sum(len(evidence) for evidence in diff.values()),
            )
        )
        return commit

    def _meta(self, robot: ExperimentRobot, scans: Sequence[Scan]) -> CommitMeta:
        before = self._last.get(robot.name)
        times_s = [scan.time_s for scan in scans]
        # Not random, as a robot's is: the same run makes the same commits.
        incarnation = Incarnation(hashlib.sha256(robot.name.encode()).hexdigest()[:16])
        return CommitMeta(
            id=str(CommitId(Author(robot_name(robot.name), incarnation), before.id.n + 1 if before else 0)),
            geometry=self.geometry.digest().hex(),
            parent=before.sha.hex() if before else None,
            captured_s=(min(times_s), max(times_s)),
            scans=tuple(scan_pose(scan.time_s, scan.T_map_rig) for scan in scans),
            sensors=tuple(robot.rig.cameras),
            rig=robot.rig.digest(),
            integrator=str(self.integrator),
        )

    def _rays(self, scan: Scan, rig: Rig) -> int:
        near_m, far_m = self.integrator.min_range_m, self.integrator.reach_m(rig[scan.range_camera])
        return int(np.count_nonzero((scan.range_m >= near_m) & (scan.range_m <= far_m)))


def map_all(
    robots: Iterable[ExperimentRobot], maps: Sequence[GrowingMap], *, threads: int
) -> Iterator[tuple[str, int, float]]:
    """Drive all robots, one after the other; yields robot, stop and the seconds that taking its scans took.

    No more than one measurement's scans are in memory, and one measurement's evidence.
    """
    for robot in robots:
        for stop in range(len(robot.stops)):
            start_s = time.perf_counter()
            scans = robot.scans_at(stop)
            taken_s = time.perf_counter() - start_s
            for growing in maps:
                if not growing.measurements:
                    # Once for the caches, on a map of its own: else the first measurement looks slow.
                    GrowingMap(growing.geometry, growing.integrator).add(robot, stop, scans[:1], threads=threads)
                growing.add(robot, stop, scans, threads=threads)
            yield robot.name, stop, taken_s
