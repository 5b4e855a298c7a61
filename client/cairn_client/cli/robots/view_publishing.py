"""A robot's live view for the team: each picture goes to the map's server, whose page shows the last one.

Through the server, not from the robot's own stream: so operators need reach no robot, the server's tokens say who may
look, and the page loads pictures from nowhere else. A picture that does not get through is not sent again: the next one
is newer. Where the server says when it takes pictures again, none is sent before.
"""

import logging
import math
import time
from collections.abc import Iterable

from cairn_client.http.api import MapApi
from cairn_fusion.view.mjpeg import Latest
from cairn_map.arrays import Rgb
from cairn_map.errors import UnreachableError

log = logging.getLogger(__name__)


def publish_views(pictures: Iterable[Rgb], api: MapApi, map_name: str, branch: str) -> tuple[int, int]:
    """Send pictures, (H, W, 3) uint8, R, G, B, as they come; how many went through, and how many did not.

    Raises:
        CairnError: the server refuses them: the robot is not registered, or this is not its token.
    """
    latest = Latest()
    sent = lost = 0
    again_s = -math.inf
    for picture in pictures:
        if time.monotonic() < again_s:
            lost += 1
            continue
        latest.show(picture)
        try:
            api.put_view(map_name, branch, latest.jpeg)
            sent += 1
        except UnreachableError as exc:
            lost += 1
            again_s = time.monotonic() + (exc.retry_after_s or 0.0)
            log.warning("picture %d of %s was not sent: %s", sent + lost, branch, exc.message)
    return sent, lost
