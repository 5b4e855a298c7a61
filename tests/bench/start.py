"""How long a robot's second start takes: a fresh process, kernels from the cache, to its first integrated image.

$ python -m tests.bench.start FOLDER      # one such start, with the recording in FOLDER
"""

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

Row = tuple[str, str, str]


def start_rows(smoke: bool) -> Iterator[Row]:
    """Processor time of the whole process, beside the wall's, which on a busy machine says more of its neighbours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "recording"
        write_recording(folder)
        start(folder)  # compiles what is not kept yet
        taken = [start(folder) for _ in range(3 if smoke else 9)]
    cpu_s, wall_s = (statistics.median(column) for column in zip(*taken, strict=True))
    yield (
        "second start, to the first image integrated, 4 cm",
        f"{cpu_s:.2f}",
        f"s of processor time, {wall_s:.2f} s wall",
    )


def start(folder: Path) -> tuple[float, float]:
    """Processor and wall time of one process that starts, integrates one image and ends, seconds."""
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([sys.executable, "-m", "tests.bench.start", str(folder)], check=True, stderr=subprocess.DEVNULL)
    after, end_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, end_s - start_s


def write_recording(folder: Path) -> None:
    """Two ToF images of the simulated room, at full size."""
    from cairn_fusion.recording.recording_writer import RecordingWriter
    from cairn_sim.robots.record import Plan, scans_of, shots_of
    from cairn_sim.robots.robots import ROBOTS
    from cairn_sim.scene.scene_file import load_scene

    robot = replace(ROBOTS["tof"], scans=(2, 1))
    plan = Plan(scene=load_scene("small-room"), robot=robot, path="west", scale=1.0, truth="none", last_stop=1)
    rig = robot.rig_of(plan.scale)
    with RecordingWriter(folder, rig, name="start") as recording:
        for _, scan, _ in scans_of(plan, shots_of(plan), rig):
            recording.add(scan)


def main() -> None:
    """Start as a robot does, with what it needs and no more."""
    from cairn_client.robot.robot import Robot
    from cairn_fusion.recording.recording import open_recording
    from cairn_map.evidence.grid import Geometry

    recording = open_recording(sys.argv[1])
    with tempfile.TemporaryDirectory() as directory:
        robot = Robot(
            recording.rig, "http://127.0.0.1:9/maps/start", directory=directory, name="start", geometry=Geometry()
        )
        robot.observe(recording.scan(0))


if __name__ == "__main__":
    main()
