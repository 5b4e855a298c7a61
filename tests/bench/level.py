"""The yard as a level: bytes next to those of evidence at the same horizontal edge, and errors against the truth."""

from collections.abc import Iterator

from tests.fixtures.sim.ground_truth import ground_errors, mapped, scans_of_yard

from cairn_map.codec.cell_code import Profile, encode_cell
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import geometry_for
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]


def level_rows() -> Iterator[Row]:
    """One line each, of the robot with all cameras, and of the one with a lidar."""
    scene = load_scene("yard")
    for name in ("orpheus", "lidar"):
        plan = Plan(scene=scene, robot=ROBOTS[name], path="loop", truth="none", scale=0.25)
        scans = scans_of_yard(plan)
        level, evidence = mapped(plan, scans), mapped(plan, scans, geometry_for(voxel_edge_m=0.2))
        errors = ground_errors(scene, snapshot_of(level).elevation())
        yield (
            f"yard as a level, {name}, {len(scans)} scans: median error",
            f"{1e3 * errors.median_m:.1f}",
            f"mm, {errors.within_three:.1%} of {len(errors.error_m)} columns within 3 sigma",
        )
        for profile in Profile:
            sizes = [_bytes(each, profile) for each in (level, evidence)]
            yield f"  bytes, profile {profile}", f"{sizes[0] / 1e3:.0f}", f"kB, {sizes[0] / sizes[1]:.2f} x evidence"


def _bytes(total: EvidenceMap, profile: Profile) -> int:
    cells = total.packed().items()
    return sum(len(encode_cell(key, evidence, total.geometry, profile=profile).data) for key, evidence in cells)
