"""A real ROS 2: what its nodes send is mapped as its replay, and it reads what we write."""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.bridge import Bridge
from tests.fixtures.client.live_run import MAKE, VOXEL_M, LiveRun, replay_digest, send_all
from tests.fixtures.client.live_server import wait_until
from tests.fixtures.fusion.bags import Timed
from tests.fixtures.fusion.drive_mapping import mapping_text
from tests.fixtures.fusion.live_drive import drive, wire_of
from tests.fixtures.fusion.ros2_messages import MESSAGES, rosbags_message, store, vectors, without_padding

from cairn_client.live.live_doors import open_door
from cairn_client.publish.map_publisher import path_topic
from cairn_client.publish.ros2_sink import Ros2Sink
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.ros.map_messages import MapMessage, RobotPose, grid_message, path_message
from cairn_fusion.ros.topic_mapping import mapping_from_yaml
from cairn_map.evidence.channels import COLOUR
from cairn_map.evidence.grid import geometry_for
from cairn_map.queries.floor_grid import FloorGrid

rclpy = pytest.importorskip("rclpy", reason="this Python has no ROS 2: `make test-ros2` has one")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from tests.ros2.ros_messages import ros_message, type_of  # noqa: E402

DOMAIN = 77
# The wheels have no tf2_msgs: poses are odometry, and cameras stand where the file says.
T_BASE_CAMERA = [[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]]
CAMERAS = {
    "depth": {"spectrum": "range", "topic": "/depth/image", "info": "/depth/info", "T_base_camera": T_BASE_CAMERA},
    "colour": {"spectrum": "colour", "topic": "/colour/image", "info": "/colour/info", "T_base_camera": T_BASE_CAMERA},
}
CHANGES = {"cameras": CAMERAS, "poses": {"topic": "/odom", "max_gap_s": 0.3}}
MAPPING = mapping_from_yaml(mapping_text(**CHANGES), "drive")
TOPICS = ("/odom", "/depth/image", "/depth/info", "/colour/image", "/colour/info")


def timed_drive(scans: int) -> list[Timed]:
    """The drive with its way as odometry, without the topics that the wheels have no types for."""
    found = []
    for time_s, topic, message in drive(MAKE, scans=scans):
        if topic == "/tf":
            t, q = message.transforms[0].transform.translation, message.transforms[0].transform.rotation
            pose = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
            found.append((time_s, "/odom", MAKE.odometry(time_s, "odom", "base_link", pose)))
        elif topic in TOPICS:
            found.append((time_s, topic, message))
    return found


class RosRobot:
    """A node of the real ROS whose publishers are reliable."""

    url = f"ros2:?domain={DOMAIN}"

    def __init__(self, timed: Sequence[Timed]) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self._node = rclpy.create_node("driver", context=self._context)
        self._publishers: dict[str, Any] = {}
        for topic, kind in {topic: message.__msgtype__ for _, topic, message in timed}.items():
            kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.endswith("/info") else DurabilityPolicy.VOLATILE
            profile = QoSProfile(depth=4096, reliability=ReliabilityPolicy.RELIABLE, durability=kept)
            self._publishers[topic] = self._node.create_publisher(type_of(kind), topic, profile)

    def send(self, entry: Timed) -> None:
        """Send a message as ROS itself codes it."""
        _, topic, message = entry
        self._publishers[topic].publish(deserialize_message(wire_of(message), type_of(message.__msgtype__)))

    def wait_for(self, *topics: str) -> None:
        wait_until(lambda: all(self._publishers[topic].get_subscription_count() for topic in topics))

    def latch(self, entry: Timed) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()


class BridgedRobot:
    """The same node behind a bridge, which hands on what it takes raw."""

    def __init__(self, timed: Sequence[Timed]) -> None:
        self._robot, self._bridge = RosRobot(timed), Bridge()
        self._bridge.offer_all(timed)
        self.url = self._bridge.url
        self._source = open_door(RosRobot.url)
        self._source.open(lambda topic: topic.name in TOPICS)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._relay)
        self._thread.start()

    def _relay(self) -> None:
        while not self._is_over.is_set():
            for message in self._source.take(within_s=0.1):
                self._bridge.relay(message.topic, bytes(message.data))

    def send(self, entry: Timed) -> None:
        self._robot.send(entry)

    def wait_for(self, *topics: str) -> None:
        self._robot.wait_for(*topics)
        self._bridge.wait_for(*topics)

    def latch(self, entry: Timed) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self._is_over.set()
        self._thread.join()
        self._source.close()
        self._bridge.stop()
        self._robot.close()


