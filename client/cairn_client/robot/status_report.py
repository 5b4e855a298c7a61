"""What a robot tells of itself as it syncs: where it is, what waits, how it is doing. Losing one costs nothing.

A robot that stands still says so once a minute, and not with every sync: each is a request more.
"""

import logging
import time
from dataclasses import dataclass

from pydantic import ValidationError

from cairn_client.http.api import MapApi
from cairn_client.replica.replica import Replica
from cairn_map.commits.commit import ScanPose
from cairn_map.errors import CairnError, first_error
from cairn_map.wire.messages import Mode, RobotStatus

log = logging.getLogger(__name__)

TELL_AGAIN_S = 60.0
"""A status that did not change is told again after this."""


@dataclass(slots=True)
class OwnStatus:
    """Set its fields at any time; the next sync tells them if they are others than the last ones."""

    pose: ScanPose | None = None
    """Of the last scan, unless something better is known."""
    battery: float | None = None
    """Charge, 0 to 1."""
    note: str = ""
    """Anything else for people, to 256 characters."""
    every_s: float = 0.0
    """Not told more often than this, whatever is new."""
    _told: RobotStatus | None = None

    def place_at(self, pose: ScanPose) -> None:
        """Note the pose of the newest scan."""
        self.pose = pose

    def place(self) -> tuple[float, float, float] | None:
        """Where the robot is, metres, map frame; None if it did not say."""
        return self.pose.t_map_rig if self.pose else None

    def tell(self, replica: Replica, api: MapApi, map_name: str, *, branch: str, mode: Mode) -> None:
        """Send it, unless it was told of late; a failure is logged and is no failure of the sync."""
        try:
            with replica.lock:
                waiting = replica.push_set()
                waiting_bytes = replica.store.data_bytes(waiting)
            status = RobotStatus(
                time_s=time.time(),
                pose=self.pose,
                mode=mode,
                waiting=len(waiting),
                waiting_bytes=waiting_bytes,
                battery=self.battery,
                note=self.note,
            )
            if self._told is None or _says_more(status, self._told, every_s=self.every_s):
                api.put_status(map_name, branch, status)
                self._told = status
        except ValidationError as exc:
            log.warning("this robot's status cannot be told: %s", first_error(exc))
        except CairnError as exc:
            log.info("this robot's status was not taken: %s: %s", exc.kind, exc.message)


def _says_more(status: RobotStatus, told: RobotStatus, *, every_s: float) -> bool:
    """Whether it is old, or says anything else than the one before, if it may already."""
    age_s = status.time_s - told.time_s
    if 0 <= age_s < every_s:
        return False
    is_old = not 0 <= age_s < TELL_AGAIN_S
    return is_old or status.model_copy(update={"time_s": told.time_s}) != told
