"""Node of the ROS 2 of this machine, by its rclpy: for raw messages, which stay as they were coded.

    source /opt/ros/jazzy/setup.bash        and cairn with the Python of that ROS, 3.11 or newer: not Humble's

rclpy and the packages of messages are looked for when a node is opened: cairn needs none of them otherwise.
"""

import importlib
from typing import Any

from cairn_map.errors import BadInputError

ROS_HELP = (
    "source the ROS of this machine first (source /opt/ros/$ROS_DISTRO/setup.bash), and run cairn with its Python, "
    "3.11 or newer; with Humble's 3.10, or without ROS here, use the Foxglove bridge: ws://HOST:8765"
)


class Ros2Node:
    """Node in a context of its own; rclpy is used by one thread."""

    def __init__(self, name: str, *, domain: int | None) -> None:
        """Join the network of ROS; `domain`: None: that of ROS_DOMAIN_ID.

        Raises:
            BadInputError: kind `no_ros2`: there is none in this Python.
        """
        try:
            rclpy: Any = importlib.import_module("rclpy")
            self.context: Any = rclpy.Context()
            rclpy.init(context=self.context, domain_id=domain)
            self.node: Any = rclpy.create_node(
                name, context=self.context, enable_rosout=False, start_parameter_services=False
            )
            self._qos: Any = importlib.import_module("rclpy.qos")
        except (ImportError, OSError, RuntimeError) as exc:
            raise BadInputError("no_ros2", f"this Python has no ROS 2 ({exc}); {ROS_HELP}") from exc

    def quality(self, *, depth: int, is_reliable: bool, is_latched: bool) -> Any:
        """Quality of service of a publisher or a subscription that keeps so many messages."""
        qos = self._qos
        return qos.QoSProfile(
            depth=depth,
            reliability=qos.ReliabilityPolicy.RELIABLE if is_reliable else qos.ReliabilityPolicy.BEST_EFFORT,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if is_latched else qos.DurabilityPolicy.VOLATILE,
        )

    def close(self) -> None:
        """Leave the network."""
        self.node.destroy_node()
        self.context.try_shutdown()


def message_type(kind: str) -> Any:
    """Class of a type of messages, such as sensor_msgs/msg/Image; None: this ROS has no package for it."""
    package, _, name = kind.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None
