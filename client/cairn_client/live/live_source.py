"""Live source: the topics of a robot with ROS and their messages, whatever door they come through.

    ws://HOST:PORT, wss://HOST:PORT      a Foxglove bridge                    `foxglove_source`
    zenoh://HOST:PORT[?domain=N]         a zenoh router                       `zenoh_source`
    ros2:[?domain=N]                     rclpy of this machine                `rclpy_source`

A door says which topics there are and brings the messages of those that are wanted, as ROS coded them. It knows nothing
of cameras and maps: one assembler decides for all doors (`cairn_fusion.ros.live_scans`).
"""

from collections import Counter
from collections.abc import Callable
from typing import Protocol

from cairn_fusion.ros.bag import BagMessage, Topic
from cairn_map.errors import BadInputError

SCHEMES = ("ws://", "wss://", "zenoh://", "ros2:")
"""Beginnings of the URLs of live sources."""
URL_HELP = (
    "a live source is ws://HOST:PORT or wss://HOST:PORT of a Foxglove bridge, zenoh://HOST:PORT of a zenoh router, or "
    "ros2: for the ROS 2 of this machine"
)


class LiveSource(Protocol):
    """Live source behind one URL; its messages are taken by one thread."""

    @property
    def url(self) -> str:
        """The URL, as it was given."""
        ...

    @property
    def links(self) -> int:
        """Times that a link was made."""
        ...

    @property
    def damaged(self) -> int:
        """Frames that were none of the protocol."""
        ...

    @property
    def lost_since_s(self) -> float | None:
        """Steady time since which there is no link; None: there is one."""
        ...

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics that are offered now, by name."""
        ...

    @property
    def counts(self) -> Counter[str]:
        """Messages that came, by topic."""
        ...

    @property
    def dropped(self) -> Counter[str]:
        """Messages that were lost on the way here, as far as the door numbers them, or went for room; by topic."""
        ...

    def open(self, wanted: Callable[[Topic], bool]) -> None:
        """Connect, and receive from here on.

        Args:
            wanted: True of the topics whose messages are wanted; asked about each that is offered, whenever it is.

        Raises:
            BadInputError: kind `no_bridge` or another: nothing answers there that brings messages.
        """
        ...

    def take(self, *, within_s: float) -> list[BagMessage]:
        """All messages that wait, as soon as there are any."""
        ...

    def close(self) -> None:
        """End the link; what waits may still be taken."""
        ...


def bad_url(url: str) -> BadInputError:
    """Error of a URL that is none of a live source."""
    return BadInputError("bad_url", f"{URL_HELP}; got {url!r:.200}")
