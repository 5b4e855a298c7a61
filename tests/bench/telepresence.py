"""How many fused views a second: ToF, thermal and colour of the building to one picture, on all cores."""

import statistics
import time
from collections.abc import Iterator

from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view.telepresence import Telepresence, ViewMode, ViewOptions
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import geometry_for
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import EXPERIMENT
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]

STOP = 20
"""A laboratory with people, glass, hot things and a dark floor: with many edges, and so slower than most."""
VOXEL_M = 0.04
REPEATS = 5


def telepresence_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    robot = ROBOTS["orpheus"]
    rig = robot.rig_of(1.0)
    plan = Plan(
        scene=load_scene("building"), robot=robot, path=EXPERIMENT, truth="none", first_stop=STOP, last_stop=STOP + 1
    )
    shots = [shot for shot in shots_of(plan) if shot.scan % (18 if smoke else 6) == 4]
    both = [scan for _, scan, _ in scans_of(plan, shots, rig)]
    # As the paper maps: one colour, one thermal camera; and with the second ones, too.
    single = [_with_one_thermal(scan) for scan in both]
    mapped = EvidenceMap(geometry := geometry_for(voxel_edge_m=VOXEL_M))
    mapped.merge(integrate_scans(both, rig, geometry, integrator=Integrator()))
    snapshot = snapshot_of(mapped)
    for name, mode, scans, known in (
        ("fused 640 x 512 view, colour on thermal", ViewMode.COLOUR_ON_THERMAL, single, None),
        ("fused 1280 x 960 view, thermal on colour", ViewMode.THERMAL_ON_COLOUR, single, None),
        (f"  with a map of {VOXEL_M * 100:g} cm for its mirrors", ViewMode.THERMAL_ON_COLOUR, single, snapshot),
        ("  with the second thermal camera", ViewMode.THERMAL_ON_COLOUR, both, None),
        ("stereo pair, 2 x 1280 x 960", ViewMode.STEREO, both, None),
    ):
        look = Telepresence(rig, ViewOptions(mode=mode), known)
        look.view(scans[0])
        wall_s, cpu_s = zip(
            *(_seconds(look, scan) for _ in range(1 if smoke else REPEATS) for scan in scans), strict=True
        )
        median_s = statistics.median(wall_s)
        yield (
            name,
            f"{1 / median_s:.1f}",
            f"views/s: {1e3 * median_s:.0f} ms wall, {1e3 * statistics.median(cpu_s):.0f} ms CPU",
        )


def _with_one_thermal(scan: Scan) -> Scan:
    return Scan(
        time_s=scan.time_s,
        T_map_rig=scan.T_map_rig,
        range_camera=scan.range_camera,
        range_m=scan.range_m,
        amplitude=scan.amplitude,
        colour={"colour_left": scan.colour["colour_left"]},
        thermal={"thermal_left": scan.thermal["thermal_left"]},
    )


def _seconds(look: Telepresence, scan: Scan) -> tuple[float, float]:
    """Wall and CPU time of one view."""
    wall, cpu = time.perf_counter(), time.process_time()
    look.view(scan)
    return time.perf_counter() - wall, time.process_time() - cpu
