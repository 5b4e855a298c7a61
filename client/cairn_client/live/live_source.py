"""Live source: the topics of a robot with ROS and their messages, whatever door they come through.

    ws://HOST:PORT, wss://HOST:PORT      a Foxglove bridge                    `foxglove_source`
    zenoh://HOST:PORT[?domain=N]         a zenoh router                       `zenoh_source`
    ros2:[?domain=N]                     rclpy of this machine                `rclpy_source`

A door says which topics there are and brings the messages of those that are wanted, as ROS coded them. It knows nothing
of cameras and maps: one assembler decides for all doors (`cairn_fusion.ros.live_scans`).
"""

import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable

from cairn_client.live.inbox import Inbox
from cairn_fusion.ros.bag import BagMessage, Topic
from cairn_map.errors import BadInputError

SCHEMES = ("ws://", "wss://", "zenoh://", "ros2:")
"""Beginnings of the URLs of live sources."""
URL_HELP = (
    "a live source is ws://HOST:PORT or wss://HOST:PORT of a Foxglove bridge, zenoh://HOST:PORT of a zenoh router, or "
    "ros2: for the ROS 2 of this machine"
)


class LiveSource(ABC):
    """Live source behind one URL; its messages are taken by one thread.

    A door is a subclass: a thread of its own puts the messages of what is `_wanted` into `_inbox`.
    """

    def __init__(self, url: str, *, inbox: Inbox | None = None, steady_s: Callable[[], float] = time.monotonic) -> None:
        """Open nothing yet.

        Args:
            url: of the source, as it was given.
            inbox: takes the messages.
            steady_s: clock.
        """
        self.url = url
        self.links = 0
        """Times that a link was made."""
        self.damaged = 0
        """Frames that were none of the protocol."""
        self.lost_since_s: float | None = None
        """Steady time since which there is no link; None: there is one."""
        self._inbox = inbox or Inbox()
        self._steady_s = steady_s
        self._lock = threading.Lock()
        self._wanted: Callable[[Topic], bool] = lambda topic: False

    @property
    @abstractmethod
    def topics(self) -> dict[str, Topic]:
        """Topics that are offered now, by name."""

    @property
    def counts(self) -> Counter[str]:
        """Messages that came, by topic."""
        return self._inbox.counts

    @property
    def dropped(self) -> Counter[str]:
        """Messages that were lost on the way here, as far as the door numbers them, or went for room; by topic."""
        return self._inbox.dropped

    def open(self, wanted: Callable[[Topic], bool]) -> None:
        """Connect, and receive from here on.

        Args:
            wanted: True of the topics whose messages are wanted; asked about each that is offered, whenever it is.

        Raises:
            BadInputError: kind `no_bridge` or another: nothing answers there that brings messages.
        """
        self._wanted = wanted
        self._connect()

    def take(self, *, within_s: float) -> list[BagMessage]:
        """All messages that wait, as soon as there are any."""
        return self._inbox.take(within_s=within_s)

    def close(self) -> None:
        """End the link; what waits may still be taken."""
        self._inbox.close()
        self._disconnect()

    def _note_link(self, *, is_there: bool) -> None:
        """Note whether there is a link now."""
        if is_there and (not self.links or self.lost_since_s is not None):
            self.lost_since_s, self.links = None, self.links + 1
        elif not is_there and self.lost_since_s is None:
            self.lost_since_s = self._steady_s()

    @abstractmethod
    def _connect(self) -> None:
        """Connect, and begin to receive in a thread.

        Raises:
            BadInputError: see `open`.
        """

    @abstractmethod
    def _disconnect(self) -> None:
        """End the thread and the link, if there are any."""


def bad_url(url: str) -> BadInputError:
    """Error of a URL that is none of a live source."""
    return BadInputError("bad_url", f"{URL_HELP}; got {url!r:.200}")
