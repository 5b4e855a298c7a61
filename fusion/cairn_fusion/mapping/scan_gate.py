"""Gate of scans: which of those that come become evidence, so that a robot at rest does not vote 15 times a second.

    scans     0 1 2 3 4 5 6 7 8 ...        a robot at rest, 15 Hz
    taken     0 . . . . . . . . ... 30     the first, then one every 2 s

Evidence counts scans: ten minutes at rest would be 9000 hits of each voxel in sight, which no later pass outweighs. A
scan is taken once the rig has moved, has turned, or some time has gone by, since the last scan taken of the same range
camera. Live robots and replays ask this module alone.
"""

from dataclasses import dataclass, field

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_map.errors import BadInputError


@dataclass(frozen=True, slots=True)
class GateBounds:
    """Bounds of which a scan must reach one to be taken."""

    step_m: float = 0.05
    """Way of the rig since the last scan taken, metres."""
    turn_deg: float = 3.0
    """Turn of the rig about any axis, degrees."""
    pause_s: float = 2.0
    """Time, seconds."""

    def __post_init__(self) -> None:
        if not min(self.step_m, self.turn_deg, self.pause_s) >= 0:
            raise BadInputError(
                "bad_option", f"a scan is taken after metres, degrees or seconds of 0 or more, got {self}"
            )


@dataclass(slots=True)
class ScanGate:
    """Gate that is asked about each scan in turn; None as bounds: every scan is taken."""

    bounds: GateBounds | None
    kept_out: int = 0
    """Scans that were not taken."""
    _last: dict[str, tuple[float, Transform]] = field(default_factory=dict)

    def takes(self, camera: str, time_s: float, T_map_rig: Transform) -> bool:
        """True if a scan is taken; the next one of its camera is compared with it then.

        Args:
            camera: range camera of the scan.
            time_s: of the scan, seconds; one before the last taken, as of a clock set back, is taken.
            T_map_rig: (4, 4) pose, metres.
        """
        last = self._last.get(camera)
        if self.bounds is not None and last is not None and not self._is_due(self.bounds, last, time_s, T_map_rig):
            self.kept_out += 1
            return False
        self._last[camera] = time_s, T_map_rig
        return True

    @staticmethod
    def _is_due(bounds: GateBounds, last: tuple[float, Transform], time_s: float, T_map_rig: Transform) -> bool:
        last_s, T_map_last = last
        if not 0 <= time_s - last_s < bounds.pause_s:
            return True
        step_m = float(np.linalg.norm(T_map_rig[:3, 3] - T_map_last[:3, 3]))
        return step_m >= bounds.step_m or _turn_deg(T_map_last, T_map_rig) >= bounds.turn_deg


def _turn_deg(T_map_first: Transform, T_map_second: Transform) -> float:
    """Angle between two poses, degrees."""
    # By the chord |R1 - R2|_F = sqrt(8) sin(angle / 2): the trace loses half of its digits at small angles.
    chord = float(np.linalg.norm(T_map_first[:3, :3] - T_map_second[:3, :3])) / np.sqrt(8)
    return float(np.degrees(2 * np.arcsin(min(1.0, chord))))
