"""Publishing over zenoh: nodes get the very bytes by the keys of rmw_zenoh and of the DDS bridge, late or not."""

import queue
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from mcap.reader import make_reader
from tests.fixtures.client.floors import push_storey
from tests.fixtures.client.live_server import WAIT_S, LiveServer, wait_until
from tests.fixtures.client.zenoh_robot import ZenohRobot, a_zenoh_robot
from tests.fixtures.fusion.ros2_messages import vectors
from zenoh import ext

from cairn_client.cli.maps.command import main
from cairn_client.links.zenoh_keys import publisher_of, publisher_token
from cairn_client.live.live_doors import open_door
from cairn_client.publish import zenoh_sink
from cairn_client.publish.zenoh_sink import ZenohSink
from cairn_fusion.ros.bag import Topic, Wire
from cairn_fusion.ros.map_messages import GRID, MapMessage, grid_message
from cairn_map.errors import BadInputError
from cairn_map.queries.floor_grid import FloorGrid

TYPE = "nav_msgs::msg::dds_::OccupancyGrid_"
HASH = vectors()["jazzy"][GRID]["hash"]
KEY = f"7/map/{TYPE}/{HASH}"
HUMBLE = "TypeHashNotSupported"


def grid(value: int) -> MapMessage:
    floor = FloorGrid(np.full((2, 3), value, np.int8), edge_m=0.05, origin_m=(0.0, 1.0), ground_m=0.0)
    return grid_message("/map", floor, "map", 1_700_000_000_000_000_000)


class Node:
    """A node of the robot that subscribes as rmw_zenoh does: by its exact key, to what is kept for it, too."""

    def __init__(self, robot: ZenohRobot, key: str) -> None:
        self._came: queue.Queue[tuple[bytes, bytes]] = queue.Queue()
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        self._subscriber: Any = ext.declare_advanced_subscriber(robot.node, key, self._take, history=history)

    def _take(self, sample: "zenoh.Sample") -> None:
        assert sample.attachment is not None
        self._came.put((bytes(sample.payload), bytes(sample.attachment)))

    def next(self) -> tuple[bytes, bytes]:
        return self._came.get(timeout=WAIT_S)

    def newest(self, data: bytes) -> None:
        """Wait until these bytes came."""
        while self.next()[0] != data:
            pass


def declare_humble(robot: ZenohRobot) -> None:
    """A node of Humble, which says no hash of the type that it subscribes to, shows itself."""
    token = f"@ros2_lv/7/{robot.node.info.zid()}/0/9/MS/%/%/nav2/%map/{TYPE}/{HUMBLE}/:1:,1:,:,:,,"
    robot.node.liveliness().declare_token(token)


@pytest.fixture
def robot() -> Iterator[ZenohRobot]:
    with a_zenoh_robot() as robot:
        yield robot


@pytest.mark.parametrize("key", [KEY, "map"])
def test_a_node_that_comes_late_gets_the_newest_message_and_then_each(robot: ZenohRobot, key: str) -> None:
    early = Node(robot, key)
    with ZenohSink(robot.url) as sink:
        sink.send(grid(0)._replace(topic="/tf"))
        sink.send(grid(6))
        early.newest(grid(6).data)
        sink.send(grid(7))
        early.newest(grid(7).data)
        late = Node(robot, key)
        data, about = late.next()
        assert data == grid(7).data
        number, time_ns, size, sender = struct.unpack("<qqB16s", about)
        assert (number, time_ns, size) == (2, 1_700_000_000_000_000_000, 16) and any(sender)
        sink.send(grid(8))
        late.newest(grid(8).data)


def test_nodes_of_humble_get_them_under_keys_without_hashes(robot: ZenohRobot) -> None:
    humble, newer = Node(robot, KEY.replace(HASH, HUMBLE)), Node(robot, KEY)
    with ZenohSink(robot.url) as sink:
        sink.send(grid(1))
        newer.newest(grid(1).data)
        declare_humble(robot)
        humble.newest(grid(1).data)
        sink.send(grid(2))
        humble.newest(grid(2).data)


def failing_once(call: Callable[..., Any]) -> Callable[..., Any]:
    """The call, of which the first fails as zenoh's do."""
    errors = [zenoh.ZError("refused")]

    def called(*given: Any, **named: Any) -> Any:
        if errors:
            raise errors.pop()
        return call(*given, **named)

    return called


def test_a_message_that_zenoh_refused_is_sent_again(robot: ZenohRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_sink, "AGAIN_S", 0.0)
    monkeypatch.setattr(ZenohSink, "_put", failing_once(ZenohSink._put))
    with ZenohSink(robot.url) as sink:
        sink.send(grid(1))
        Node(robot, KEY).newest(grid(1).data)


