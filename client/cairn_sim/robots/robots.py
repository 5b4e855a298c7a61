"""The simulated robots: a head, how it is carried, and how its sensors depart from the usual.

orpheus    Orpheus-X4: two colour, two thermal, one time-of-flight camera on a manipulator; 36 scans a stop
tof        the same manipulator with the time-of-flight camera alone
lidar      a spinning lidar on a mast, no camera; one scan a stop
handheld   a colour and a depth camera side by side, carried by hand; one scan a stop
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_map.errors import BadInputError
from cairn_sim.render.sensors import RangeSensor, Sensor
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, handheld_head, lidar_head, tof_head
from cairn_sim.robots.kinematics import T_FORWARD_CAMERA, Manipulator, measurement_joints, with_backlash
from cairn_sim.scene.solids import placed

LIDAR = RangeSensor(
    wrap_m=120.0,
    amplitude_min=2.0,
    amplitude_sigma=0.3,
    sigma_min_m=0.02,
    sigma_m=0.02,
    fineness=1,
    blooming=0.0,
)
"""2 cm at every range from 0.6 m on, 60 m to a surface of 0.4; a beam is thin and does not mix, and nothing wraps."""
DEPTH = RangeSensor(amplitude_min=300.0, sigma_min_m=0.003, sigma_m=0.008)
"""A depth camera for the hand: up to some 6 m of plaster."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimRobot:
    """One kind of robot."""

    name: str
    about: str
    rig_of: Callable[[float], Rig]
    """The head, with colour and thermal images shrunk by a scale."""
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    """Sensors of cameras that differ from their spectrum's usual one, by camera."""
    manipulator: Manipulator | None = None
    """None: the head is fixed, `fixed_m` above the ground and looking ahead."""
    fixed_m: float = 1.1
    scans: tuple[int, int] = (1, 1)
    """Pans and tilts of the head at one stop."""

    @property
    def scans_per_stop(self) -> int:
        """Head poses of one measurement."""
        return self.scans[0] * self.scans[1]

    def head_poses(self, T_map_robot: Transform) -> list[Transform]:
        """`T_map_rig` of each scan at one stop, at the commanded joint angles."""
        if self.manipulator is None:
            return [T_map_robot @ placed((0, 0, self.fixed_m)) @ T_FORWARD_CAMERA]
        return [T_map_robot @ self.manipulator.T_robot_rig(joints) for joints in measurement_joints(*self.scans)]

    def true_head_poses(
        self, T_map_robots: Sequence[Transform], *, gap_rad: float, sigma_rad: float, rng: np.random.Generator
    ) -> list[Transform]:
        """`T_map_rig` of each scan at all stops, one after the other, as gears with play truly put the head."""
        if self.manipulator is None:
            return [T for place in T_map_robots for T in self.head_poses(place)]
        told = measurement_joints(*self.scans)
        true = with_backlash(told * len(T_map_robots), gap_rad=gap_rad, sigma_rad=sigma_rad, rng=rng)
        return [
            place @ self.manipulator.T_robot_rig(joints)
            for n, place in enumerate(T_map_robots)
            for joints in true[n * len(told) : (n + 1) * len(told)]
        ]


ROBOTS: Mapping[str, SimRobot] = {
    robot.name: robot
    for robot in (
        SimRobot(
            name="orpheus",
            about="2 colour, 2 thermal, 1 ToF camera on a manipulator, 36 scans a stop",
            rig_of=lambda scale: full_head(scale=scale),
            manipulator=Manipulator(),
            scans=(12, 3),
        ),
        SimRobot(
            name="tof",
            about="1 ToF camera on a manipulator, 36 scans a stop",
            rig_of=lambda _: tof_head(),
            manipulator=Manipulator(),
            scans=(12, 3),
        ),
        SimRobot(
            name="lidar",
            about="1 spinning lidar, 32 beams, on a mast",
            rig_of=lambda _: lidar_head(),
            sensors={RANGE_CAMERA: LIDAR},
            fixed_m=1.0,
        ),
        SimRobot(
            name="handheld",
            about="1 colour and 1 depth camera, carried by hand",
            rig_of=lambda scale: handheld_head(scale=scale),
            sensors={RANGE_CAMERA: DEPTH},
            fixed_m=1.4,
        ),
    )
}


def robot_named(name: str) -> SimRobot:
    """The robot of a name.

    Raises:
        BadInputError: there is none.
    """
    if name not in ROBOTS:
        raise BadInputError("unknown_robot", f"the robots are {', '.join(ROBOTS)}, got {name!r}")
    return ROBOTS[name]
