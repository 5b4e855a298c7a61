"""Where a robot stops in `small_room`, and how its head looks around there.

A measurement is taken standing: the head turns through the same poses at every stop, as the paper's did
(VI.C: 36 scans a stop, stops about 0.7 m apart indoors). The head turns about the ToF camera, so all scans of a
stop share one origin. Every stop is at least `CLEARANCE_M` from every solid, at each height between the robot's
deck and its head, so that its body would fit too.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from cairn_calib.poses import Points, Transform, look_at
from cairn_map.errors import BadInputError

HEAD_HEIGHT_M = 1.1
CLEARANCE_M = 0.4
PITCH_MAX_RAD = math.radians(45)
"""With the ToF camera's 56 degrees: all but 17 degrees around straight up and straight down are seen."""

PATHS: Mapping[str, tuple[tuple[float, float], ...]] = MappingProxyType(
    {
        "west": ((0.9, 1.0), (0.8, 1.7), (0.8, 2.4), (0.8, 3.1), (1.2, 3.6), (1.9, 3.8), (2.6, 3.8), (2.6, 3.1)),
        "doorway": ((1.9, 1.6), (2.2, 2.3), (2.9, 2.45), (3.5, 2.45), (4.05, 2.45), (4.7, 2.45), (5.2, 2.4)),
        "east": ((5.0, 1.2), (4.8, 1.8), (5.1, 2.4), (5.0, 3.1), (4.8, 3.7), (4.75, 4.4)),
    }
)
"""Stops of each path, x and y in metres. West and east share no stop's view but through the doorway."""


def stops(path: str, *, height_m: float = HEAD_HEIGHT_M) -> Points:
    """(K, 3) metres, map frame: where the head is at each stop of a named path.

    Raises:
        BadInputError: no such path.
    """
    if path not in PATHS:
        raise BadInputError("unknown_path", f"path must be one of {', '.join(PATHS)}, got {path!r}")
    return np.array([(x, y, height_m) for x, y in PATHS[path]], dtype=np.float64)


def head_poses(position: Points, *, n_yaw: int, n_pitch: int) -> list[Transform]:
    """`T_map_rig` of each scan at one stop: all yaws at the lowest pitch first, 12 x 3 for the paper's 36.

    Args:
        position: (3,) metres, map frame.
        n_yaw: directions around, evenly from +x towards +y.
        n_pitch: directions from 45 degrees down to 45 degrees up; a single one is level.

    Raises:
        BadInputError: fewer than one of either.
    """
    if n_yaw < 1 or n_pitch < 1:
        raise BadInputError("bad_count", f"a stop needs at least one yaw and one pitch, got {n_yaw} and {n_pitch}")
    eye = np.asarray(position, dtype=np.float64)
    pitches_rad = np.linspace(-PITCH_MAX_RAD, PITCH_MAX_RAD, n_pitch) if n_pitch > 1 else np.zeros(1)
    yaws_rad = np.arange(n_yaw) * (2 * math.pi / n_yaw)
    return [look_at(eye, eye + _direction(yaw, pitch)) for pitch in pitches_rad for yaw in yaws_rad]


def _direction(yaw_rad: float, pitch_rad: float) -> Points:
    level = math.cos(pitch_rad)
    return np.array([level * math.cos(yaw_rad), level * math.sin(yaw_rad), math.sin(pitch_rad)])
