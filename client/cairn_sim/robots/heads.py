"""Sensor heads of the simulated robots: Orpheus-X4's, lesser ones that carry a part of it, and two of another kind.

The rig's frame is the time-of-flight camera's: x right, y down, z forward, so `T_rig_tof` is the identity.
Pixel counts and fields of view are the paper's (PAPER.md section 2; the larger angle along the longer side).
Its baselines and lenses are not printed; ours, in metres, seen from the front of the head, are

                 x      y
    tof          0      0
    colour    -+0.11  -0.05      left is -x
    thermal   -+0.06  +0.06

and each of the outer cameras is aimed at the point 3 m ahead of the ToF camera, so that no rotation but the
ToF's is the identity: a transform taken the wrong way round shows. Lenses distort as such lenses do, each its own way.
"""

import math
from typing import NamedTuple

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import MountedCamera, Rig, Spectrum, mount_camera
from cairn_map.errors import BadInputError

RANGE_CAMERA = "tof"
"""Name of the range camera on every head."""
COLOUR_X_M, COLOUR_Y_M = 0.11, -0.05
THERMAL_X_M, THERMAL_Y_M = 0.06, 0.06
AIM_M = 3.0
Distortion = tuple[float, float, float, float, float]


class HeadLens(NamedTuple):
    """An image size, the angle along its rows, and how a real lens of the kind departs from a pinhole."""

    size_px: tuple[int, int]
    horizontal_deg: float
    distortion: Distortion
    """k1, k2, p1, p2, k3"""
    off_centre: tuple[float, float]
    """Offset of the principal point from the image's middle, as a share of the width."""

    def camera(self, *, scale: float = 1.0, ideal: bool = False, mirrored: bool = False) -> Camera:
        """A camera with this lens; `ideal`: a pinhole; `mirrored`: tangential terms and offset of opposite sign."""
        width, height = (round(side * scale) for side in self.size_px) if 0 < scale <= 1 else (0, 0)
        if min(width, height) < 1:
            raise BadInputError("bad_scale", f"scale must be above 0, at most 1, and leave a pixel, got {scale}")
        focal_px = width / 2 / math.tan(math.radians(self.horizontal_deg) / 2)
        sign = 0.0 if ideal else (-1.0 if mirrored else 1.0)
        k1, k2, p1, p2, k3 = (0.0,) * 5 if ideal else self.distortion
        dx, dy = self.off_centre
        return Camera(
            width=width,
            height=height,
            focal_px=(focal_px, focal_px),
            centre_px=((width - 1) / 2 + sign * dx * width, (height - 1) / 2 + sign * dy * width),
            distortion=(k1, k2, sign * p1, sign * p2, k3),
        )


COLOUR = HeadLens((1280, 960), 51.0, (-0.11, 0.09, 4e-4, -3e-4, 0.0), (0.006, -0.004))
THERMAL = HeadLens((640, 512), 69.0, (-0.24, 0.10, -6e-4, 5e-4, -0.02), (-0.008, 0.005))
TOF = HeadLens((176, 144), 69.0, (-0.28, 0.13, 5e-4, 8e-4, -0.03), (0.007, 0.009))
HANDHELD = HeadLens((640, 480), 60.0, (0.04, -0.08, 2e-4, 3e-4, 0.0), (0.004, 0.003))


def full_head(*, scale: float = 1.0, ideal: bool = False) -> Rig:
    """Two colour, two thermal and the ToF camera.

    Args:
        scale: shrinks the colour and thermal images, not their view.
        ideal: lenses without distortion, principal points in the middle, so that Eq. 1 to 6 hold as printed.
    """
    return Rig(
        name="orpheus-x4",
        cameras={
            RANGE_CAMERA: _tof(ideal),
            "colour_left": _colour(-1, scale, ideal),
            "colour_right": _colour(1, scale, ideal),
            "thermal_left": _thermal(-1, scale, ideal),
            "thermal_right": _thermal(1, scale, ideal),
        },
    )


def colour_and_tof_head(*, scale: float = 1.0, ideal: bool = False) -> Rig:
    """The left colour camera and the ToF camera, where `full_head` has them."""
    return Rig(name="colour-tof", cameras={RANGE_CAMERA: _tof(ideal), "colour_left": _colour(-1, scale, ideal)})


def thermal_and_tof_head(*, scale: float = 1.0, ideal: bool = False) -> Rig:
    """The left thermal camera and the ToF camera, where `full_head` has them."""
    return Rig(name="thermal-tof", cameras={RANGE_CAMERA: _tof(ideal), "thermal_left": _thermal(-1, scale, ideal)})


def tof_head(*, ideal: bool = False) -> Rig:
    """The ToF camera alone."""
    return Rig(name="tof", cameras={RANGE_CAMERA: _tof(ideal)})


def handheld_head(*, scale: float = 1.0) -> Rig:
    """Colour camera 2.5 cm from a depth camera of the same size, as hand-held depth cameras have them."""
    depth = mount_camera(Spectrum.RANGE, HANDHELD.camera(mirrored=True), look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0)))
    colour = HANDHELD.camera(scale=scale)
    return Rig(
        name="handheld",
        cameras={
            RANGE_CAMERA: depth,
            "colour": mount_camera(Spectrum.COLOUR, colour, look_at((0.025, 0, 0), (0.025, 0, 1), up=(0, -1, 0))),
        },
    )


def lidar_head() -> Rig:
    """A spinning lidar of 32 beams, 1.33 degrees apart, 1024 steps a turn, as a range camera; no other."""
    elevations_deg = tuple(round(10.667 - n * 4 / 3, 3) for n in range(32))
    lidar = SpinningLidar(width=1024, height=32, elevations_deg=elevations_deg)
    return Rig(
        name="lidar",
        cameras={RANGE_CAMERA: mount_camera(Spectrum.RANGE, lidar, look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0)))},
    )


def _tof(ideal: bool) -> MountedCamera:
    # Looks along z from the origin: the identity.
    return mount_camera(Spectrum.RANGE, TOF.camera(ideal=ideal), look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0)))


def _colour(side: int, scale: float, ideal: bool) -> MountedCamera:
    camera = COLOUR.camera(scale=scale, ideal=ideal, mirrored=side > 0)
    pose = look_at((side * COLOUR_X_M, COLOUR_Y_M, 0), (0, 0, AIM_M), up=(0, -1, 0))
    return mount_camera(Spectrum.COLOUR, camera, pose)


def _thermal(side: int, scale: float, ideal: bool) -> MountedCamera:
    camera = THERMAL.camera(scale=scale, ideal=ideal, mirrored=side > 0)
    pose = look_at((side * THERMAL_X_M, THERMAL_Y_M, 0), (0, 0, AIM_M), up=(0, -1, 0))
    return mount_camera(Spectrum.THERMAL, camera, pose)
