"""What robots see of the simulated building: real diffs of single scans, and one map of all of them."""

from dataclasses import dataclass, replace

from tests.bench.pushing import Bodies, Diff

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import EXPERIMENT
from cairn_sim.scene.scene_file import load_scene

SCANS = (3, 2)
"""Pans and tilts at each stop: enough that the 54 stops see all 56 cells of the building."""
COLOUR_SCALE = 0.25


@dataclass(frozen=True, slots=True)
class Survey:
    """The scans of one path."""

    geometry: Geometry
    scans: list[Diff]
    stops: list[Diff]
    """The same, summed up by stop."""

    def scan_bodies(self) -> Bodies:
        """Commits of one scan each."""
        return Bodies(self.scans, self.geometry)

    def stop_bodies(self) -> Bodies:
        """Commits of one stop each, with the scans that its evidence takes."""
        return Bodies(self.stops, self.geometry, scans=SCANS[0] * SCANS[1])


def survey(*, robot: str, voxel_m: float, stops: int | None = None) -> Survey:
    """What a kind of robot sees along the building's path; None: at all stops."""
    geometry = geometry_for(voxel_edge_m=voxel_m)
    plan = Plan(
        scene=load_scene("building"),
        robot=replace(ROBOTS[robot], scans=SCANS),
        path=EXPERIMENT,
        scale=COLOUR_SCALE,
        truth="none",
        last_stop=stops,
    )
    rig = plan.robot.rig_of(plan.scale)
    scans: list[Diff] = []
    by_stop: dict[int, EvidenceMap] = {}
    for shot, scan, _ in scans_of(plan, shots_of(plan), rig):
        diff = integrate_scans([scan], rig, geometry, integrator=Integrator(), threads=1)
        if diff:
            scans.append(diff)
            by_stop.setdefault(shot.stop, EvidenceMap(geometry)).merge(diff)
    return Survey(geometry, scans, [dict(total.packed()) for total in by_stop.values()])
