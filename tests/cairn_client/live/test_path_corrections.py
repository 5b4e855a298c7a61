"""Corrections of a SLAM's path: the map is then the one of the true poses from the start, and no scan counts twice."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_run import GRID, MAKE, NOWHERE, Clock
from tests.fixtures.fusion.bags import ROS1, ROS2, Messages, Timed, write_bag
from tests.fixtures.fusion.drive_mapping import TOPICS, mapping_text
from tests.fixtures.fusion.live_drive import bag_message, depth, drive, in_bag_order, latched

from cairn_calib.rig.rig import Rig
from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.path_corrections import EVERY_S, PathCorrections, TimedPoses
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.scan_gate import ScanGate
from cairn_fusion.recording.trajectory import interpolate_pose
from cairn_fusion.ros.bag import Topic, Wire
from cairn_fusion.ros.bag_recording import open_bag_recording
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import read_path
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import mapping_from_yaml

START_S = 1e6
"""Small enough for stamps, in nanoseconds, that are exact as floats; so are the poses between two of them then."""
SCANS = 60
CLOSURE = 45
"""Scan at which the SLAM closes a loop."""
PATH_TOPICS = {**TOPICS, "/path": Topic("/path", "nav_msgs/Path", Wire.CDR, 0)}
MAPPING = mapping_from_yaml(
    mapping_text(frames={"map": "map", "base": "base_link"}, corrections={"topic": "/path"}), "drive"
)
END_S = START_S + SCANS / 8


def drift_m(time_s: float) -> float:
    """Way of the odometry's frame in the map along y, which the SLAM notices late."""
    return 0.05 * (time_s - START_S)


def pose(x: float, y: float) -> list[float]:
    return [x, y, 0.0, 0.0, 0.0, 0.0, 1.0]


def transforms(*, is_true: bool) -> Iterator[Timed]:
    """The way of the robot, straight on; the map's knowledge of the drift from the start, or after the closure."""
    for n in range(-2, 2 * SCANS + 4):
        time_s = START_S + n / 16
        y = drift_m(time_s) if is_true or n > 2 * CLOSURE else 0.0
        edges = [
            MAKE.transform(time_s, "odom", "base_link", pose(0.4 * (time_s - START_S), 0.0)),
            MAKE.transform(time_s, "map", "odom", pose(0.0, y)),
        ]
        yield time_s, "/tf", MAKE.tf(*edges)


def images() -> list[Timed]:
    """Range images midway between transforms, so that each lies between two."""
    return [depth(MAKE, START_S + n / 8 + 1 / 32, n) for n in range(SCANS)]


def path(make: Messages, time_s: float, *, frame: str = "map", offset_m: float = 0.0) -> Timed:
    """The optimised path: true poses, every third scan's and the last one's."""
    stamps = [START_S + n / 8 + 1 / 32 for n in range(SCANS) if n % 3 == 0 or n == SCANS - 1]
    poses = [
        make.pose_stamped(t, frame, pose(0.4 * (t - START_S), drift_m(t) + offset_m)) for t in stamps if t <= time_s
    ]
    return time_s, "/path", make.make("nav_msgs/Path", header=make.header(time_s, frame), poses=poses)


def in_order(timed: Sequence[Timed]) -> list[Timed]:
    return sorted(timed, key=lambda entry: (entry[1] != "/tf_static", entry[0]))


INFO = [entry for entry in drive(MAKE, scans=1) if entry[1].endswith("/info")]


@pytest.fixture(scope="module")
def true_map(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, str]:
    """The rig, and the digest of the map that the true poses give from the start."""
    folder = tmp_path_factory.mktemp("truth")
    timed = in_order([latched(MAKE), *transforms(is_true=True), *images(), *INFO])
    extra = [entry for entry in drive(MAKE, scans=1) if entry[1] in ("/colour/image", "/warm/image")]
    far = [(START_S - 100, topic, message) for _, topic, message in extra]  # the mapping's topics, of no scan
    for _, _, message in far:
        message.header = MAKE.header(START_S - 100, message.header.frame_id)
    bag = write_bag(folder / "drive", "mcap", lambda make: in_bag_order([*timed, *far]))
    replay = open_bag_recording(bag, MAPPING)
    with Robot(replay.rig, NOWHERE, directory=folder / "truth", name="truth", geometry=GRID, stay=True) as robot:
        for scan in replay:
            robot.observe(scan)
        robot.commit()
        return replay.rig, robot.map.digest()


class Corrected:
    """A live robot whose past follows the path."""

    def __init__(self, rig: Rig, folder: Path, *, keep_scans_bytes: int = 10_000_000, has_path: bool = True) -> None:
        self.clock = Clock()
        self.scans = LiveScans("drive", MAPPING, PATH_TOPICS)
        self.robot = Robot(
            rig, NOWHERE, directory=folder, name="mole", geometry=GRID, stay=True, keep_scans_bytes=keep_scans_bytes
        )
        decoder = ScanDecoder("drive", MAPPING, rig, PATH_TOPICS)
        corrections = PathCorrections(self.robot, topic="/path", frame="map", T_path_rig=np.eye(4))
        self.live = LiveMapping(
            self.robot, self.scans, decoder, ScanGate(None), steady_s=self.clock,
            corrections=corrections if has_path else None,
        )  # fmt: skip
        self.corrections = corrections

    def take(self, timed: Sequence[Timed]) -> None:
        """Take messages, each at its time; all waits are over at the end."""
        for entry in timed:
            self.clock.now_s = max(0.0, min(entry[0], END_S) - START_S)
            self.live.step([bag_message(entry)])
        self.wait(2.0)

    def wait(self, seconds: float) -> None:
        for _ in range(20):
            self.clock.now_s += seconds / 20
            self.live.step([])


