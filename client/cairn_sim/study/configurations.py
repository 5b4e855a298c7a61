"""Ten ways to hold a board before the head: the study's image configurations c1 to c10, of 2 to 9 images.

The paper's Table 1 is lost; what is left of it is that there were ten sets of 2 to 9 images, that sets 1 to 3 had two
images and gave values far from real, that set 10 was best and set 8 nearly so. These ten are our own: they differ in
number, tilt, distance, and how far out in the image the board is.

    Place(x, y, z_m, tilt_deg, about_deg)       x and y from -1 to 1: the board's middle in the range camera's field,
                                                so that at 1 the board's edge meets the field's; tilted about an axis in
                                                its own plane, 0 degrees: along its rows
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.targets import SimulatedBoard

EDGE_M = 0.42
"""From the board's middle to where its corners must still be seen, with a tenth of a square to spare."""


@dataclass(frozen=True, slots=True)
class Place:
    """Pose of the board for one image, as seen by the range camera."""

    x: float
    y: float
    z_m: float
    tilt_deg: float = 0.0
    about_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Configuration:
    """A set of places, and what is special about it."""

    about: str
    places: tuple[Place, ...]


def pose_of(place: Place, board: SimulatedBoard, rig: Rig) -> Transform:
    """`T_rig_board` of a board whose middle is at the place."""
    lens = rig[RANGE_CAMERA].camera
    if not isinstance(lens, Lens):
        raise TypeError("the range camera needs a lens")
    half_x, half_y = (size / 2 / f for size, f in zip((lens.width, lens.height), lens.focal_px, strict=True))
    middle = np.array([place.x * (half_x * place.z_m - EDGE_M), place.y * (half_y * place.z_m - EDGE_M), place.z_m])
    axis = np.array([np.cos(np.radians(place.about_deg)), np.sin(np.radians(place.about_deg)), 0.0])
    angle = np.radians(place.tilt_deg)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    T[:3, 3] = middle - T[:3, :3] @ np.array([*board.centre, 0.0])
    return T


def _about(z_m: float, tilt_deg: float, *degrees: float, x: float = 0.25, y: float = 0.2) -> tuple[Place, ...]:
    """About the middle, tilted about axes in several directions; moved a little each time, as hands do."""
    return tuple(
        Place(x * np.cos(3 * n + z_m), y * np.sin(3 * n + z_m), z_m, tilt_deg, about) for n, about in enumerate(degrees)
    )


def _corners(z_m: float, tilt_deg: float, out: float = 1.0) -> tuple[Place, ...]:
    """Towards the four corners of the field, turned towards the head."""
    ends = ((-out, -out, 315.0), (out, -out, 45.0), (out, out, 135.0), (-out, out, 225.0))
    return tuple(Place(x, y, z_m, tilt_deg, about) for x, y, about in ends)


def _sides(z_m: float, tilt_deg: float, out: float) -> tuple[Place, ...]:
    """Towards the four sides of the field, turned towards the head."""
    ends = ((out, 0.0, 90.0), (-out, 0.0, 270.0), (0.0, out, 180.0), (0.0, -out, 0.0))
    return tuple(Place(x, y, z_m, tilt_deg, about) for x, y, about in ends)


CONFIGURATIONS: Mapping[str, Configuration] = {
    "c1": Configuration("2 head-on, middle, one distance", (Place(-0.2, 0, 1.9), Place(0.2, 0, 1.9))),
    "c2": Configuration("2 tilted by 8 degrees, middle, near and far", (*_about(1.6, 8, 0), *_about(2.4, 8, 90))),
    "c3": Configuration("2 tilted by 30 degrees, middle, one distance", _about(1.9, 30, 0, 90)),
    "c4": Configuration("3 tilted by 20 degrees, middle, one distance", _about(1.9, 20, 0, 120, 240)),
    "c5": Configuration(
        "4 tilted by 30 degrees, middle, near and far", (*_about(1.6, 30, 0, 90), *_about(2.4, 30, 180, 270))
    ),
    "c6": Configuration(
        "5 tilted by 30 degrees, middle and sides, one distance", (*_about(2.2, 30, 45), *_sides(2.2, 30, 0.5))
    ),
    "c7": Configuration(
        "6 tilted by 5 degrees, middle and corners, near and far",
        (*_about(1.6, 5, 0), *_about(2.4, 5, 90), *_corners(2.4, 5, 0.4)),
    ),
    "c8": Configuration(
        "8 tilted by 30 degrees, middle and corners, near and far",
        (*_about(1.6, 30, 0, 90), *_about(2.4, 30, 180, 270), *_corners(1.9, 30)),
    ),
    "c9": Configuration(
        "9 tilted by 20 degrees, middle, one distance", _about(1.9, 20, 0, 40, 80, 120, 160, 200, 240, 280, 320)
    ),
    "c10": Configuration(
        "9 tilted by 35 to 40 degrees, middle, sides and corners, near and far",
        (*_about(1.5, 40, 45, 225), *_sides(2.4, 40, 0.5)[:3], *_corners(1.8, 35)),
    ),
}
