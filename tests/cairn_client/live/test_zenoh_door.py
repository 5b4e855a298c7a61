"""A live robot over zenoh, with the keys of rmw_zenoh and of the DDS bridge: its map is that of a replay."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_run import MAKE, TOPICS, LiveRun, replay_digest, send_all
from tests.fixtures.client.live_server import wait_until
from tests.fixtures.client.zenoh_robot import a_zenoh_robot
from tests.fixtures.fusion.live_drive import START_S, depth, drive, latched, moving

from cairn_client.links.zenoh_keys import publisher_of, tokens_of
from cairn_client.live.live_doors import open_door
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.ros.bag import Topic, Wire
from cairn_map.errors import BadInputError

ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
IMAGE = "sensor_msgs::msg::dds_::Image_"


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"type_hash": "TypeHashNotSupported"}, {"is_bridge": True}])
def test_scans_over_zenoh_are_the_map_of_their_replay(options: dict[str, object], tmp_path: Path) -> None:
    timed = drive(MAKE, scans=200)
    with a_zenoh_robot(**options) as robot:  # type: ignore[arg-type]
        robot.offer_all(timed)
        run = LiveRun(robot, tmp_path / "live", timed, ScanGate(None))
        first = [next(entry for entry in timed if entry[1] == topic) for topic in TOPICS[1:]]
        send_all(run, [entry for entry in timed if not any(entry is one for one in first)])
        digest = run.finish()
    assert digest == replay_digest(tmp_path, timed, "--every-scan")
    assert run.live.taken + sum(run.scans.left_out.values()) == 200 and run.live.dropped == 0


def test_late_transforms_come_and_a_router_that_starts_again_is_found_again() -> None:
    with a_zenoh_robot() as robot:
        robot.offer("/tf_static", "tf2_msgs/msg/TFMessage")
        robot.latch(latched(MAKE))  # before it is subscribed
        source = open_door(robot.url)
        source.open(lambda topic: True)
        try:
            wait_until(lambda: source.counts["/tf_static"] == 1)
            robot.offer("/tf", "tf2_msgs/msg/TFMessage")
            robot.wait_for("/tf")
            robot.send(moving(MAKE, START_S))
            wait_until(lambda: source.counts["/tf"] == 1)
            robot.withdraw("/tf")
            wait_until(lambda: source.topics.keys() == {"/tf_static"})
            robot.stop()
            wait_until(lambda: source.lost_since_s is not None)
            robot.start()
            robot.offer("/tf", "tf2_msgs/msg/TFMessage")
            robot.wait_for("/tf")
            robot.send(moving(MAKE, START_S + 1))
            wait_until(lambda: source.counts["/tf"] == 2)
            wait_until(lambda: source.lost_since_s is None)
            assert source.links == 2
        finally:
            source.close()


def test_messages_that_the_network_lost_are_counted() -> None:
    with a_zenoh_robot() as robot:
        robot.offer("/depth/image", "sensor_msgs/msg/Image")
        source = open_door(robot.url)
        source.open(lambda topic: True)
        try:
            robot.wait_for("/depth/image")
            for n, skipped in enumerate((0, 0, 3, 0)):
                robot.send(depth(MAKE, START_S + n, n), skipped=skipped)
            wait_until(lambda: source.counts["/depth/image"] == 4)
            assert source.dropped == {"/depth/image": 3}
        finally:
            source.close()


def test_without_a_router_it_says_how_to_start_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cairn_client.links.zenoh_link.CONNECT_S", 0.1)
    source = open_door("zenoh://127.0.0.1:9")
    with pytest.raises(BadInputError, match="ros2 run rmw_zenoh_cpp rmw_zenohd") as caught:
        source.open(lambda topic: True)
    assert caught.value.kind == "no_router"
    source.close()


# Keys


def test_tokens_of_publishers_are_topics_and_the_keys_of_their_messages() -> None:
    def token(name: str, kind: str = IMAGE, quality: str = "::,5:,:,:,,", role: str = "MP") -> str:
        return f"@ros2_lv/0/{ZID}/0/11/{role}/%/%/driver/{name}/{kind}/{HASH}/{quality}"

    found = publisher_of(token("%camera%depth"))
    assert found is not None
    assert found.topic == Topic("/camera/depth", "sensor_msgs/Image", Wire.CDR, 0) and not found.is_latched
    assert found.key == f"0/camera/depth/{IMAGE}/*"
    latched_one = publisher_of(token("%tf_static", quality=":1:,1:,:,:,,"))
    assert latched_one is not None and latched_one.is_latched
    assert publisher_of(token("%tf", role="MS")) is None  # a subscriber
    assert publisher_of(token("%tf", kind="rcl_interfaces::srv::dds_::GetParameters_")) is None
    assert publisher_of(token("%a*b")) is None and publisher_of(token("%a%%b")) is None
    bridge = publisher_of(f"@/{ZID}/@ros2_lv/MP/bot1§camera§depth/sensor_msgs§msg§Image/:1:0:0,10")
    assert bridge is not None and not bridge.is_latched
    assert (bridge.topic.name, bridge.topic.type) == ("/bot1/camera/depth", "sensor_msgs/Image")
    assert bridge.key == "bot1/camera/depth"
    kept = publisher_of(f"@/{ZID}/@ros2_lv/MP/tf_static/tf2_msgs§msg§TFMessage/K:1:1:0,1")
    assert kept is not None and kept.is_latched
    for stranger in ("", "@/a", "@ros2_lv/0", f"@/{ZID}/@ros2_lv", "a/b/c", "@ros2_lv/" + "x/" * 600):
        assert publisher_of(stranger) is None
    assert tokens_of(3) == ("@ros2_lv/3/**", "@/*/@ros2_lv/**")