def test_a_refusal_at_the_end_keeps_nothing_else_from_being_sent(
    robot: ZenohRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, came = ZenohSink._put, list[str]()

    def noted(sink: ZenohSink, message: MapMessage) -> None:
        came.append(message.topic)
        if message.topic == "/map":
            raise zenoh.ZError("refused")
        put(sink, message)

    monkeypatch.setattr(ZenohSink, "_put", noted)
    with ZenohSink(robot.url) as sink:
        for topic in ("/map", "/other"):
            sink.send(grid(1)._replace(topic=topic))
    assert set(came) == {"/map", "/other"} and not sink._thread.is_alive()


def test_a_node_of_humble_gets_all_after_an_error_as_it_came(
    robot: ZenohRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_sink, "AGAIN_S", 0.0)
    monkeypatch.setattr(ZenohSink, "_undeclare", failing_once(ZenohSink._undeclare))
    humble, newer = Node(robot, KEY.replace(HASH, HUMBLE)), Node(robot, KEY)
    with ZenohSink(robot.url) as sink:
        sink.send(grid(1))
        newer.newest(grid(1).data)
        declare_humble(robot)
        humble.newest(grid(1).data)


def test_a_router_that_starts_again_gets_the_newest_of_each_topic(robot: ZenohRobot) -> None:
    with ZenohSink(robot.url) as sink:
        sink.send(grid(1))
        Node(robot, KEY).newest(grid(1).data)
        robot.stop()
        sink.send(grid(2))
        robot.start()
        Node(robot, KEY).newest(grid(2).data)


def test_the_command_sends_all_that_it_writes_into_a_file(
    robot: ZenohRobot, server: LiveServer, tmp_path: Path
) -> None:
    push_storey(server, tmp_path / "wren", wall_x=2)
    came = dict[str, bytes]()

    def take(sample: "zenoh.Sample") -> None:
        came[str(sample.key_expr)] = bytes(sample.payload)

    hearers = [robot.node.declare_subscriber(key, take) for key in ("7/**", "map", "cairn/**")]
    words = ["publish", server.map_url, "--zenoh", robot.url, f"--mcap={tmp_path / 'a.mcap'}", "--changes=1"]
    assert main([*words, "--band=0.05,0.25"]) == 0
    with (tmp_path / "a.mcap").open("rb") as stream:
        written = {channel.topic: record.data for _, channel, record in make_reader(stream).iter_messages()}
    assert written.keys() > {"/map", "/cairn/points", "/cairn/changed_points"}
    wait_until(lambda: len(came) == 2 * len(written))
    assert {key: data for key, data in came.items() if not key.startswith("7/")} == {
        topic.removeprefix("/"): data for topic, data in written.items()
    }
    assert sorted(data for key, data in came.items() if key.startswith("7/")) == sorted(written.values())
    assert came[KEY] == written["/map"]
    del hearers


def test_a_door_of_ours_finds_what_is_published(robot: ZenohRobot) -> None:
    source = open_door(robot.url)
    with ZenohSink(robot.url) as sink:
        sink.send(grid(7))
        source.open(lambda topic: True)
        try:
            wait_until(lambda: source.counts["/map"] >= 1)
            assert source.topics == {"/map": Topic("/map", "nav_msgs/OccupancyGrid", Wire.CDR, 0)}
            assert bytes(source.take(within_s=0.0)[0].data) == grid(7).data
        finally:
            source.close()


def test_what_is_no_router_is_said_before_anything_is_published(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_client.links.zenoh_link.CONNECT_S", 0.1)
    with pytest.raises(BadInputError, match="ros2 run rmw_zenoh_cpp rmw_zenohd"):
        main(["publish", server.map_url, "--zenoh=zenoh://127.0.0.1:9", f"--mcap={tmp_path / 'a.mcap'}"])
    with pytest.raises(BadInputError, match="zenoh://HOST:PORT"):
        main(["publish", server.map_url, "--zenoh=ws://127.0.0.1:9", f"--mcap={tmp_path / 'a.mcap'}"])
    assert not list(tmp_path.glob("*.mcap*"))


def test_tokens_of_ours_are_read_as_those_of_rmw_zenoh() -> None:
    topic = Topic("/cairn/hot_spots", "visualization_msgs/MarkerArray", Wire.CDR, 0)
    found = publisher_of(publisher_token(7, "ab12", 3, topic, HASH))
    assert found is not None and found.topic == topic and found.is_latched
    assert found.key == "7/cairn/hot_spots/visualization_msgs::msg::dds_::MarkerArray_/*"
