"""The yard as a level: bytes and time next to those of evidence at the same horizontal edge, and errors of its heights.

$ python -m tests.bench level
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from tests.bench.timing import cpu_s
from tests.fixtures.sim.yard import mapped, scans_of_yard

from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.clouds.sweep_image import T_LIDAR_CAMERA
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import Profile, encode_cell
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import geometry_for, level_geometry
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.demo.yard import BELOW, GRASS, LASTS_S, OPEN, SCENE
from cairn_sim.evaluation.ground_truth import ground_errors, ground_errors_below
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
EDGE_M = 0.2


def level_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    yield from _sweep_rows(smoke)
    for name in ("orpheus", "lidar"):
        yield from _yard_rows(name, smoke)
    yield from _hard_ground_rows(smoke)


def street_sweep() -> tuple[Rig, dict[str, Scan]]:
    """A sweep of 64 beams in a street 80 m long, as an image of known beams and as points without order."""
    lidar = SpinningLidar(width=1938, height=64, elevations_deg=tuple(np.linspace(2.0, -24.8, 64).round(3).tolist()))
    rays = lidar.rays() @ T_LIDAR_CAMERA[:3, :3].T
    low_m, high_m = np.array([-78.0, -12.0, -1.8]), np.array([78.0, 12.0, 9.0])
    with np.errstate(divide="ignore"):
        range_m = (np.where(rays > 0, high_m, low_m) / rays).min(axis=-1).astype(np.float32)
    rig = Rig(name="street", cameras={RANGE_CAMERA: mount_camera(Spectrum.RANGE, lidar, T_LIDAR_CAMERA)})
    image = Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera=RANGE_CAMERA, range_m=range_m)
    points = (lidar.rays() * range_m[..., None]).reshape(-1, 3).astype(np.float32)
    return rig, {"image": image, "points": replace(image, points_m=points)}


def _sweep_rows(smoke: bool) -> Iterator[Row]:
    rig, sweeps = street_sweep()
    limits, repeats = Integrator(max_range_m=80.0), 1 if smoke else 7
    for name, scan in sweeps.items():
        seconds = [
            cpu_s(partial(integrate_scans, [scan], rig, geometry, integrator=limits), repeats)
            for geometry in (geometry_for(voxel_edge_m=EDGE_M, channels=()), level_geometry())
        ]
        yield (
            f"sweep of 64 beams, {scan.range_m.size} points, 80 m, {name}: evidence",
            f"{1e3 * seconds[0]:.1f}",
            "ms CPU",
        )
        ratio = seconds[1] / seconds[0]
        yield "  into a level of 20 cm and 5 cm", f"{1e3 * seconds[1]:.1f}", f"ms CPU, {ratio:.2f} x (0.5 wanted)"


def _yard_rows(name: str, smoke: bool) -> Iterator[Row]:
    """Errors and bytes of what one robot sees on its loop."""
    scene, robot = load_scene("yard"), ROBOTS[name]
    if smoke and robot.scans_per_stop > 1:
        robot = replace(robot, scans=(4, 1))
    plan = Plan(scene=scene, robot=robot, path="loop", truth="none", scale=0.25, last_stop=2 if smoke else None)
    scans = scans_of_yard(plan)
    level, evidence = mapped(plan, scans), mapped(plan, scans, geometry_for(voxel_edge_m=EDGE_M))
    errors = ground_errors(scene, snapshot_of(level).elevation())
    yield (
        f"yard as a level, {name}, {len(scans)} scans: median error",
        f"{1e3 * errors.median_m:.1f}",
        f"mm (20 wanted), {errors.within_three:.1%} of {len(errors.error_m)} columns within 3 sigma (99 % wanted)",
    )
    for profile in Profile:
        sizes = [_bytes(each, profile) for each in (level, evidence)]
        ratio = sizes[0] / sizes[1]
        yield f"  bytes, profile {profile}", f"{sizes[0] / 1e3:.0f}", f"kB, {ratio:.2f} x evidence (0.2 wanted)"


def _hard_ground_rows(smoke: bool) -> Iterator[Row]:
    """Heights where something is over the ground, as `cairn demo --yard` proves them."""
    scene = load_scene(SCENE)
    plan = Plan(scene=scene, robot=ROBOTS["lidar"], path="round", truth="none", lasts_s=LASTS_S)
    ground = snapshot_of(mapped(plan, scans_of_yard(plan)[:: 3 if smoke else 1])).elevation()
    found = {OPEN: ground_errors(scene.at(CLOCK_START_S + LASTS_S), ground, without=(GRASS,))}
    found |= {bound: ground_errors_below(scene, ground, name) for name, bound in BELOW.items()}
    for bound, errors in found.items():
        yield (
            f"level, {bound.place}, lidar: median error",
            f"{1e3 * errors.median_m:.1f}",
            f"mm, largest {1e2 * errors.largest_m:.1f} cm, {errors.within_three:.1%} of {len(errors.error_m)} columns "
            "within 3 sigma",
        )


def _bytes(total: EvidenceMap, profile: Profile) -> int:
    cells = total.packed().items()
    return sum(len(encode_cell(key, evidence, total.geometry, profile=profile).data) for key, evidence in cells)
