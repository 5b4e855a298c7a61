"""Publishing in the ROS 2 of this machine: its nodes get the map as topics, also those that come late.

    source /opt/ros/jazzy/setup.bash
    cairn map publish URL --ros2

Messages are handed to rclpy as they are coded. A topic for whose type this ROS has no package is left out, and named.
"""

import logging
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

from cairn_client.links.ros2_node import Ros2Node, message_type
from cairn_client.publish.newest_messages import LEFT_OUT
from cairn_fusion.ros.map_messages import MapMessage

log = logging.getLogger(__name__)

NODE = "cairn"


class Ros2Sink:
    """Sink for a `with` block; messages are sent by one thread."""

    def __init__(self, *, domain: int | None = None) -> None:
        """Args: domain: None: that of ROS_DOMAIN_ID, as any node's."""
        self._domain = domain
        self._open = ExitStack()
        self._publishers: dict[str, Any] = {}
        """Publisher of each topic; None: it is left out."""

    def __enter__(self) -> Self:
        """Join the network of ROS.

        Raises:
            BadInputError: kind `no_ros2`: there is none in this Python.
        """
        self._node = Ros2Node(NODE, domain=self._domain)
        self._open.callback(self._node.close)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    def send(self, message: MapMessage) -> None:
        """Publish a message, which stays the topic's until the next one."""
        if message.topic in LEFT_OUT:
            return
        if message.topic not in self._publishers:
            self._publishers[message.topic] = self._publisher_of(message)
        if (publisher := self._publishers[message.topic]) is not None:
            publisher.publish(message.data)

    def _publisher_of(self, message: MapMessage) -> Any:
        kind = message_type(message.type_name)
        if kind is None:
            log.warning("this ROS has no package for %s: %s is left out", message.type_name, message.topic)
            return None
        profile = self._node.quality(depth=1, is_reliable=True, is_latched=True)
        return self._node.node.create_publisher(kind, message.topic, profile)
