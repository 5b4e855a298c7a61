"""What the simulated study of image configurations looks at: boards for calibration, discs for verification.

Places are drawn in the range camera's image, so that its whole field is covered whatever the lens; the head stands in
the bare laboratory and looks along x. Seeded; the same numbers give the same scenes.
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform, transform_points
from cairn_calib.rig.rig import Rig
from cairn_map.arrays import Floats
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.kinematics import T_FORWARD_CAMERA
from cairn_sim.scene.solids import placed

T_MAP_HEAD: Transform = placed((0.0, 0.0, 1.4)) @ T_FORWARD_CAMERA
"""In the middle of the laboratory's height."""
RANGES_M = (1.1, 5.7)
"""Of the paper's 211 objects."""
RADIUS_MAX_PX = 67.0
"""Of the range camera's image, from its principal point; the paper's."""
TILT_MAX_RAD = 0.5
DIAMETERS_M = (0.20, 0.30, 0.30)
"""Three targets, of 20 and 30 cm."""
ROOM_LOW, ROOM_HIGH = np.array([-0.5, -2.7, 0.2]), np.array([6.6, 2.7, 2.6])
APART = 1.25
"""Between two targets, times what would make them touch in the image."""
MARGIN_PX = 4
TRIES = 10_000


@dataclass(frozen=True, slots=True)
class Target:
    """One disc: where it is, and how wide."""

    T_map_target: Transform
    diameter_m: float


def targets_in_view(rig: Rig, rng: np.random.Generator) -> list[Target]:
    """Three discs at random places of the range camera's image and random ranges, none before another."""
    lens = rig[RANGE_CAMERA].camera
    placed_at: list[tuple[Floats, float]] = []
    targets: list[Target] = []
    for diameter_m in DIAMETERS_M:
        for _ in range(TRIES):
            pixel = rng.uniform([0, 0], [lens.width - 1, lens.height - 1])
            range_m = float(rng.uniform(*RANGES_M))
            beam = lens.unproject(pixel)
            at = transform_points(T_MAP_HEAD @ rig[RANGE_CAMERA].transform, (beam * range_m)[None])[0]
            reach_px = diameter_m / 2 / range_m * lens.width / 1.2 + MARGIN_PX
            size = np.array([lens.width, lens.height])
            inside = (pixel > reach_px).all() and (pixel < size - reach_px).all()
            away = np.linalg.norm(pixel - (size - 1) / 2) < RADIUS_MAX_PX
            free = all(np.linalg.norm(pixel - other) > APART * (reach_px + reach) for other, reach in placed_at)
            if inside and away and free and (at > ROOM_LOW).all() and (at < ROOM_HIGH).all():
                rx, ry, rz = (float(v) for v in rng.uniform(-TILT_MAX_RAD, TILT_MAX_RAD, 3))
                x, y, z = (float(v) for v in at)
                T = placed((x, y, z)) @ T_FORWARD_CAMERA @ placed((0, 0, 0), (rx, ry, rz))
                targets.append(Target(T, diameter_m))
                placed_at.append((pixel, reach_px))
                break
    return targets
