"""Recordings of live robots: what became scans, and nothing else, replays to the same map."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_run import GRID, MAPPING, NOWHERE, Clock
from tests.fixtures.fusion.bags import ROS1, ROS2, Messages, Timed
from tests.fixtures.fusion.drive_mapping import KINDS, LABEL_KINDS, LABELLED, TOPICS, mapping_text
from tests.fixtures.fusion.live_drive import drive, labelled

from cairn_calib.rig.rig import Rig
from cairn_client import main as cairn
from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_opening import OpenedLive
from cairn_client.live.scan_recorder import ScanRecorder
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.scan_gate import GateBounds, ScanGate
from cairn_fusion.ros.bag import BagMessage, Topic, Wire
from cairn_fusion.ros.bag_recording import open_bag_recording
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.map_messages import exact_ns
from cairn_fusion.ros.messages import read_transforms
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import mapping_from_yaml, mapping_next_to
from cairn_map.errors import ConflictError
from cairn_map.evidence.channels import classes_channel
from cairn_map.evidence.grid import Geometry, geometry_for

THINGS = geometry_for(voxel_edge_m=0.05, channels=(classes_channel(("wall", "chair")),))


def message_of(entry: Timed, make: Messages) -> BagMessage:
    time_s, topic, message = entry
    write = ROS1.serialize_ros1 if make.is_ros1 else ROS2.serialize_cdr
    return BagMessage(topic, round(time_s * 1e9), bytes(write(message, message.__msgtype__)))


def with_odometry(make: Messages, timed: Sequence[Timed]) -> list[Timed]:
    """The drive with its way as odometry, of a frame below the base."""
    changed = []
    for time_s, topic, message in timed:
        if topic != "/tf":
            changed.append((time_s, topic, message))
            continue
        t, q = message.transforms[0].transform.translation, message.transforms[0].transform.rotation
        pose = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
        changed.append((time_s, "/odom", make.odometry(time_s, "odom", "foot", pose)))
    foot = make.tf(make.transform(timed[0][0], "foot", "base_link", [0.2, 0, 0.1, 0, 0, np.sin(0.4), np.cos(0.4)]))
    return [(timed[0][0], "/tf_static", foot), *changed]


def recorded(
    folder: Path,
    rig: Rig,
    timed: Sequence[Timed],
    make: Messages,
    *,
    gate: ScanGate,
    poses: str = "/tf",
    changes: Mapping[str, object] | None = None,
    grid: Geometry = GRID,
) -> tuple[str, int]:
    """Digest of the live map, and the number of scans recorded into `folder`."""
    kinds = {**KINDS, **LABEL_KINDS, **({"/odom": "nav_msgs/Odometry"} if poses == "/odom" else {})}
    topics = {name: Topic(name, kind, Wire.ROS1 if make.is_ros1 else Wire.CDR, 0) for name, kind in kinds.items()}
    mapping = mapping_from_yaml(mapping_text(poses={"topic": poses, "max_gap_s": 0.3}, **(changes or {})), "drive")
    scans, clock = LiveScans("drive", mapping, topics), Clock()
    messages = [message_of(entry, make) for entry in timed]
    wire = Wire.ROS1 if make.is_ros1 else Wire.CDR
    fixed = [edge for one in messages if one.topic == "/tf_static" for edge in read_transforms(one.data, wire)]
    infos = {one.topic: one for one in reversed(messages) if one.topic.endswith("/info")}
    opened = OpenedLive(rig, scans, topics, np.eye(4), tuple(fixed), tuple(infos.values()), [], Counter())
    recorder = ScanRecorder(folder, opened, mapping)
    with Robot(rig, NOWHERE, directory=folder.parent / "live", name="live", geometry=grid, stay=True) as robot:
        decoder = ScanDecoder("drive", mapping, rig, topics)
        live = LiveMapping(robot, scans, decoder, gate, on_taken=recorder.add, steady_s=clock)
        for message in messages:
            live.step([message])
        live.finish()
        recorder.close()
        assert recorder.scans == live.taken
        return robot.map.digest(), live.taken


def replayed(folder: Path) -> str:
    state = folder.parent / "replay"
    command = ["robot", "replay", str(folder), "--map", NOWHERE, "--state", str(state), "--name", "replay"]
    assert cairn.main([*command, "--voxel", "0.05"]) == 0
    with Robot(None, NOWHERE, directory=state, name="replay", stay=True) as robot:
        return robot.map.digest()


@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_what_became_scans_replays_to_the_same_map(store: object, rig: Rig, tmp_path: Path) -> None:
    make = Messages(store)  # type: ignore[arg-type]
    folder = tmp_path / "lab"
    digest, taken = recorded(folder, rig, drive(make), make, gate=ScanGate(GateBounds(step_m=0.15, turn_deg=10)))
    assert 5 < taken < 20
    assert replayed(folder) == digest
    mapping = mapping_next_to(folder)
    assert mapping is not None
    assert len(open_bag_recording(folder, mapping)) == taken


def test_poses_of_odometry_on_a_body_below_the_base_are_recorded_bit_for_bit(rig: Rig, tmp_path: Path) -> None:
    make, folder = Messages(ROS2), tmp_path / "lab"
    timed = with_odometry(make, drive(make))
    digest, _ = recorded(folder, rig, timed, make, gate=ScanGate(None), poses="/odom")
    assert replayed(folder) == digest


def test_a_camera_that_no_scan_had_is_left_out(rig: Rig, tmp_path: Path) -> None:
    make, folder = Messages(ROS2), tmp_path / "lab"
    timed = [entry for entry in drive(make, scans=10) if entry[1] != "/warm/image"]
    digest, _ = recorded(folder, rig, timed, make, gate=ScanGate(None))
    mapping = mapping_next_to(folder)
    assert mapping is not None and set(mapping.cameras) == {"depth", "colour"}
    replay = open_bag_recording(folder, mapping)
    with Robot(replay.rig, NOWHERE, directory=tmp_path / "other", name="other", geometry=GRID, stay=True) as robot:
        for scan in replay:
            robot.observe(scan)
        robot.commit()
        assert robot.map.digest() == digest


@pytest.mark.parametrize(
    ("gone", "left"),
    [
        ("nothing", {"depth": "/depth/labels", "colour": "/colour/labels"}),
        ("/colour/image", {"depth": "/depth/labels", "colour": "/colour/labels"}),
        ("/colour/labels", {"depth": "/depth/labels"}),
        ("labels", {}),
    ],
)
def test_label_images_are_recorded_with_the_names_of_their_numbers(
    gone: str, left: dict[str, str], rig: Rig, tmp_path: Path
) -> None:
    make, folder = Messages(ROS2), tmp_path / "lab"
    timed = [entry for entry in labelled(make, drive(make, scans=10)) if not entry[1].endswith(gone)]
    digest, _ = recorded(folder, rig, timed, make, gate=ScanGate(None), changes=LABELLED, grid=THINGS)
    mapping = mapping_next_to(folder)
    assert mapping is not None
    assert {name: camera.labels for name, camera in mapping.cameras.items() if camera.labels} == left
    assert mapping.label_names == ({0: None, 1: "wall", 300: "chair"} if left else {})
    assert (mapping.cameras["colour"].topic is None) is (gone == "/colour/image")
    replay = open_bag_recording(folder, mapping)
    with Robot(replay.rig, NOWHERE, directory=tmp_path / "other", name="other", geometry=THINGS, stay=True) as robot:
        for scan in replay:
            robot.observe(scan)
        robot.commit()
        assert robot.map.digest() == digest


def test_a_folder_with_files_is_refused_and_a_full_disk_ends_recording_alone(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Messages(ROS2)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "notes").touch()
    opened = OpenedLive(rig, LiveScans("drive", MAPPING, {}), TOPICS, np.eye(4), (), (), [], Counter())
    with pytest.raises(ConflictError, match="must be empty"):
        ScanRecorder(tmp_path / "lab", opened, MAPPING)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cairn_client.live.scan_recorder.ScanRecorder._send_edges", full)
    recorder = ScanRecorder(tmp_path / "other", opened, MAPPING)
    monkeypatch.setattr("cairn_client.live.scan_recorder.ScanRecorder._send", lambda *_: None)
    scans = LiveScans("drive", MAPPING, TOPICS)
    for entry in drive(make, scans=5):
        scans.add(message_of(entry, make), 0.0)
    for ready in scans.ready(0.0, is_over=True):
        recorder.add(ready)
    assert "No space left on device" in recorder.refusal and recorder.scans == 0
    recorder.close()
    assert not list((tmp_path / "other").iterdir())


def test_a_time_makes_the_same_float_again() -> None:
    rng = np.random.default_rng(1)
    for time_s in (rng.integers(1, 2**61, 1000) / 1e9).tolist():
        assert exact_ns(time_s) / 1e9 == time_s