def test_past_measurements_follow_the_path_and_the_map_is_that_of_the_true_poses(
    true_map: tuple[Rig, str], tmp_path: Path
) -> None:
    rig, digest = true_map
    driven = Corrected(rig, tmp_path / "mole")
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images()]))
    driven.live.finish()
    assert driven.live.taken == SCANS and driven.live.commits >= 2
    assert driven.live.jumps.count >= 1
    assert 0.1 < driven.live.jumps.largest_m < 0.3  # an image is midway between the poses before and after
    assert driven.robot.map.digest() != digest and driven.corrections.amended == 0
    driven.take([path(MAKE, END_S)])
    assert driven.robot.map.digest() == digest
    amended = driven.corrections.amended
    assert 1 <= amended <= driven.live.commits and driven.corrections.waiting == 0
    # The same path again changes nothing.
    driven.clock.now_s += EVERY_S
    driven.take([path(MAKE, END_S)])
    assert driven.corrections.amended == amended and driven.robot.map.digest() == digest
    driven.robot.close()


def test_paths_that_come_while_it_drives_end_at_the_same_map(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    rig, digest = true_map
    driven = Corrected(rig, tmp_path / "mole")
    paths = [path(MAKE, START_S + n / 2 + 0.3) for n in range(2 * SCANS // 8)]
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images(), *paths, path(MAKE, END_S)]))
    driven.live.finish()
    assert driven.robot.map.digest() == digest
    driven.robot.close()


def test_a_new_path_counts_at_most_every_ten_seconds(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    driven = Corrected(true_map[0], tmp_path / "mole")
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images()]))
    driven.live.finish()
    driven.wait(EVERY_S)
    driven.take([path(MAKE, END_S)])
    amended = driven.corrections.amended
    assert amended >= 1
    driven.take([path(MAKE, END_S, offset_m=1.0)])
    assert driven.corrections.amended == amended
    driven.wait(EVERY_S)
    assert driven.corrections.amended == amended + driven.live.commits
    driven.robot.close()


def test_a_jump_without_a_path_is_counted_and_the_past_stays(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    driven = Corrected(true_map[0], tmp_path / "mole", has_path=False)
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images(), path(MAKE, END_S)]))
    driven.live.finish()
    assert driven.live.jumps.count >= 1 and driven.live.taken == SCANS
    assert driven.robot.map.digest() != true_map[1]
    driven.robot.close()


def test_a_path_in_another_frame_is_refused_by_name(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    driven = Corrected(true_map[0], tmp_path / "mole")
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images(), path(MAKE, END_S, frame="world")]))
    assert "/path has poses in world, not in map: say `map: world`" in driven.corrections.refusal
    assert driven.corrections.amended == 0
    driven.robot.close()


def test_measurements_whose_scans_are_gone_stay_and_are_counted(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    driven = Corrected(true_map[0], tmp_path / "mole", keep_scans_bytes=0)
    driven.take(in_order([latched(MAKE), *transforms(is_true=False), *images(), path(MAKE, END_S)]))
    driven.live.finish()
    assert driven.corrections.amended == 0 and driven.corrections.lost >= 1
    driven.robot.close()


def test_a_damaged_path_is_counted_and_nothing_else(true_map: tuple[Rig, str], tmp_path: Path) -> None:
    driven = Corrected(true_map[0], tmp_path / "mole")
    message = bag_message(path(MAKE, END_S))
    driven.live.step([message._replace(data=bytes(message.data)[:-1])])
    assert driven.scans.damaged == 1 and driven.scans.take_path() is None
    driven.robot.close()


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_a_path_is_read_as_ros_writes_it(store: object) -> None:
    make = Messages(store)  # type: ignore[arg-type]
    _, _, message = path(make, END_S)
    write = ROS1.serialize_ros1 if make.is_ros1 else ROS2.serialize_cdr
    data, wire = bytes(write(message, "nav_msgs/msg/Path")), Wire.ROS1 if make.is_ros1 else Wire.CDR
    read = read_path(data, wire)
    assert read.frame == "map" and len(read.poses) == 21
    assert read.poses[3].time_s == START_S + 9 / 8 + 1 / 32 and read.poses[3].parent == "map"
    assert read.poses[3].pose.tolist() == pose(0.4 * (read.poses[3].time_s - START_S), pytest.approx(0.0578125))
    for size in range(0, len(data), 7):
        with pytest.raises(ValueError, match=r"end|left|expected"):
            read_path(data[:size], wire)


def test_poses_between_poses_are_those_of_a_trajectory() -> None:
    rng = np.random.default_rng(5)
    q = rng.normal(size=(6, 4))
    poses = TimedPoses(np.arange(6.0), rng.normal(size=(6, 3)), q / np.linalg.norm(q, axis=1, keepdims=True))
    whole = poses.transforms()
    assert np.allclose(TimedPoses.of_transforms(poses.times_s, whole).transforms(), whole, atol=1e-14)
    for time_s in (0.0, 0.3, 2.5, 4.999, 5.0):
        n = min(int(time_s), 4)
        expected = interpolate_pose(whole[n], whole[n + 1], time_s - n)
        assert np.allclose(poses.at(np.array([time_s])).transforms()[0], expected, atol=1e-12)
    assert np.allclose(poses.at(np.array([-1.0, 9.0])).transforms(), whole[[0, 5]])
    assert poses.gaps_s(np.array([-1.0, 0.0, 0.5, 5.0, 9.0])).tolist() == [np.inf, 0.0, 1.0, 0.0, np.inf]
