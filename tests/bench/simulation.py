"""How fast the simulator renders the building, on all cores, and how fast its truth is found."""

import statistics
import time
from collections.abc import Callable, Iterator

from cairn_map.evidence.grid import Geometry, cell_key
from cairn_sim.evaluation.truth_grid import box_of_cell, solid_masks
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]


def simulation_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    scene, robot, noise = load_scene("building"), ROBOTS["orpheus"], Noise(1)
    rig = robot.rig_of(1.0)
    standing = stops(scene, "experiment")[:: 54 if smoke else 6]
    poses = [T for place in standing for T in robot.head_poses(place)[:: 12 if smoke else 6]]

    def render(number: int, *, with_noise: bool) -> None:
        render_scan(
            scene,
            rig,
            T_map_rig=poses[number],
            range_camera=RANGE_CAMERA,
            time_s=0.0,
            noise=noise if with_noise else None,
            number=number,
        )

    render(0, with_noise=True)
    for name, with_noise in (("with noise", True), ("perfect", False)):
        seconds = sorted(_wall_s(lambda n=n, noisy=with_noise: render(n, with_noise=noisy)) for n in range(len(poses)))  # type: ignore[misc]
        median_s, worst_s = statistics.median(seconds), seconds[-1]
        yield (
            f"render a five-camera head pose, full size, {name}",
            f"{median_s:.2f}",
            f"s median, {worst_s:.2f} worst of {len(poses)}",
        )
    plan = Plan(scene=scene, robot=ROBOTS["tof"], path="experiment", truth="none", last_stop=1 if smoke else 16)
    shots = shots_of(plan)
    seconds_s = _wall_s(lambda: sum(1 for _ in scans_of(plan, shots, ROBOTS["tof"].rig_of(1.0))))
    yield f"render ToF alone, {len(shots)} scans", f"{len(shots) / seconds_s:.0f}", "images/s"
    box = box_of_cell(cell_key((2, 2, -1)), Geometry())
    solid_masks(scene, box)
    yield (
        "true occupancy of a cell at 4 cm, 64 samples a voxel",
        f"{1e3 * _wall_s(lambda: solid_masks(scene, box)):.0f}",
        "ms",
    )


def _wall_s(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
