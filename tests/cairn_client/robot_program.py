"""A robot in a process of its own, to be killed: it tells what it did after it did it.

python -m tests.cairn_client.robot_program MAP_URL FOLDER RUN
"""

import sys
from itertools import count

import numpy as np
from tests.cairn_client.made import GEOMETRY

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mounted
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.recording.scan import Scan

TOF = Camera(width=4, height=3, focal_px=(4.0, 4.0), centre_px=(1.5, 1.0))
RIG = Rig(name="head", cameras={"tof": mounted(Spectrum.RANGE, TOF, np.eye(4))})
INTEGRATOR = Integrator(max_range_m=2.0)
SCANS_PER_COMMIT = 2


def scan_of(seed: int) -> Scan:
    """A scan that only this seed gives."""
    rng = np.random.default_rng(seed)
    return Scan(
        time_s=1.5e9 + seed,
        T_map_rig=look_at(rng.uniform(0, 1, 3), rng.uniform(2, 3, 3)),
        range_camera="tof",
        range_m=rng.uniform(0.2, 1.5, (3, 4)).astype(np.float32),
    )


def tell(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def main(map_url: str, folder: str, run: int) -> None:
    """Map for ever."""
    robot = Robot(RIG, map_url, directory=folder, name="mole", geometry=GEOMETRY, integrator=INTEGRATOR)
    seeds = count(run * 100_000)
    for _ in range(1000):
        some = [next(seeds) for _ in range(SCANS_PER_COMMIT)]
        for seed in some:
            robot.observe(scan_of(seed))
            tell("observed", seed)
        commit = robot.commit(note=" ".join(map(str, some)))
        assert commit is not None
        tell("committed", commit.id)
        robot.sync()
        tell("synced")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
