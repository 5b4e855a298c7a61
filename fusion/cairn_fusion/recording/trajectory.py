"""Trajectory: the rig's pose over time, in the TUM RGB-D benchmark's text format.

    # time tx ty tz qx qy qz qw        T_map_rig; metres; unit quaternion, scalar last
    1700000000.0 1.5 0.0 0.4 0 0 0.70710678 0.70710678

Between two lines the position runs straight and the rotation along the shortest arc (slerp). Before the
first and after the last line there is no pose: nothing is extrapolated.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from cairn_calib.rig.poses import Transform, quaternion_from_transform, transform_from_quaternion
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.timed_lists import Line, TimedList, timed_list
from cairn_map.errors import BadInputError

SLERP_MIN_RAD = 1e-6
"""Below this angle the arc is its chord to 1e-13, and sin(angle) no longer divides well."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses at strictly increasing times."""

    path: Path | str
    """The file or other source of the poses; errors name it."""
    poses: TimedList[Transform]

    def pose_at(self, time_s: float, *, max_gap_s: float) -> Transform:
        """`T_map_rig` at a time: the pose of that very time stamp, else interpolated between its neighbours.

        Args:
            time_s: seconds, on the trajectory's clock.
            max_gap_s: largest time between the two neighbours; 0 allows exact matches only.

        Raises:
            BadInputError: `no_pose`: outside the trajectory, or the neighbours are too far apart.
        """
        times_s = self.poses.times_s
        after = int(np.searchsorted(times_s, time_s))
        if after < len(times_s) and times_s[after] == time_s:
            return self.poses.values[after]
        if after in (0, len(times_s)):
            raise BadInputError("no_pose", f"{self.path} has no pose at {time_s!r}, which is outside its times")
        start_s, end_s = float(times_s[after - 1]), float(times_s[after])
        if end_s - start_s > max_gap_s:
            raise BadInputError(
                "no_pose",
                f"{self.path} has no pose at {time_s!r}: its neighbours are {end_s - start_s:.6g} s apart, "
                f"{max_gap_s:.6g} s are allowed",
            )
        fraction = (time_s - start_s) / (end_s - start_s)
        return interpolate_pose(self.poses.values[after - 1], self.poses.values[after], fraction)


def read_trajectory(path: Path, rounding: PoseRounding | None = None) -> Trajectory:
    """The trajectory in a file; quaternions that are not quite of length 1 are noted in `rounding`.

    Raises:
        BadInputError: missing, too large, times that do not increase, or a line that is no pose; with its number.
    """
    return Trajectory(path, timed_list(path, partial(_pose, rounding or PoseRounding())))


def trajectory_line(time_s: float, T_map_rig: Transform) -> str:
    """One line, newline included; it reads back within 1e-15 of the rotation, and exactly in position and time."""
    numbers = [time_s, *T_map_rig[:3, 3], *quaternion_from_transform(T_map_rig)]
    return " ".join(repr(float(number)) for number in numbers) + "\n"


def interpolate_pose(T_map_start: Transform, T_map_end: Transform, fraction: float) -> Transform:
    """The pose at `fraction` (0 to 1) of the way: position on the line, rotation by slerp (Shoemake 1985)."""
    q_start, q_end = quaternion_from_transform(T_map_start), quaternion_from_transform(T_map_end)
    if q_start @ q_end < 0:  # q and -q are one rotation; take the nearer of the two
        q_end = -q_end
    # atan2 of chord lengths keeps its digits where arccos of the dot product loses half of them.
    angle_rad = 2 * np.arctan2(np.linalg.norm(q_end - q_start), np.linalg.norm(q_end + q_start))
    if angle_rad < SLERP_MIN_RAD:
        weights = (1 - fraction, fraction)
    else:
        weights = (
            np.sin((1 - fraction) * angle_rad) / np.sin(angle_rad),
            np.sin(fraction * angle_rad) / np.sin(angle_rad),
        )
    t = (1 - fraction) * T_map_start[:3, 3] + fraction * T_map_end[:3, 3]
    return transform_from_quaternion(t, weights[0] * q_start + weights[1] * q_end)


def _pose(rounding: PoseRounding, line: Line, text: str) -> Transform:
    tx, ty, tz, *q_xyzw = line.numbers(text, 7)
    try:
        rounding.check_quaternion(q_xyzw, name=f"{line.path}:{line.number}")
    except BadInputError as exc:
        raise BadInputError("bad_recording", exc.message) from exc
    return transform_from_quaternion((tx, ty, tz), q_xyzw)
