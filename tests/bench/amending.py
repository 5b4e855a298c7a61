"""Duration of `cairn robot amend`: 200 measurements of 36 scans, range and temperature, moved by 5 cm."""

import io
import tempfile
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

from cairn_calib.rig.poses import Transform
from cairn_client.main import main
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.grid import geometry_for
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
NOWHERE = "http://127.0.0.1:9/maps/bench"
SHIFT_M = 0.05


def amending_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    count = 4 if smoke else 200
    robot, scene = ROBOTS["orpheus"], load_scene("building")
    plan = Plan(scene=scene, robot=robot, path="labs", truth="none", scale=0.25, first_stop=8, last_stop=9)
    rig = robot.rig_of(plan.scale)
    scans = [
        Scan(time_s=s.time_s, T_map_rig=s.T_map_rig, range_camera=s.range_camera, range_m=s.range_m, thermal=s.thermal)
        for _, s, _ in scans_of(plan, shots_of(plan), rig)
    ]
    with tempfile.TemporaryDirectory() as folder:
        state, poses = Path(folder) / "state", Path(folder) / "optimised.tum"
        grid = geometry_for(voxel_edge_m=0.04, channels=(TEMPERATURE,))
        lines = []
        with Robot(rig, NOWHERE, directory=state, name="b", geometry=grid, stay=True, keep_scans_bytes=8 << 30) as made:
            for n in range(count):
                for k, scan in enumerate(scans):
                    there = replace(scan, time_s=1.7e9 + n * len(scans) + k, T_map_rig=_shifted(scan.T_map_rig, n))
                    made.observe(there)
                    lines.append(trajectory_line(there.time_s, _shifted(there.T_map_rig, 1)))
                made.commit()
        poses.write_text("".join(lines))
        command = ["robot", "amend", str(state), "--trajectory", str(poses)]
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()):
            start_s = time.perf_counter()
            main(command)
            took_s = time.perf_counter() - start_s
        assert f"{count} measurements of b amended" in out.getvalue()
        voxels = f"{count} measurements of {len(scans)} scans"
        yield f"cairn robot amend, {voxels}, range and temperature, 4 cm", f"{took_s:.1f}", "s (at most 20 for 200)"


def _shifted(T_map_rig: Transform, steps: int) -> Transform:
    T = T_map_rig.copy()
    T[1, 3] += SHIFT_M * steps
    return T
