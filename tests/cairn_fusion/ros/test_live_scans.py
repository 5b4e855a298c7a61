"""Live scans: messages in any order become the scans of a replay, and what becomes none says why."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.fusion.bags import ROS2, Messages, Timed, write_bag
from tests.fixtures.fusion.drive_mapping import LABEL_KINDS, LABELLED, TOPICS, mapping_text
from tests.fixtures.fusion.live_drive import START_S, bag_message, depth, drive, in_bag_order, labelled, latched, moving

from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.scan_bytes import encode_scan
from cairn_fusion.ros.bag import BagMessage, Topic, Wire
from cairn_fusion.ros.bag_recording import BagRecording, open_bag_recording
from cairn_fusion.ros.live_frames import LiveFrames
from cairn_fusion.ros.live_scans import Cause, LiveScans, ReadyScan
from cairn_fusion.ros.messages import RosTransform
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import BagMapping, mapping_from_yaml
from cairn_map.errors import BadInputError

MAKE = Messages(ROS2)
DRIVE = drive(MAKE)
MAPPING = mapping_from_yaml(mapping_text(), "drive")


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> BagRecording:
    path = write_bag(tmp_path_factory.mktemp("bags") / "drive", "mcap", lambda make: in_bag_order(DRIVE))
    return open_bag_recording(path, MAPPING)


def live(**options: float) -> LiveScans:
    return LiveScans("drive", MAPPING, TOPICS, **options)  # type: ignore[arg-type]


def decoded(
    ready: Sequence[ReadyScan], rig: Rig, mapping: BagMapping = MAPPING, topics: Mapping[str, Topic] = TOPICS
) -> list[bytes]:
    decoder = ScanDecoder("drive", mapping, rig, topics)
    scans = [decoder.decode(one.found, one.messages.__getitem__, one.pose_at) for one in ready]
    return [encode_scan(scan) for scan in sorted(scans, key=lambda scan: scan.time_s)]


def received(scans: LiveScans, timed: Sequence[Timed], delays_s: Sequence[float]) -> list[ReadyScan]:
    """Scans of messages that come so much later than their stamps, those of each topic in their order."""
    arrivals: list[tuple[float, int]] = []
    last_s: dict[str, float] = {}
    for n, ((time_s, topic, _), delay_s) in enumerate(zip(timed, delays_s, strict=True)):
        last_s[topic] = max(time_s + delay_s, last_s.get(topic, -np.inf))
        arrivals.append((last_s[topic], n))
    found: list[ReadyScan] = []
    for arrival_s, n in sorted(arrivals):
        scans.add(bag_message(timed[n]), arrival_s)
        found += scans.ready(arrival_s)
    return [*found, *scans.ready(np.inf, is_over=True)]


@pytest.mark.parametrize("seed", range(5))
def test_in_any_order_of_topics_the_scans_are_those_of_a_replay(replay: BagRecording, seed: int) -> None:
    scans = live()
    delays_s = np.random.default_rng(seed).uniform(0, 0.3, len(DRIVE))
    ready = received(scans, DRIVE, delays_s.tolist())
    assert decoded(ready, replay.rig) == [encode_scan(scan) for scan in replay]
    assert sum(scans.arrived.values()) == 40 == len(ready) + sum(scans.left_out.values())


def test_label_images_are_waited_for_and_go_with_the_scans_of_a_replay(tmp_path: Path) -> None:
    timed = labelled(MAKE, drive(MAKE, scans=12))
    mapping = mapping_from_yaml(mapping_text(**LABELLED), "drive")
    topics = TOPICS | {topic: Topic(topic, kind, Wire.CDR, 0) for topic, kind in LABEL_KINDS.items()}
    path = write_bag(tmp_path / "drive", "mcap", lambda make: in_bag_order(timed))
    replay = open_bag_recording(path, mapping)
    scans = LiveScans("drive", mapping, topics)
    # A network takes its time; nothing else comes late.
    ready = received(scans, timed, [0.3 if topic.endswith("labels") else 0.0 for _, topic, _ in timed])
    assert decoded(ready, replay.rig, mapping, topics) == [encode_scan(scan) for scan in replay]
    labels = [{*scan.labels} for scan in replay]
    assert all("depth" in each for each in labels) and {"depth", "colour"} in labels
    assert sum(one.found.images.keys() == one.messages.keys() for one in ready) == len(ready) == len(replay)


def test_each_scan_is_out_before_the_drive_is_over(replay: BagRecording) -> None:
    scans, early = live(), 0
    for entry in DRIVE:
        scans.add(bag_message(entry), entry[0])
        early += len(list(scans.ready(entry[0])))
    assert early >= len(replay) - 2
    assert scans.waiting <= 2


def test_images_that_come_again_after_a_reconnect_are_no_second_scan() -> None:
    scans = live()
    once = received(scans, DRIVE, [0.0] * len(DRIVE))
    assert received(scans, DRIVE, [10.0] * len(DRIVE)) == []
    assert scans.left_out[Cause.AGAIN] == 40
    assert len(once) == 40 - sum(count for cause, count in scans.left_out.items() if cause is not Cause.AGAIN)


# By cause


def left(*timed: Timed, wait_s: float = 0.6) -> LiveScans:
    """The assembler after these messages and a wait."""
    scans = live()
    for entry in timed:
        scans.add(bag_message(entry), entry[0])
    list(scans.ready(timed[-1][0] + wait_s))
    return scans


def test_without_a_way_to_the_map_it_is_no_tf_and_both_frames_are_named() -> None:
    scans = left(latched(MAKE), depth(MAKE, START_S, 1))
    assert scans.left_out == {Cause.NO_TF: 1}
    assert "no transforms lead from base_link to odom" in scans.frame_error


def test_before_the_first_pose_it_is_no_tf() -> None:
    assert left(latched(MAKE), depth(MAKE, START_S, 1), moving(MAKE, START_S + 0.1)).left_out == {Cause.NO_TF: 1}


def test_a_pose_that_never_comes_is_late_and_nothing_is_extrapolated() -> None:
    scans = left(latched(MAKE), moving(MAKE, START_S - 0.1), depth(MAKE, START_S, 1))
    assert scans.left_out == {Cause.TF_LATE: 1}


def test_a_pose_that_comes_within_the_wait_makes_the_scan() -> None:
    scans = live()
    for entry in (latched(MAKE), moving(MAKE, START_S - 0.1), depth(MAKE, START_S, 1)):
        scans.add(bag_message(entry), 0.0)
    assert list(scans.ready(0.3)) == []
    scans.add(bag_message(moving(MAKE, START_S + 0.1)), 0.3)
    (ready,) = scans.ready(0.6)  # the colour image never came
    assert ready.found.time_s == START_S and set(ready.messages) == {"/depth/image"}
    assert scans.alone == 1 and not scans.left_out


def test_poses_that_come_out_of_order_give_the_poses_of_their_stamps(replay: BagRecording) -> None:
    rng, scans = np.random.default_rng(4), live()
    order = sorted(range(len(DRIVE)), key=lambda n: DRIVE[n][0] + (rng.uniform(0, 0.3) if DRIVE[n][1] == "/tf" else 0))
    found: list[ReadyScan] = []
    for n in order:
        scans.add(bag_message(DRIVE[n]), DRIVE[n][0])
    found += scans.ready(np.inf, is_over=True)
    assert decoded(found, replay.rig) == [encode_scan(scan) for scan in replay]


def test_transforms_that_are_missing_for_ten_seconds_leave_those_scans_out_alone() -> None:
    scans, ready = live(), list[ReadyScan]()
    timed = [entry for entry in drive(MAKE, scans=150) if entry[1] != "/tf" or not 2 < entry[0] - START_S < 12]
    for entry in timed:
        scans.add(bag_message(entry), entry[0])
        ready += scans.ready(entry[0])
    ready += scans.ready(np.inf, is_over=True)
    times_s = [one.found.time_s - START_S for one in ready]
    assert len(ready) + scans.left_out.total() == 150
    assert not any(2.1 < time_s < 11.9 for time_s in times_s) and sum(time_s > 12.1 for time_s in times_s) >= 25
    assert scans.left_out[Cause.TF_LATE] + scans.left_out[Cause.TF_GAP] >= 95


def test_poses_too_far_apart_are_a_gap() -> None:
    scans = left(latched(MAKE), moving(MAKE, START_S - 1), depth(MAKE, START_S, 1), moving(MAKE, START_S + 1))
    assert scans.left_out == {Cause.TF_GAP: 1}


def test_a_frame_on_two_others_is_said_and_the_first_one_counts() -> None:
    torn = START_S, "/tf", MAKE.tf(MAKE.transform(START_S, "map2", "base_link", [0, 0, 0, 0, 0, 0, 1]))
    scans = live()
    for entry in (latched(MAKE), moving(MAKE, START_S - 0.1), torn):
        scans.add(bag_message(entry), 0.0)
    assert "base_link hangs on odom and" in scans.frame_error and "map2" in scans.frame_error
    for entry in (depth(MAKE, START_S, 1), moving(MAKE, START_S + 0.1)):
        scans.add(bag_message(entry), 0.0)
    (ready,) = scans.ready(0.6)
    assert ready.found.T_map_rig[0, 3] == pytest.approx(0.0, abs=1e-9)


def test_a_clock_that_jumps_back_gives_no_wrong_pose(replay: BagRecording) -> None:
    back_s = 3600.0
    scans = live()
    for entry in (latched(MAKE), moving(MAKE, START_S), depth(MAKE, START_S, 1)):
        scans.add(bag_message(entry), 0.0)
    then_s = START_S - back_s
    for entry in (moving(MAKE, then_s - 0.1), depth(MAKE, then_s, 2), moving(MAKE, then_s + 0.1)):
        scans.add(bag_message(entry), 1.0)
    found = {one.found.time_s: one.found.T_map_rig for one in scans.ready(2.0)}
    assert set(found) == {then_s}
    assert found[then_s][0, 3] == pytest.approx(-0.4 * back_s, abs=1e-3)


def test_an_old_stamp_while_an_image_waits_leaves_that_one_out_and_counts_it() -> None:
    scans = live()
    for entry in (latched(MAKE), moving(MAKE, START_S), depth(MAKE, START_S, 1), depth(MAKE, START_S - 61, 2)):
        scans.add(bag_message(entry), 0.0)
    assert scans.left_out == {Cause.CLOCK_BACK: 1} and scans.waiting == 1
    for entry in (moving(MAKE, START_S + 0.1), depth(MAKE, START_S + 0.05, 3)):
        scans.add(bag_message(entry), 0.1)
    (ready,) = scans.ready(2.0)
    assert ready.found.time_s == START_S + 0.05 and "/depth/image" in ready.messages


def test_one_stamp_of_the_future_is_not_the_last_one_for_ever() -> None:
    scans = live()
    for time_s in (START_S, START_S + 1000, START_S + 0.1):
        scans.add(bag_message(depth(MAKE, time_s, 1)), 0.0)
    assert scans.last_s == START_S + 0.1


def test_a_camera_that_moves_on_the_base_ends_it() -> None:
    scans = live()
    scans.add(bag_message(latched(MAKE)), 0.0)
    tree = scans.frames.tree(START_S, START_S)
    scans.frames.hold(["depth_frame"], tree)
    scans.add(bag_message(latched(MAKE)), 0.0)
    tilted = MAKE.tf(MAKE.transform(START_S, "base_link", "depth_frame", [0, 0, 1, 0, 0, 0, 1]))
    with pytest.raises(BadInputError, match="moves on base_link") as caught:
        scans.add(bag_message((START_S, "/tf", tilted)), 0.0)
    assert caught.value.kind == "frames_moved"


# Bounds


def test_images_that_wait_are_bounded_by_their_bytes() -> None:
    scans = live(image_bytes_max=2000)
    for n in range(50):
        scans.add(bag_message(depth(MAKE, START_S + n / 10, n)), 0.0)
    assert scans.waiting <= 5
    assert scans.left_out[Cause.NO_ROOM] + scans.waiting == 50


@pytest.mark.parametrize("topics", [["/colour/image"], ["/depth/image"], ["/colour/image", "/depth/image"]])
def test_images_of_any_topic_and_stamp_stay_within_the_bytes(topics: Sequence[str]) -> None:
    scans = live(image_bytes_max=2000)
    for n in range(60):
        # Stamps of one millisecond: none is too old.
        image = bag_message(depth(MAKE, START_S + n / 60_000, n))._replace(topic=topics[n % len(topics)])
        scans.add(image, 0.0)
        assert scans.held_bytes <= 2000
    assert scans.left_out.total() + scans.waiting == scans.arrived.total()
    assert len(list(scans.ready(0.0, is_over=True))) == 0
    assert scans.left_out.total() == scans.arrived.total()


def test_poses_of_all_edges_have_one_bound_and_the_newest_stay() -> None:
    frames = LiveFrames("drive", poses_max=100)
    for n in range(60):
        for child in range(5):
            pose = RosTransform(START_S + n / 10, "base_link", f"joint_{child}", np.array([n, 0, 0, 0, 0, 0, 1.0]))
            frames.add(pose, is_static=False)
            assert frames.poses == sum(len(edge.poses) for edge in frames.edges.values()) <= 100
    assert all(edge.poses[-1].pose[0] == 59 and len(edge.poses) > 5 for edge in frames.edges.values())


def test_damaged_messages_are_counted_and_nothing_else() -> None:
    rng, whole = np.random.default_rng(3), [bag_message(entry) for entry in DRIVE]
    scans = live()
    for message in whole:
        data = bytearray(message.data)
        for _ in range(int(rng.integers(0, 4))):
            data[int(rng.integers(0, min(len(data), 80)))] = int(rng.integers(0, 256))
        cut = len(data) if rng.random() < 0.8 else int(rng.integers(0, len(data)))
        scans.add(BagMessage(message.topic, message.log_ns, bytes(data[:cut])), message.log_ns / 1e9)
        list(scans.ready(message.log_ns / 1e9))
    assert scans.damaged > 0
