"""Orpheus-X4's manipulator: where the joints put the sensor head.

    map --T_map_robot--> robot: on the ground, x forward, y left, z up
          up `shoulder_m`, turn by `arm` about y, up `arm_m`      joint 1: raises the head, still in a measurement
          turn by `pan` about z, up `neck_m`                      joint 2
          turn by `tilt` about y, on by `head_m`                  joint 3; positive looks down
    rig: the time-of-flight camera, x right, y down, z forward

The paper (section II.B, VI.C) says three degrees of freedom, low-backlash gears, the upper two moving through the same
36 poses at every stop; the lengths are ours. With `arm` 0 and level the head is 1.1 m above the ground.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_map.errors import BadInputError
from cairn_sim.scene.solids import placed

TILT_MAX_RAD = math.radians(45)
"""With the ToF camera's 56 degrees: all but 17 degrees around straight up and straight down are seen."""


PARKED_RAD = -0.1
"""Pan and tilt before the first command: so that every gear has a side from which it comes."""


@dataclass(frozen=True, slots=True)
class Joints:
    """The three joints, radians."""

    arm_rad: float = 0.0
    pan_rad: float = 0.0
    tilt_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Manipulator:
    """Lengths of the manipulator, metres."""

    shoulder_m: float = 0.45
    arm_m: float = 0.54
    neck_m: float = 0.07
    head_m: tuple[float, float] = (0.06, 0.04)
    """From the tilt axis to the time-of-flight camera, forward and up."""

    def T_robot_rig(self, joints: Joints) -> Transform:
        """Pose of the head on the robot."""
        forward_m, up_m = self.head_m
        return (
            placed((0, 0, self.shoulder_m), (0, joints.arm_rad, 0))
            @ placed((0, 0, self.arm_m), (0, 0, joints.pan_rad))
            @ placed((0, 0, self.neck_m), (0, joints.tilt_rad, 0))
            @ placed((forward_m, 0, up_m))
            @ T_FORWARD_CAMERA
        )


T_FORWARD_CAMERA: Transform = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""A camera's axes (x right, y down, z forward) in a vehicle's (x forward, y left, z up)."""


def measurement_joints(n_pan: int = 12, n_tilt: int = 3) -> list[Joints]:
    """The head's poses at one stop, 36 in the paper: row by row from the lowest view, back and forth as a head would.

    Raises:
        BadInputError: fewer than one of either.
    """
    if n_pan < 1 or n_tilt < 1:
        raise BadInputError("bad_count", f"a stop needs at least one pan and one tilt, got {n_pan} and {n_tilt}")
    tilts_rad = np.linspace(TILT_MAX_RAD, -TILT_MAX_RAD, n_tilt) if n_tilt > 1 else np.zeros(1)
    pans_rad = np.arange(n_pan) * (2 * math.pi / n_pan)
    return [
        Joints(pan_rad=float(pan), tilt_rad=float(tilt))
        for row, tilt in enumerate(tilts_rad)
        for pan in (pans_rad if row % 2 == 0 else pans_rad[::-1])
    ]


def with_backlash(
    joints: Sequence[Joints], *, gap_rad: float, sigma_rad: float, rng: np.random.Generator
) -> list[Joints]:
    """True joint angles after a series of commands from the parking position, by gears with play.

    A gear stops half a gap short of where it was sent, on the side that it came from; load shakes it by `sigma_rad`.
    """
    told = np.array([(j.pan_rad, j.tilt_rad) for j in joints]).reshape(-1, 2)
    side = np.zeros(2)
    true = []
    for before, now in zip(np.vstack([np.full((1, 2), PARKED_RAD), told]), told, strict=False):
        side = np.where(now != before, np.sign(now - before), side)
        true.append(now - side * gap_rad / 2 + sigma_rad * rng.standard_normal(2))
    return [
        Joints(arm_rad=j.arm_rad, pan_rad=float(pan), tilt_rad=float(tilt))
        for j, (pan, tilt) in zip(joints, true, strict=True)
    ]
