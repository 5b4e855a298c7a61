"""Door of the ROS 2 of this machine: rclpy's subscriptions, whose messages stay as they were coded.

    source /opt/ros/jazzy/setup.bash
    cairn robot live ros2: --topics live.yaml --map URL       with the Python of that ROS, 3.11 or newer: not Humble's

Topics are asked for again and again, as nodes come and go. A subscription is reliable if all publishers of its topic
are, and asks for the messages that they keep if all keep some; if that changes it is made again. It matches every
publisher so.
"""

import importlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from cairn_client.live.inbox import Inbox
from cairn_client.live.live_source import bad_url, domain_of
from cairn_fusion.ros.bag import BagMessage, Topic, Wire
from cairn_fusion.ros.messages import CLOUDS, COMPRESSED, IMAGE, plain_type
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

SCHEME = "ros2:"
NODE = "cairn_live"
LOOK_S = 0.25
"""Time between two looks at which topics there are."""
SPIN_S = 0.1
CLOSE_S = 3.0
IMAGES, SMALL = 10, 500
"""Messages of a topic that ROS keeps until they are taken: of images and clouds, and of all others."""
LARGE = frozenset([IMAGE, COMPRESSED]) | CLOUDS
ROS_HELP = (
    "source the ROS of this machine first (source /opt/ros/$ROS_DISTRO/setup.bash), and run cairn with its Python, "
    "3.11 or newer; with Humble's 3.10, or without ROS here, use the Foxglove bridge: ws://HOST:8765"
)


class RclpySource:
    """Live source of the ROS 2 of this machine."""

    def __init__(self, url: str, *, inbox: Inbox | None = None, steady_s: Callable[[], float] = time.monotonic) -> None:
        """Args: url: ros2: or ros2:?domain=N.

        Raises:
            BadInputError: kind `bad_url`: it is none.
        """
        scheme, _, query = url.partition("?")
        try:
            self._domain = domain_of(query) if query else None
        except ValueError as exc:
            raise bad_url(url) from exc
        if scheme != SCHEME:
            raise bad_url(url)
        self.url = url
        self.links = 0
        self.damaged = 0
        """Always 0: ROS reads its own frames."""
        self.lost_since_s: float | None = None
        """Always None: there is no link to lose; topics come and go."""
        self._inbox = inbox or Inbox()
        self._lock = threading.Lock()
        self._wanted: Callable[[Topic], bool] = lambda topic: False
        self._topics: dict[str, Topic] = {}
        self._subscriptions: dict[str, tuple[tuple[str, bool, bool], Any]] = {}
        """Subscription of each topic, with its type, and whether it is reliable and latched."""
        self._unknown: set[str] = set()
        """Types of topics for which this ROS has no package."""
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics that have a publisher now, by name."""
        with self._lock:
            return dict(self._topics)

    @property
    def counts(self) -> Counter[str]:
        """Messages that came, by topic."""
        return self._inbox.counts

    @property
    def dropped(self) -> Counter[str]:
        """Messages that went for room here, by topic."""
        return self._inbox.dropped

    def open(self, wanted: Callable[[Topic], bool]) -> None:
        """Join the network of ROS, and receive from here on, in a thread of its own.

        Raises:
            BadInputError: kind `no_ros2`: there is none in this Python.
        """
        self._wanted = wanted
        try:
            rclpy: Any = importlib.import_module("rclpy")
            context = rclpy.Context()
            rclpy.init(context=context, domain_id=self._domain)
            node = rclpy.create_node(NODE, context=context, enable_rosout=False, start_parameter_services=False)
            executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor(context=context)
        except (ImportError, OSError, RuntimeError) as exc:
            raise BadInputError("no_ros2", f"this Python has no ROS 2 ({exc}); {ROS_HELP}") from exc
        executor.add_node(node)
        self.links = 1
        self._thread = threading.Thread(
            target=self._receive, args=(context, node, executor), name="cairn-live", daemon=True
        )
        self._thread.start()

    def take(self, *, within_s: float) -> list[BagMessage]:
        """All messages that wait, as soon as there are any."""
        return self._inbox.take(within_s=within_s)

    def close(self) -> None:
        """Leave; what waits may still be taken."""
        self._closing.set()
        self._inbox.close()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _receive(self, context: Any, node: Any, executor: Any) -> None:
        """Receive until `close`; all of rclpy is used by this thread alone."""
        look_s = 0.0
        try:
            while not self._closing.is_set():
                if time.monotonic() >= look_s:
                    self._look(node)
                    look_s = time.monotonic() + LOOK_S
                executor.spin_once(timeout_sec=SPIN_S)
        except Exception:
            log.exception("ROS 2 has ended")
            self.lost_since_s = time.monotonic()
        finally:
            executor.shutdown()
            node.destroy_node()
            context.try_shutdown()

    def _look(self, node: Any) -> None:
        """Take over which topics there are, and subscribe to those that are wanted."""
        topics = {}
        for name, kinds in node.get_topic_names_and_types():
            publishers = node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            topics[name] = topic = Topic(name, plain_type(kinds[0]), Wire.CDR, 0)
            if self._wanted(topic):
                is_reliable = all(one.qos_profile.reliability.name == "RELIABLE" for one in publishers)
                is_latched = all(one.qos_profile.durability.name == "TRANSIENT_LOCAL" for one in publishers)
                self._subscribe(node, name, kinds[0], is_reliable=is_reliable, is_latched=is_latched)
        with self._lock:
            self._topics = topics

    def _subscribe(self, node: Any, name: str, kind: str, *, is_reliable: bool, is_latched: bool) -> None:
        known = self._subscriptions.get(name)
        if kind in self._unknown or (known is not None and known[0] == (kind, is_reliable, is_latched)):
            return
        package, _, message = kind.partition("/msg/")
        try:
            message_type = getattr(importlib.import_module(f"{package}.msg"), message)
        except (ImportError, AttributeError):
            self._unknown.add(kind)
            log.warning("%s: this ROS has no package for %s; topics of it are left aside", self.url, kind)
            return
        if known is not None:
            node.destroy_subscription(known[1])
        qos: Any = importlib.import_module("rclpy.qos")
        profile = qos.QoSProfile(
            depth=IMAGES if plain_type(kind) in LARGE else SMALL,
            reliability=qos.ReliabilityPolicy.RELIABLE if is_reliable else qos.ReliabilityPolicy.BEST_EFFORT,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if is_latched else qos.DurabilityPolicy.VOLATILE,
        )
        subscription = node.create_subscription(
            message_type, name, lambda data, name=name: self._inbox.receive(name, bytes(data)), profile, raw=True
        )
        self._subscriptions[name] = (kind, is_reliable, is_latched), subscription
