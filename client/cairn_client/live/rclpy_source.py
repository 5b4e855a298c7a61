"""Door of the ROS 2 of this machine: rclpy's subscriptions, whose messages stay as they were coded.

    source /opt/ros/jazzy/setup.bash
    cairn robot live ros2: --topics live.yaml --map URL

Topics are asked for again and again, as nodes come and go. A subscription is reliable if all publishers of its topic
are, and asks for the messages that they keep if all keep some; if that changes it is made again. It matches every
publisher so.
"""

import importlib
import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

from cairn_client.links.link_url import domain_of
from cairn_client.links.ros2_node import Ros2Node, message_type
from cairn_client.live.inbox import Inbox
from cairn_client.live.live_source import LiveSource, bad_url
from cairn_fusion.ros.bag import Topic, Wire
from cairn_fusion.ros.messages import CLOUDS, COMPRESSED, IMAGE, plain_type

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


class RclpySource(LiveSource):
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
        super().__init__(url, inbox=inbox, steady_s=steady_s)
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

    def _connect(self) -> None:
        node = Ros2Node(NODE, domain=self._domain)
        self._note_link(is_there=True)
        self._thread = threading.Thread(target=self._receive, args=(node,), name="cairn-live", daemon=True)
        self._thread.start()

    def _disconnect(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _receive(self, node: Ros2Node) -> None:
        """Receive until `close`; from here on this thread alone uses rclpy."""
        try:
            with closing(node), ExitStack() as open_parts:
                executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor(context=node.context)
                open_parts.callback(executor.shutdown)
                executor.add_node(node.node)
                look_s = 0.0
                while not self._closing.is_set():
                    if time.monotonic() >= look_s:
                        self._look(node)
                        look_s = time.monotonic() + LOOK_S
                    executor.spin_once(timeout_sec=SPIN_S)
        except Exception:
            log.exception("ROS 2 has ended")
            self._note_link(is_there=False)

    def _look(self, node: Ros2Node) -> None:
        """Take over which topics there are, and subscribe to those that are wanted."""
        topics = {}
        for name, kinds in node.node.get_topic_names_and_types():
            publishers = node.node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            topics[name] = topic = Topic(name, plain_type(kinds[0]), Wire.CDR, 0)
            if self._wanted(topic):
                is_reliable = all(one.qos_profile.reliability.name == "RELIABLE" for one in publishers)
                is_latched = all(one.qos_profile.durability.name == "TRANSIENT_LOCAL" for one in publishers)
                self._subscribe(node, name, kinds[0], is_reliable=is_reliable, is_latched=is_latched)
        with self._lock:
            self._topics = topics

    def _subscribe(self, node: Ros2Node, name: str, kind: str, *, is_reliable: bool, is_latched: bool) -> None:
        known = self._subscriptions.get(name)
        if kind in self._unknown or (known is not None and known[0] == (kind, is_reliable, is_latched)):
            return
        kind_of_ros = message_type(kind)
        if kind_of_ros is None:
            self._unknown.add(kind)
            log.warning("%s: this ROS has no package for %s; topics of it are left aside", self.url, kind)
            return
        if known is not None:
            node.node.destroy_subscription(known[1])
        depth = IMAGES if plain_type(kind) in LARGE else SMALL
        profile = node.quality(depth=depth, is_reliable=is_reliable, is_latched=is_latched)
        subscription = node.node.create_subscription(
            kind_of_ros, name, lambda data, name=name: self._inbox.receive(name, bytes(data)), profile, raw=True
        )
        self._subscriptions[name] = (kind, is_reliable, is_latched), subscription