def published() -> list[MapMessage]:
    """Messages of a map whose types the wheels have."""
    floor = FloorGrid(np.arange(6, dtype=np.int8).reshape(2, 3), edge_m=0.05, origin_m=(0.0, 1.0), ground_m=0.5)
    pose = RobotPose(1.7e9, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    time_ns = 1_700_000_000_123_456_789
    return [
        grid_message("/map", floor, "map", time_ns),
        path_message(path_topic("2-mole"), [pose], "map", time_ns),
    ]


@pytest.mark.parametrize("door", [RosRobot, BridgedRobot])
def test_200_scans_of_a_node_are_the_map_of_their_replay(
    door: type[RosRobot] | type[BridgedRobot], tmp_path: Path
) -> None:
    timed = timed_drive(200)
    robot = door(timed)
    grid = geometry_for(voxel_edge_m=VOXEL_M, channels=(COLOUR,))
    try:
        run = LiveRun(robot, tmp_path / "live", timed, ScanGate(None), topics=TOPICS, mapping=MAPPING, grid=grid)
        first = [next(entry for entry in timed if entry[1] == topic) for topic in TOPICS[1:]]
        send_all(run, [entry for entry in timed if not any(entry is one for one in first)], at_once=20)
        digest = run.finish()
    finally:
        robot.close()
    assert digest == replay_digest(tmp_path, timed, "--every-scan", topics=mapping_text(**CHANGES))
    assert run.live.taken + sum(run.scans.left_out.values()) == 200 and run.live.dropped == 0


@pytest.mark.parametrize("kind", sorted(MESSAGES))
def test_ros_writes_the_vectors_of_its_distribution_and_reads_ours(kind: str) -> None:
    data = without_padding(kind, bytes(serialize_message(ros_message(kind, MESSAGES[kind]))))
    known = [bytes.fromhex(kinds[kind]["bytes"]) for kinds in vectors().values()]
    assert data in [without_padding(kind, one) for one in known]
    ours = bytes(store().serialize_cdr(rosbags_message(kind, MESSAGES[kind]), kind))
    again = bytes(serialize_message(deserialize_message(ours, type_of(kind))))
    assert without_padding(kind, again) == ours == data


@pytest.mark.parametrize("message", published(), ids=lambda message: message.topic)
def test_a_node_gets_what_is_published_late_and_codes_it_to_our_bytes(message: MapMessage) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    came: list[bytes] = []
    with Ros2Sink(domain=DOMAIN) as sink:
        sink.send(message._replace(topic="/tf"))
        sink.send(message._replace(topic="/cairn/octomap", type_name="octomap_msgs/msg/Octomap"))  # no package here
        sink.send(message)
        node = rclpy.create_node("nav2", context=context)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(type_of(message.type_name), message.topic, came.append, latched, raw=True)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)

        def has_come() -> bool:
            executor.spin_once(timeout_sec=0.05)
            return bool(came)

        try:
            wait_until(has_come)
            topics = dict(node.get_topic_names_and_types())
        finally:
            executor.shutdown()
            node.destroy_node()
            context.try_shutdown()
    assert message.topic in topics and "/tf" not in topics
    assert bytes(came[0]) == message.data
    ros = deserialize_message(message.data, type_of(message.type_name))
    assert without_padding(message.type_name, bytes(serialize_message(ros))) == message.data


def test_what_a_node_keeps_comes_through_our_door() -> None:
    kind = "nav_msgs/msg/OccupancyGrid"
    ours = bytes(store().serialize_cdr(rosbags_message(kind, MESSAGES[kind]), kind))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = rclpy.create_node("map_server", context=context)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(type_of(kind), "/map", latched).publish(deserialize_message(ours, type_of(kind)))
    source = open_door(RosRobot.url)
    came: list[bytes] = []
    source.open(lambda topic: topic.name == "/map")
    try:
        wait_until(lambda: bool(came.extend(bytes(one.data) for one in source.take(within_s=0.1)) or came))
    finally:
        source.close()
        node.destroy_node()
        context.try_shutdown()
    assert without_padding(kind, came[0]) == ours
    assert not [thread for thread in threading.enumerate() if thread.name == "cairn-live"]
