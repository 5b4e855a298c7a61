"""Deskewing: each point of a sweep is moved from where the sensor was when it was measured to the sweep's own pose.

    p' = T_map_sensor(t_sweep)^-1 T_map_sensor(t_point) p

Drivers write times of points in many units, from the start of the sweep or as absolute time; a sweep takes between a
hundredth of a second and two, which tells the unit.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, inverse, transform_points
from cairn_fusion.clouds.cloud_columns import PointCloud
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

LONGEST_SWEEP_S = 2.0
SHORTEST_SWEEP_S = 2e-3
ABSOLUTE_S_MIN = 1e8
"""Times after 1973 are absolute."""
STEP_S = 1e-3
"""Points whose times differ by less are moved by one pose: 2 cm at 20 m/s."""
CLOCKS_APART_S = 2.0
"""Largest difference between a sweep's own time and the absolute times of its points."""
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True, slots=True)
class PointTimes:
    """Times of the points of one sweep."""

    seconds: Floats
    """(N,) from the sweep's time, or absolute."""
    is_absolute: bool
    text: str
    """Field, unit and length of the sweep, for people."""

    def absolute_s(self, time_s: float, name: str) -> Floats:
        """(N,) times on the clock of a sweep's own time.

        Raises:
            BadInputError: kind `bad_times`: they are absolute, and of another time than the sweep.
        """
        if not self.is_absolute:
            return time_s + self.seconds
        apart_s = float(np.nanmedian(self.seconds)) - time_s
        if abs(apart_s) > CLOCKS_APART_S:
            raise BadInputError("bad_times", f"{name}: its points were measured {apart_s:.3f} s after its own time")
        return self.seconds


def point_times(cloud: PointCloud, name: str) -> PointTimes | None:
    """Times of the points in seconds; None without a field of them, or if all are equal.

    Raises:
        BadInputError: kind `bad_times`: no unit makes them times of one sweep.
    """
    if cloud.times is None:
        return None
    known = cloud.times[np.isfinite(cloud.times) & np.isfinite(cloud.points[:, 0])]
    span = float(np.ptp(known)) if len(known) else 0.0
    if span == 0.0:
        return None
    # The first unit in which the sweep is long enough and short enough; whole numbers are no seconds.
    fits = [
        unit
        for unit, unit_s in UNITS_S.items()
        if SHORTEST_SWEEP_S <= span * unit_s <= LONGEST_SWEEP_S and not (unit == "s" and cloud.has_integer_times)
    ]
    if not fits:
        raise BadInputError(
            "bad_times",
            f"{name}: the field {cloud.time_field} spans {span:g}: in no unit of {', '.join(UNITS_S)} is that the time "
            f"of one sweep, {SHORTEST_SWEEP_S:g} to {LONGEST_SWEEP_S:g} s. Clouds of more than one sweep must be cut; "
            "--deskewed takes the points as they are",
        )
    seconds = cloud.times * UNITS_S[fits[0]]
    is_absolute = float(known.min()) * UNITS_S[fits[0]] >= ABSOLUTE_S_MIN
    kind = "absolute" if is_absolute else "from the sweep's time"
    text = f"field {cloud.time_field}, {fits[0]} {kind}, {span * UNITS_S[fits[0]]:.4g} s a sweep"
    return PointTimes(seconds, is_absolute, text)


def deskewed(
    points: npt.NDArray[np.float32], times_s: Floats, time_s: float, pose_at: Callable[[float], Transform]
) -> npt.NDArray[np.float32]:
    """(N, 3) the points as the sensor would have seen them at one time.

    Args:
        points: (N, 3) metres, sensor frame, each at its own time; NaN where nothing came back.
        times_s: (N,) absolute times, seconds.
        time_s: the time that they are moved to.
        pose_at: `T_map_sensor` by time.
    """
    moved = points.copy()
    T_sensor_map = inverse(pose_at(time_s))
    # Points of one step together, in order of their times.
    known = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(times_s))
    steps = np.rint((times_s[known] - time_s) / STEP_S).astype(np.int64)
    order = np.argsort(steps, kind="stable")
    starts = np.unique(steps[order], return_index=True)[1].tolist()
    for start, stop in zip(starts, [*starts[1:], len(order)], strict=True):
        rows = known[order[start:stop]]
        T = T_sensor_map @ pose_at(time_s + float(steps[order[start]]) * STEP_S)
        moved[rows] = transform_points(T, points[rows].astype(np.float64))
    return moved
