"""Sensor heads of the simulated robots: Orpheus-X4's, and lesser ones that carry a part of it.

The rig's frame is the time-of-flight camera's: x right, y down, z forward, so `T_rig_tof` is the identity.
Pixel counts and fields of view are the paper's (PAPER.md section 2; the larger angle along the longer side).
Its baselines are not printed; ours, in metres, seen from the front of the head, are

                 x      y
    tof          0      0
    colour    -+0.11  -0.05      left is -x
    thermal   -+0.06  +0.06

and each of the outer cameras is aimed at the point 3 m ahead of the ToF camera, so that no rotation but the
ToF's is the identity: a transform taken the wrong way round shows.
"""

from cairn_calib.camera import Camera, camera_from_field_of_view
from cairn_calib.poses import look_at
from cairn_calib.rig import MountedCamera, Rig, Spectrum, mounted
from cairn_map.errors import BadInputError

RANGE_CAMERA = "tof"
"""Name of the range camera on every head."""
COLOUR_SIZE_PX, COLOUR_HORIZONTAL_DEG = (1280, 960), 51.0
THERMAL_SIZE_PX, THERMAL_HORIZONTAL_DEG = (640, 512), 69.0
TOF_SIZE_PX, TOF_HORIZONTAL_DEG = (176, 144), 69.0
COLOUR_X_M, COLOUR_Y_M = 0.11, -0.05
THERMAL_X_M, THERMAL_Y_M = 0.06, 0.06
AIM_M = 3.0


def full_head(*, scale: float = 1.0) -> Rig:
    """Two colour, two thermal and the ToF camera; `scale` shrinks the colour and thermal images, not their view."""
    return Rig(
        name="orpheus-x4",
        cameras={
            RANGE_CAMERA: _tof(),
            "colour_left": _colour(-COLOUR_X_M, scale),
            "colour_right": _colour(COLOUR_X_M, scale),
            "thermal_left": _thermal(-THERMAL_X_M, scale),
            "thermal_right": _thermal(THERMAL_X_M, scale),
        },
    )


def colour_and_tof_head(*, scale: float = 1.0) -> Rig:
    """The left colour camera and the ToF camera, where `full_head` has them."""
    return Rig(name="colour-tof", cameras={RANGE_CAMERA: _tof(), "colour_left": _colour(-COLOUR_X_M, scale)})


def thermal_and_tof_head(*, scale: float = 1.0) -> Rig:
    """The left thermal camera and the ToF camera, where `full_head` has them."""
    return Rig(name="thermal-tof", cameras={RANGE_CAMERA: _tof(), "thermal_left": _thermal(-THERMAL_X_M, scale)})


def tof_head() -> Rig:
    """The ToF camera alone."""
    return Rig(name="tof", cameras={RANGE_CAMERA: _tof()})


def _tof() -> MountedCamera:
    width, height = TOF_SIZE_PX
    camera = camera_from_field_of_view(width, height, horizontal_deg=TOF_HORIZONTAL_DEG)
    # Looks along z from the origin: the identity.
    return mounted(Spectrum.RANGE, camera, look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0)))


def _colour(x_m: float, scale: float) -> MountedCamera:
    camera = _scaled(COLOUR_SIZE_PX, COLOUR_HORIZONTAL_DEG, scale)
    return mounted(Spectrum.COLOUR, camera, look_at((x_m, COLOUR_Y_M, 0), (0, 0, AIM_M), up=(0, -1, 0)))


def _thermal(x_m: float, scale: float) -> MountedCamera:
    camera = _scaled(THERMAL_SIZE_PX, THERMAL_HORIZONTAL_DEG, scale)
    return mounted(Spectrum.THERMAL, camera, look_at((x_m, THERMAL_Y_M, 0), (0, 0, AIM_M), up=(0, -1, 0)))


def _scaled(size_px: tuple[int, int], horizontal_deg: float, scale: float) -> Camera:
    width, height = (round(side * scale) for side in size_px) if 0 < scale <= 1 else (0, 0)
    if min(width, height) < 1:
        raise BadInputError("bad_scale", f"scale must be above 0, at most 1, and leave a pixel, got {scale}")
    return camera_from_field_of_view(width, height, horizontal_deg=horizontal_deg)
