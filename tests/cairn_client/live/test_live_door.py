"""A live robot through its Foxglove bridge: its map is that of a replay of the same messages, through restarts."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count, pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.bridge import Bridge, a_bridge
from tests.fixtures.client.live_run import MAKE, NOWHERE, TOPICS, VOXEL_M, LiveRun, replay_digest, send_all
from tests.fixtures.client.live_server import WAIT_S, LiveServer, wait_until
from tests.fixtures.client.made import MAP
from tests.fixtures.fusion.bags import Timed
from tests.fixtures.fusion.drive_mapping import LABELLED, mapping_text
from tests.fixtures.fusion.live_drive import drive, labelled, latched
from websockets.sync.server import ServerConnection, serve

from cairn_client import main as cairn
from cairn_client.cli.robots import live_run
from cairn_client.http.api import MapApi
from cairn_client.live.foxglove_source import FoxgloveSource
from cairn_client.live.live_opening import OpenedLive, open_live, survey_live
from cairn_client.live.live_source import LiveSource
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.scan_gate import GateBounds, ScanGate
from cairn_fusion.ros.bag_recording import Survey
from cairn_fusion.ros.live_scans import Cause
from cairn_fusion.ros.topic_mapping import BagMapping, mapping_from_yaml
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import classes_channel
from cairn_map.evidence.grid import geometry_for
from cairn_map.wire.layer_messages import AddLayer


@pytest.fixture
def bridge() -> Iterator[Bridge]:
    with a_bridge() as bridge:
        yield bridge


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [None, GateBounds()])
def test_200_scans_through_the_door_are_the_map_of_their_replay(
    bounds: GateBounds | None, bridge: Bridge, tmp_path: Path
) -> None:
    timed = drive(MAKE, scans=200)
    bridge.offer_all(timed)
    run = LiveRun(bridge, tmp_path / "live", timed, ScanGate(bounds))
    # The messages that opened it were sent once already.
    first = [next(entry for entry in timed if entry[1] == topic) for topic in TOPICS[1:]]
    send_all(run, [entry for entry in timed if not any(entry is one for one in first)])
    digest = run.finish()
    options = ["--every-scan"] if bounds is None else ["--scan-every-m", "0.05"]
    assert digest == replay_digest(tmp_path, timed, *options)
    left = sum(run.scans.left_out.values())
    assert run.live.taken + run.live.not_moved + left == 200 and run.live.dropped == 0
    assert (run.live.not_moved == 0) is (bounds is None)


KILLS = 20


@pytest.mark.slow
def test_a_bridge_that_is_killed_20_times_is_found_again_and_no_scan_comes_twice(
    bridge: Bridge, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cairn_client.live.foxglove_source.AGAIN_S", (0.02,))
    timed = drive(MAKE, scans=60)
    kinds = {topic: message.__msgtype__ for _, topic, message in timed}
    bridge.offer_all(timed)
    run = LiveRun(bridge, tmp_path / "live", timed, ScanGate(None))
    ends = [1 + (len(timed) - 1) * n // (KILLS + 1) for n in range(KILLS + 2)]
    order = np.random.default_rng(3)
    for start, end in pairwise(ends):
        # Some of what came before the kill comes again after it.
        send_all(run, timed[max(1, start - 12) : end])
        if end == len(timed):
            break
        bridge.stop()
        run.take_until(lambda: run.source.lost_since_s is not None)
        bridge.start()
        for topic in order.permutation(TOPICS).tolist():  # under other ids
            bridge.offer(topic, kinds[topic])
        bridge.latch(latched(MAKE))
        run.take_until(lambda: run.source.lost_since_s is None and all(bridge.subscribed[topic] for topic in TOPICS))
    assert run.source.links == KILLS + 1
    assert run.scans.left_out[Cause.AGAIN] > 10
    assert run.finish() == replay_digest(tmp_path, timed, "--every-scan")


def test_transforms_that_are_not_coded_as_ros_does_are_not_subscribed(bridge: Bridge, tmp_path: Path) -> None:
    timed = drive(MAKE, scans=3)
    bridge.offer("/foreign", "tf2_msgs/msg/TFMessage", encoding="json")
    bridge.offer_all(timed)
    run = LiveRun(bridge, tmp_path / "live", timed, ScanGate(None))
    assert "/foreign" in run.source.topics and "/foreign" not in run.opened.topics
    assert not bridge.subscribed["/foreign"]
    run.finish()


def test_what_goes_for_room_while_it_opens_is_counted(bridge: Bridge, tmp_path: Path) -> None:
    timed = drive(MAKE, scans=3)
    bridge.offer_all(timed)
    run = LiveRun(bridge, tmp_path / "live", timed, ScanGate(None), early_bytes_max=1)
    assert len(run.opened.early) == 1  # the newest
    assert run.opened.dropped.total() >= 5  # of the six that a rig is built from
    run.finish()


def test_the_channels_of_a_bridge_have_one_bound_over_all_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cairn_client.live.foxglove_source.CHANNELS_MAX", 3)

    def handle(link: ServerConnection) -> None:
        for first in (0, 2):
            channels = [{"id": first + n, "topic": f"/{first + n}", "encoding": "cdr"} for n in range(2)]
            link.send(json.dumps({"op": "advertise", "channels": channels}))
        for _ in link:
            pass

    with scripted(handle, subprotocols=["foxglove.sdk.v1"]) as url:
        source = FoxgloveSource(url)
        source.open(lambda topic: False)
        try:
            wait_until(lambda: source.damaged == 1)
            assert source.topics.keys() == {"/0", "/1"}
        finally:
            source.close()


def test_a_topic_that_is_offered_again_under_another_id_goes_on(bridge: Bridge) -> None:
    timed = drive(MAKE, scans=3)
    bridge.offer_all(timed)
    source = FoxgloveSource(bridge.url)
    source.open(lambda topic: topic.name == "/depth/image")
    try:
        bridge.wait_for("/depth/image")
        images = [entry for entry in timed if entry[1] == "/depth/image"]
        bridge.send(images[0])
        wait_until(lambda: source.counts["/depth/image"] == 1)
        bridge.subscribed.clear()
        bridge.offer("/depth/image", "sensor_msgs/msg/Image")
        bridge.wait_for("/depth/image")
        bridge.send(images[1])
        wait_until(lambda: source.counts["/depth/image"] == 2)
    finally:
        source.close()


# A stand-in where the SDK's server does no wrong


@contextmanager
def scripted(handle: Callable[[ServerConnection], None], *, subprotocols: Sequence[str] = ()) -> Iterator[str]:
    """A server of WebSockets; its URL."""
    with serve(handle, "127.0.0.1", 0, subprotocols=list(subprotocols) or None) as server:  # type: ignore[arg-type]
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def test_a_subscription_that_is_refused_right_after_the_advertisement_is_made_again() -> None:
    asked: list[dict[str, object]] = []

    def handle(link: ServerConnection) -> None:
        channel = {"id": 1, "topic": "/tf", "encoding": "cdr", "schemaName": "tf2_msgs/msg/TFMessage", "schema": ""}
        link.send(json.dumps({"op": "serverInfo", "name": "bridge", "capabilities": []}))
        link.send(json.dumps({"op": "advertise", "channels": [channel]}))
        for text in link:
            asked.append(json.loads(text))
            subscriptions = [a for a in asked if a["op"] == "subscribe"]
            if len(subscriptions) == 1 and asked[-1]["op"] == "subscribe":
                link.send(json.dumps({"op": "status", "level": 2, "message": "Unknown channel ID: 1"}))
            elif asked[-1]["op"] == "subscribe":
                number = asked[-1]["subscriptions"][0]["id"]  # type: ignore[index]
                link.send(b"\x01" + number.to_bytes(4, "little") + bytes(8) + b"tf")

    with scripted(handle, subprotocols=["foxglove.websocket.v1"]) as url:
        source = FoxgloveSource(url)
        source.open(lambda topic: True)
        try:
            wait_until(lambda: source.counts["/tf"] == 1)
        finally:
            source.close()
    ids = [a["subscriptions"][0]["id"] for a in asked if a["op"] == "subscribe"]  # type: ignore[index]
    assert len(ids) == len(set(ids)) == 2


# Bad input: one sentence, exit code 2, nothing mapped


def refused(
    capsys: pytest.CaptureFixture[str], folder: Path, url: str, *options: str, topics: str | None = None
) -> str:
    """The sentence of a live robot that does not begin."""
    path = folder / "live.yaml"
    path.write_text(mapping_text() if topics is None else topics)
    capsys.readouterr()
    command = ["robot", "live", url, "--topics", str(path), "--name", "mole", "--state", str(folder / "mole")]
    command += [] if "--map" in options else ["--map", NOWHERE]
    assert cairn.main([*command, "--voxel", str(VOXEL_M), *options]) == 2
    assert not (folder / "mole").exists()
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    return said


def test_no_bridge_and_what_is_none_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, tmp_path, "ws://127.0.0.1:9")
    assert "no Foxglove bridge answers at ws://127.0.0.1:9" in said and "ros2 launch foxglove_bridge" in said
    with scripted(lambda link: None) as url:  # as rosbridge: no subprotocol
        assert "speaks none of foxglove.sdk.v1" in refused(capsys, tmp_path, url)


@pytest.mark.parametrize(
    "url",
    [
        *("zenoh://", "zenoh://h/key", "rosbridge://h:9090", "ros2:?domain=x", "ros2:/depth"),
        *("ws://h:99999", "ws://h:abc", "ws://[::1", "ws://a..b:1"),
    ],
)
def test_what_is_no_url_of_a_bridge_is_refused(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "ws://HOST:PORT" in refused(capsys, tmp_path, url)
    assert cairn.main(["robot", "inspect", url]) == 2
    assert "[bad_url]" in (said := capsys.readouterr().err.strip()) and "\n" not in said


def test_a_server_of_http_is_no_bridge(server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "answers, but is no Foxglove bridge" in refused(capsys, tmp_path, server.url.replace("http", "ws"))


def test_topics_that_are_missing_silent_or_of_another_type_are_named(
    bridge: Bridge, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    timed = drive(MAKE, scans=3)
    offered: set[str] = {topic for topic in TOPICS if topic != "/warm/image"}

    def open_patiently(source: LiveSource, mapping: BagMapping) -> OpenedLive:
        """Open by a clock that stands still until the bridge has said what it offers."""
        clock = clock_after(lambda: offered <= source.topics.keys())
        return open_live(source, mapping, within_s=2.0, steady_s=clock)

    monkeypatch.setattr("cairn_client.cli.robots.live_run.open_live", open_patiently)
    bridge.offer_all(entry for entry in timed if entry[1] in offered)
    bridge.offer(steering := "/a\x1b[2J\nb", "std_msgs/msg/String")
    offered.add(steering)
    said = refused(capsys, tmp_path, bridge.url)
    assert "offers no topic /warm/image (images of camera warm); it offers " in said and "/colour/image" in said
    assert "\x1b" not in said
    offered.add("/warm/image")
    bridge.offer("/warm/image", "std_msgs/msg/String")
    assert "/warm/image of ws:" in (said := refused(capsys, tmp_path, bridge.url))
    assert "holds std_msgs/String; sensor_msgs/Image or" in said
    bridge.offer("/warm/image", "sensor_msgs/msg/Image", encoding="json")
    assert "coded neither as ROS 1 nor CDR" in refused(capsys, tmp_path, bridge.url)
    bridge.offer("/warm/image", "sensor_msgs/msg/Image")
    said = refused(capsys, tmp_path, bridge.url)
    assert "a publisher is there, nothing came in 2 s" in said and "/depth/image" in said


def clock_after(is_true: Callable[[], bool]) -> Callable[[], float]:
    """A clock that ticks 0.1 s at each look once something is true, or was waited for in vain."""
    ticks, end_s = count(1), time.monotonic() + WAIT_S
    return lambda: next(ticks) / 10 if is_true() or time.monotonic() > end_s else 0.0


def test_a_topics_file_with_a_question_is_refused(
    bridge: Bridge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, tmp_path, bridge.url, topics="# DECIDE: how many kelvin one count is\n" + mapping_text())
    assert "how many kelvin one count is" in said and "[undecided]" in said


@pytest.mark.slow
def test_a_map_of_another_grid_is_refused(
    bridge: Bridge, server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    timed = drive(MAKE, scans=3)
    bridge.offer_all(timed)
    sender = threading.Thread(target=send_when_subscribed, args=(bridge, timed))
    sender.start()
    said = refused(capsys, tmp_path, bridge.url, "--map", server.map_url, "--voxel", "0.03")
    sender.join()
    assert "[other_geometry]" in said and "leave --voxel out" in said


def test_labels_of_other_classes_than_the_layer_s_are_refused(
    bridge: Bridge,
    server: LiveServer,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    classes = classes_channel(("wall", "table"))
    with MapApi(server.url) as api:
        api.add_layer(MAP, AddLayer(name="things", geometry=geometry_for(voxel_edge_m=VOXEL_M, channels=(classes,))))
    timed = labelled(MAKE, drive(MAKE, scans=3))
    bridge.offer_all(timed)
    sender = threading.Thread(target=send_when_subscribed, args=(bridge, timed))
    sender.start()
    topics = mapping_text(**LABELLED)
    said = refused(capsys, tmp_path, bridge.url, "--map", f"{server.map_url}.things", topics=topics)
    sender.join()
    assert "[unknown_class]" in said
    # Without a link the folder of an earlier run knows them; its robot is not even opened, which would leave the map.
    grid = geometry_for(voxel_edge_m=VOXEL_M, channels=(classes,))
    Robot(None, NOWHERE, directory=tmp_path / "mole", name="mole", geometry=grid, stay=True).close()
    monkeypatch.setattr(live_run, "Robot", None)
    (tmp_path / "live.yaml").write_text(topics)
    where = ["--map", NOWHERE, "--name", "mole", "--state", str(tmp_path / "mole")]
    with a_bridge() as second:
        second.offer_all(timed)
        sender = threading.Thread(target=send_when_subscribed, args=(second, timed))
        sender.start()
        assert cairn.main(["robot", "live", second.url, "--topics", str(tmp_path / "live.yaml"), *where]) == 2
        sender.join()
    said = capsys.readouterr().err
    assert "[unknown_class]" in said and "the labels name chair, and the map's classes are wall, table, other" in said


def send_when_subscribed(bridge: Bridge, timed: Sequence[Timed]) -> None:
    bridge.wait_for(*{topic for _, topic, _ in timed})
    for entry in timed:
        bridge.send(entry)


# The command


@pytest.mark.slow
@pytest.mark.processes
def test_the_command_maps_until_a_signal_and_says_what_came(bridge: Bridge, tmp_path: Path) -> None:
    timed = drive(MAKE, scans=20)
    bridge.offer_all(timed)
    (tmp_path / "live.yaml").write_text(mapping_text())
    command = [sys.executable, "-m", "cairn_client.main", "robot", "live", bridge.url, "--topics", "live.yaml"]
    command += [
        "--map",
        NOWHERE,
        "--state",
        "live",
        "--name",
        "live",
        "--voxel",
        str(VOXEL_M),
        "--every-scan",
        "--json",
        "--record",
        "lab",
    ]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            assert running.stdout is not None
            first = next(n for n, entry in enumerate(timed) if entry[1] == "/depth/image") + 6
            bridge.wait_for(*TOPICS)
            bridge.latch(latched(MAKE))
            for entry in timed[:first]:
                bridge.send(entry)
            for topic in TOPICS[3:]:
                bridge.send(next(entry for entry in timed if entry[1] == topic))
            # The first scan loads the kernels, for which the others would wait too long.
            statuses = (json.loads(line) for line in running.stdout)
            assert next(status for status in statuses if status["taken"])["missing"] is not None
            for entry in timed[first:]:
                bridge.send(entry)
            last = next(status for status in statuses if status["arrived"] == 20 and not status["waiting"])
            running.send_signal(signal.SIGINT)
            out, err = running.communicate(timeout=60)
            assert running.returncode == 0, err
        finally:
            running.kill()  # a failed assertion would wait for it
    assert last["taken"] + sum(last["left_out"].values()) + last["dropped"] == 20
    assert {topic["topic"] for topic in last["topics"]} == set(TOPICS) and last["links"] == 1
    assert any("clock apart" in text for text in last["missing"])  # the stamps are of 2023
    assert json.loads(out.splitlines()[-1])["commits"] >= 1
    command = ["robot", "replay", str(tmp_path / "lab"), "--map", NOWHERE, "--state", str(tmp_path / "again")]
    assert cairn.main([*command, "--name", "again", "--voxel", str(VOXEL_M)]) == 0
    with (
        Robot(None, NOWHERE, directory=tmp_path / "live", name="live", stay=True) as live,
        Robot(None, NOWHERE, directory=tmp_path / "again", name="again", stay=True) as again,
    ):
        assert live.map.digest() == again.map.digest()


@pytest.mark.slow
def test_inspect_proposes_from_a_live_source_what_live_takes(
    bridge: Bridge, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    timed = [entry for entry in drive(MAKE, scans=20) if not entry[1].startswith("/warm")]

    def survey_all(source: LiveSource, *, seconds: float, on_message: Callable[[], object]) -> Survey:
        """Listen by a clock that stands still until all has come."""
        clock = clock_after(lambda: source.counts.total() >= len(timed))
        return survey_live(source, seconds=seconds, on_message=on_message, steady_s=clock)

    monkeypatch.setattr("cairn_client.live.live_opening.survey_live", survey_all)
    bridge.offer_all(timed)
    sender = threading.Thread(target=send_when, args=(bridge, timed))
    sender.start()
    topics = tmp_path / "live.yaml"
    assert cairn.main(["robot", "inspect", bridge.url, "--seconds", "2", "--output", str(topics)]) == 0
    sender.join()
    out = capsys.readouterr().out
    assert "/depth/image" in out and "16 x 12" in out and "odom ~> base_link -> depth_frame" in out
    text = topics.read_text()
    assert f"cairn robot live {bridge.url} --topics THIS_FILE" in text
    proposed = mapping_from_yaml(text, topics)
    assert {name: camera.topic for name, camera in proposed.cameras.items()} == {
        "depth": "/depth/image", "colour": "/colour/image",
    }  # fmt: skip
    with pytest.raises(BadInputError, match="no Foxglove bridge answers"):
        FoxgloveSource("ws://127.0.0.1:9").open(lambda topic: True)


def send_when(bridge: Bridge, timed: Sequence[Timed]) -> None:
    bridge.wait_for("/tf", "/tf_static", "/depth/image", "/colour/image", "/depth/info", "/colour/info")
    for entry in timed:
        bridge.send(entry)
