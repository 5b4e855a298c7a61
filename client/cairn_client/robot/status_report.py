"""Status report of a robot, sent as it syncs: its pose, what waits, its battery. A lost report costs nothing.

A robot whose status does not change sends it once a minute, and not with every sync: each is one more request.
"""

import logging
import math
import time
from dataclasses import dataclass

from pydantic import ValidationError

from cairn_client.http.api import MapApi
from cairn_client.replica.replica import Replica
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import CairnError, first_error
from cairn_map.wire.messages import Mode, RobotStatus

log = logging.getLogger(__name__)

STEP_M, SPEED_M_PER_S = 10.0, 100.0
"""Step between two scans and its speed, both of which a doubted step exceeds."""
TELL_AGAIN_S = 60.0
"""Seconds after which a status that did not change is sent again."""


@dataclass(slots=True)
class OwnStatus:
    """A robot's report of itself: set its fields at any time; the next sync sends them if they changed."""

    pose: ScanPose | None = None
    """Pose of the robot: that of the last scan, unless a program sets a better one."""
    battery: float | None = None
    """Charge of the battery, 0 to 1; None if unknown."""
    note: str = ""
    """Any other text for people, up to 256 characters."""
    every_s: float = 0.0
    """Least seconds between two reports, whatever is new."""
    _sent: RobotStatus | None = None
    _scan: ScanPose | None = None
    """Pose of the last scan."""

    def place_at(self, pose: ScanPose) -> None:
        """Note the pose of the newest scan; a step that no robot makes is logged, and taken as it is."""
        before, self._scan, self.pose = self._scan, pose, pose
        if before is None:
            return
        step_m, time_s = math.dist(before.t_map_rig, pose.t_map_rig), pose.time_s - before.time_s
        if step_m > STEP_M and step_m > SPEED_M_PER_S * abs(time_s):
            log.warning(
                "T_map_rig moved %.1f m in %.3g s from one scan to the next: is it in metres, and of the same frame? "
                "The scan is taken as it is",
                step_m,
                time_s,
            )

    def place(self) -> tuple[float, float, float] | None:
        """Position of the robot, metres, map frame; None if it is unknown."""
        return self.pose.t_map_rig if self.pose else None

    def send(self, replica: Replica, api: MapApi, map_name: str, *, branch: str, mode: Mode) -> None:
        """Send the report, unless the same was sent lately; a failure is logged and is no failure of the sync."""
        try:
            waiting, waiting_bytes = replica.backlog()
            status = RobotStatus(
                time_s=time.time(),
                pose=self.pose,
                mode=mode,
                waiting=waiting,
                waiting_bytes=waiting_bytes,
                battery=self.battery,
                note=self.note,
            )
            if self._sent is None or _is_due(status, self._sent, every_s=self.every_s):
                api.put_status(map_name, branch, status)
                self._sent = status
        except ValidationError as exc:
            log.warning("this robot's status cannot be sent: %s", first_error(exc))
        except CairnError as exc:
            log.info("this robot's status was not taken: %s: %s", exc.kind, exc.message)


def _is_due(status: RobotStatus, sent: RobotStatus, *, every_s: float) -> bool:
    """True if the last report is old, or says anything else and is not too recent."""
    age_s = status.time_s - sent.time_s
    if 0 <= age_s < every_s:
        return False
    is_old = not 0 <= age_s < TELL_AGAIN_S
    return is_old or status.model_copy(update={"time_s": sent.time_s}) != sent
