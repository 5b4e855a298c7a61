"""Movements: the pose of an object at any time, from its poses at a few.

    door      closed -------- closed ~~ open ------->     ---  stays: two keyframes with one pose, or the last one
    crate     (gone)          here ------- (gone) -->     ~~~  moves: straight, and along the shortest arc
    person    here ~~~~~ there ~~~~~ here |~~~~~ there    |    begins again, every `repeat_s`

A scene's clock is that of its recordings: UTC in seconds, and time 0 of a scene file is `CLOCK_START_S`.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from cairn_calib.rig.poses import Transform, check_transform
from cairn_fusion.recording.trajectory import interpolate_pose
from cairn_map.errors import BadInputError
from cairn_sim.scene.solids import Plane, Solid

CLOCK_START_S = 1_760_000_000.0
"""UTC, seconds since 1970, of time 0 of every scene file and of a recording's first scan."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """Pose of an object at one time; no pose: from then on it is gone."""

    time_s: float
    """Seconds after the scene's start."""
    T_path_object: Transform | None


@dataclass(frozen=True, slots=True, eq=False)
class Movement:
    """Keyframes of one object, along a path that lies somewhere in the map.

    Before the first keyframe and after the last the object stays as it is there.
    """

    keyframes: tuple[Keyframe, ...]
    T_map_path: Transform
    repeat_s: float | None = None
    """Seconds after which all begins again, with time 0; None: it does not."""

    def __post_init__(self) -> None:
        times_s = [keyframe.time_s for keyframe in self.keyframes]
        if not times_s:
            raise BadInputError("bad_movement", "a movement needs at least one keyframe, got none")
        if not all(0 <= time_s < math.inf for time_s in times_s):
            raise BadInputError("bad_movement", f"a keyframe needs a time_s from 0, got {min(times_s):g}")
        for before_s, time_s in pairwise(times_s):
            if not before_s < time_s:
                raise BadInputError("bad_movement", f"times of keyframes must rise, got {time_s:g} after {before_s:g}")
        if self.repeat_s is not None and not max(times_s[-1], 1e-3) <= self.repeat_s < math.inf:
            raise BadInputError(
                "bad_movement",
                f"repeat_s must be above 0 and not before the last keyframe's {times_s[-1]:g} s, got {self.repeat_s:g}",
            )
        object.__setattr__(self, "T_map_path", check_transform(self.T_map_path, name="T_map_path"))

    def pose_at(self, after_s: float) -> Transform | None:
        """`T_map_object` some seconds after the scene's start; None while the object is gone.

        The very same numbers as long as it stands still.
        """
        at_s = after_s if self.repeat_s is None else after_s % self.repeat_s
        number = max(bisect_right(self.keyframes, at_s, key=lambda keyframe: keyframe.time_s) - 1, 0)
        one, other = self.keyframes[number], self.keyframes[min(number + 1, len(self.keyframes) - 1)]
        T, T_next = one.T_path_object, other.T_path_object
        if T is None:
            return None
        # Interpolated only where it moves: rounding would make every moment of standing still another pose.
        if T_next is not None and at_s > one.time_s and not np.array_equal(T, T_next):
            T = interpolate_pose(T, T_next, (at_s - one.time_s) / (other.time_s - one.time_s))
        return np.asarray(self.T_map_path @ T)


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """Solids that move as one piece."""

    name: str
    solids: tuple[Solid, ...]
    """Each with its pose in the object's own frame."""
    movement: Movement

    def __post_init__(self) -> None:
        for solid in self.solids:
            if isinstance(solid.shape, Plane):
                raise BadInputError("bad_movement", f"{solid.name} is a plane, which has no end and cannot move")

    def placed_solids(self, T_map_object: Transform) -> tuple[Solid, ...]:
        """The solids of the object at a pose."""
        return tuple(replace(solid, T_map_solid=T_map_object @ solid.T_map_solid) for solid in self.solids)
