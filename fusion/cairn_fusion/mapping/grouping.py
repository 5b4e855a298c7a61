"""Grouping of scans into measurements: where one ends and the next begins, by count, time and way.

    scans     0 1 2 ... 49 | 50 51 ... | 67 ...
                        count       2 m          a step back in time ends one, too

A measurement is one commit, and the unit of a retract and of an amend; a robot that is lost takes the open one with it,
and other robots see it when it is closed. So it is small in time and place. One commit for each scan is larger by far:
50 scans of a walk say of most voxels what one of them says.

All scans are taken, and the map is the same under any grouping, since sums do not depend on it.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_map.errors import BadInputError


@dataclass(frozen=True, slots=True)
class Grouping:
    """Bounds of a measurement; it ends before the scan that would exceed one of them."""

    scans_max: int = 50
    seconds_max: float | None = 5.0
    """Time from its first scan to its last; None: of scans whose times are made up."""
    metres_max: float = 2.0
    """Distance of each scan's rig from that of its first."""

    def __post_init__(self) -> None:
        if self.scans_max < 1 or (self.seconds_max is not None and self.seconds_max < 0) or self.metres_max < 0:
            raise BadInputError("bad_measurement", f"a measurement has at least one scan, and no bound below 0: {self}")


class OpenGroup:
    """Measurement that is open: asked about each scan in turn."""

    def __init__(self, grouping: Grouping) -> None:
        self._grouping = grouping
        self._count = 0
        self._first_s = self._last_s = 0.0
        self._first_m = np.zeros(3)

    def ends_before(self, time_s: float, T_map_rig: Transform) -> bool:
        """True if the measurement ends before this scan, which is the first of the next one then.

        Args:
            time_s: of the scan, seconds.
            T_map_rig: (4, 4) pose, metres.
        """
        bounds, place_m = self._grouping, np.asarray(T_map_rig, np.float64)[:3, 3]
        ends = self._count > 0 and (
            self._count >= bounds.scans_max
            or time_s < self._last_s
            or (bounds.seconds_max is not None and time_s - self._first_s > bounds.seconds_max)
            or float(np.linalg.norm(place_m - self._first_m)) > bounds.metres_max
        )
        if ends or self._count == 0:
            self._count, self._first_s, self._first_m = 0, time_s, place_m
        self._count += 1
        self._last_s = time_s
        return ends


def measurements_by(grouping: Grouping, scans: Iterable[tuple[float, Transform]]) -> tuple[range, ...]:
    """The indices of each measurement, of scans with these times and poses in turn."""
    group, starts, count = OpenGroup(grouping), [0], 0
    for count, (time_s, T_map_rig) in enumerate(scans, 1):
        if group.ends_before(time_s, T_map_rig):
            starts.append(count - 1)
    return tuple(range(*pair) for pair in zip(starts, [*starts[1:], count], strict=True)) if count else ()
