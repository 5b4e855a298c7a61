import json
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer as McapWriter
from tests.fixtures.fusion.bags import (
    ALL_CHANNELS,
    KINDS,
    ROS1,
    ROS2,
    Messages,
    Timed,
    mapping_text,
    optical,
    png,
    poses_of,
    recorded,
    small_recording,
    write_bag,
)

from cairn_fusion.importers import SourceLayout, detect_layout, open_source
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.recording import Recording, ScanSource
from cairn_fusion.recording.trajectory import interpolate_pose
from cairn_fusion.ros import bag_index, tf_tree
from cairn_fusion.ros.bag import BoundedFile, Wire
from cairn_fusion.ros.bag_recording import survey
from cairn_fusion.ros.images import colour_of, depth_of
from cairn_fusion.ros.mcap_bag import unpack
from cairn_fusion.ros.messages import RosCameraInfo, RosCompressedImage, RosHeader, RosImage, read_image
from cairn_fusion.ros.open_bag import open_bag
from cairn_fusion.ros.topic_mapping import camera_of_info, mapping_from_yaml
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, NotFoundError
from cairn_map.evidence.grid import Geometry


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return small_recording(tmp_path_factory.mktemp("recording") / "room")


def map_bytes(source: ScanSource, geometry: Geometry = ALL_CHANNELS) -> dict[int, bytes]:
    """The canonical cells of all scans."""
    one = Measurement(source.rig, geometry)
    for scan in source:
        one.add(scan)
    return {int(key): encode_cell(key, evidence, geometry).data for key, evidence in one.diff().items()}


@pytest.fixture
def bag_path(source: Recording, tmp_path: Path) -> Path:
    """The recording as a ROS 1 bag."""
    return write_bag(tmp_path / "lab", "bag", lambda make: recorded(source, make))


def opened(path: Path, source: Recording, **changes: object) -> ScanSource:
    return open_source(path, mapping=mapping_from_yaml(mapping_text(source, **changes), "bag.yaml"))


def refused(path: Path, text: str) -> CairnError:
    """Error of opening a bag by a mapping, or of reading its scans."""
    with pytest.raises(CairnError) as caught:
        list(open_source(path, mapping=mapping_from_yaml(text, "bag.yaml")))
    return caught.value


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_map_of_the_recording_it_was_made_of_byte_for_byte(
    kind: str, source: Recording, tmp_path: Path
) -> None:
    path = write_bag(tmp_path / "lab", kind, lambda make: recorded(source, make))
    assert detect_layout(path) is SourceLayout.BAG
    bag = open_source(path, mapping=mapping_from_yaml(mapping_text(source), "here"))
    assert len(bag) == len(source) == 4
    scan, expected = bag.scan(1), source.scan(1)
    np.testing.assert_array_equal(scan.T_map_rig, expected.T_map_rig)
    np.testing.assert_array_equal(scan.range_m, expected.range_m)
    assert scan.amplitude is not None
    assert scan.colour.keys() == expected.colour.keys()
    assert scan.thermal.keys() == expected.thermal.keys()
    assert map_bytes(bag) == map_bytes(source)


def test_what_is_proposed_for_a_bag_maps_it_when_nothing_is_left_to_decide(source: Recording, tmp_path: Path) -> None:
    def messages(make: Messages) -> Iterator[Timed]:
        yield from (timed for timed in recorded(source, make) if "thermal" not in timed[1])

    path = write_bag(tmp_path / "lab", "mcap", messages)
    assert survey(path).proposal.questions == ()
    bag = open_source(path)
    assert (bag.name, len(bag), list(bag.rig.cameras)) == ("lab", 4, ["depth", "colour", "colour2"])
    scan = bag.scan(2)
    assert scan.amplitude is not None
    expected = source.scan(2)
    np.testing.assert_allclose(scan.T_map_rig, expected.T_map_rig, atol=1e-12)
    np.testing.assert_array_equal(scan.colour["colour"], expected.colour["colour_left"])
    camera = bag.rig["depth"].camera
    np.testing.assert_allclose(bag.rig["depth"].transform, source.rig["tof"].transform, atol=1e-12)
    # The simulated camera measures along the beam; a bag's 16 bits are z unless somebody says otherwise.
    np.testing.assert_allclose(scan.range_m * camera.rays()[..., 2], expected.range_m, rtol=1e-6)


def test_a_bag_that_leaves_something_open_says_what(bag_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        open_source(bag_path)
    assert caught.value.kind == "undecided"
    assert "how many kelvin one count is" in caught.value.message
    assert f"cairn robot inspect {bag_path} --output bag.yaml" in caught.value.message


def test_cameras_are_placed_by_static_transforms(bag_path: Path, source: Recording) -> None:
    text = mapping_text(source)
    content = json.loads(text)
    for name, camera in content["cameras"].items():
        del camera["T_base_camera"]
        camera["frame"] = optical(name)
    bag = open_source(bag_path, mapping=mapping_from_yaml(json.dumps(content), "bag.yaml"))
    for name in bag.rig.cameras:
        np.testing.assert_allclose(bag.rig[name].transform, source.rig[name].transform, atol=1e-12)


@pytest.mark.parametrize("topic", ["/odom", "/pose"])
def test_poses_may_come_from_odometry_or_poses(topic: str, source: Recording, tmp_path: Path) -> None:
    poses = poses_of(source)

    def messages(make: Messages) -> Iterator[Timed]:
        for timed in recorded(source, make):
            if timed[1] == "/tf":
                t = timed[0]
                yield t, "/odom", make.odometry(t, "odom", "base_link", poses[t])
                yield t, "/pose", make.pose_stamped(t, "odom", poses[t])
            else:
                yield timed

    bag = opened(write_bag(tmp_path / "b", "db3", messages), source, poses={"topic": topic, "max_gap_s": 0})
    assert map_bytes(bag) == map_bytes(source)


def test_a_pose_between_two_is_interpolated_and_not_over_a_long_gap(source: Recording, tmp_path: Path) -> None:
    middle = source.files[1].time_s

    def messages(make: Messages) -> Iterator[Timed]:
        yield from (timed for timed in recorded(source, make) if timed[:2] != (middle, "/tf"))

    path = write_bag(tmp_path / "b", "mcap", messages)
    ends = [source.files[n] for n in (0, 2)]
    gap_s = ends[1].time_s - ends[0].time_s
    T = opened(path, source, poses={"topic": "/tf", "max_gap_s": gap_s}).scan(1).T_map_rig
    fraction = (middle - ends[0].time_s) / gap_s
    np.testing.assert_allclose(T, interpolate_pose(ends[0].T_map_rig, ends[1].T_map_rig, fraction), atol=1e-9)
    error = refused(path, mapping_text(source, poses={"topic": "/tf", "max_gap_s": gap_s / 2}))
    assert error.kind == "no_pose"
    assert "odom -> base_link" in error.message


def test_images_before_the_first_pose_are_left_out_and_that_is_said(
    source: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first_s = source.files[0].time_s

    def messages(make: Messages) -> Iterator[Timed]:
        yield from (timed for timed in recorded(source, make) if timed[:2] != (first_s, "/tf"))

    bag = opened(write_bag(tmp_path / "b", "mcap", messages), source)
    assert len(bag) == 3
    assert "1 of 4 images of /tof/depth" in caplog.text


def test_a_moving_joint_between_base_and_camera_is_refused_with_the_frame_to_name(
    source: Recording, tmp_path: Path
) -> None:
    def messages(make: Messages) -> Iterator[Timed]:
        for n, (t, topic, message) in enumerate(recorded(source, make)):
            if topic != "/tf":
                yield t, topic, message
                continue
            pan = [0.0, 0.0, 0.1 * n, 0.0, 0.0, 0.0, 1.0]
            yield t, topic, make.tf(*message.transforms, make.transform(t, "base_link", "head", pan))

    path = write_bag(tmp_path / "b", "db3", messages)
    content = json.loads(mapping_text(source))
    del content["cameras"]["tof"]["T_base_camera"]
    content["cameras"]["tof"]["frame"] = "head"
    error = refused(path, json.dumps(content))
    assert error.kind == "bad_frames"
    assert "head moves on base_link" in error.message


def camera_changed(source: Recording, **changes: object) -> str:
    content = json.loads(mapping_text(source))
    content["cameras"]["tof"] |= changes
    return json.dumps(content)


@pytest.mark.parametrize(
    ("changes", "kind", "said"),
    [
        ({"topic": "/nothing"}, "no_topic", "it has /colour_left/camera_info"),
        ({"topic": "/tf"}, "wrong_topic", "holds tf2_msgs/TFMessage, sensor_msgs/Image or"),
        ({"topic": "/colour_left/image_raw"}, "unknown_encoding", "/colour_left/image_raw at 1760000000"),
        ({"info": "/tf"}, "no_messages", "give intrinsics instead of info"),
        ({"info": "/colour_left/camera_info"}, "image_size", "must be 128 x 96 pixels, got 176 x 144"),
        ({"info": None}, "bad_mapping", "cameras.tof: give either info"),
        ({"T_base_camera": None, "frame": "elsewhere"}, "no_transform", "from elsewhere to base_link"),
        ({"spectrum": "colour"}, "bad_mapping", "amplitude is of range cameras"),
        ({"unit": 3}, "bad_mapping", "cameras.tof.unit"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_with_the_reason(
    changes: dict[str, object], kind: str, said: str, bag_path: Path, source: Recording
) -> None:
    with pytest.raises(CairnError) as caught:
        list(open_source(bag_path, mapping=mapping_from_yaml(camera_changed(source, **changes), "bag.yaml")))
    assert caught.value.kind == kind
    assert said in caught.value.message


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap", "ros1.mcap"])
def test_a_bag_that_ends_early_is_damaged_wherever_it_ends(kind: str, source: Recording, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "lab", kind, lambda make: recorded(source, make))
    path = next(path.glob("*.db3")) if kind == "db3" else path
    whole = path.read_bytes()
    cut = path.with_name(f"cut{path.suffix}")
    last = len(whole) - 4096 if kind == "db3" else len(whole) - 1  # SQLite does not need the end of its last page
    for size in (0, 5, 40, len(whole) // 3, len(whole) // 2, last - 30, last):
        cut.write_bytes(whole[:size])
        error = refused(cut, mapping_text(source))
        assert isinstance(error, DamagedDataError), size
        assert "recover" in error.message or "reindex" in error.message


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bytes_give_a_map_or_an_error_of_ours(kind: str, source: Recording, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "lab", kind, lambda make: recorded(source, make))
    file = next(path.glob("*.db3" if kind == "db3" else "*.mcap")) if path.is_dir() else path
    whole = np.frombuffer(file.read_bytes(), np.uint8)
    random = np.random.default_rng(5)
    mapping = mapping_from_yaml(mapping_text(source), "bag.yaml")
    for _ in range(12):
        changed = whole.copy()
        at = random.integers(0, len(whole), 3)
        at[0] = random.integers(max(0, len(whole) - 4000), len(whole))  # the index is at the end
        changed[at] ^= random.integers(1, 256, 3).astype(np.uint8)
        file.write_bytes(changed.tobytes())
        with suppress(CairnError):
            bag = open_source(path, mapping=mapping)
            with suppress(CairnError):
                bag.scan(0)


def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused_before_it_does() -> None:
    bomb = zstandard.compress(bytes(1 << 24))
    with pytest.raises(ValueError, match="unpacks to 1025 or more"):
        unpack(bomb, "zstd", 1024)
    with pytest.raises(ValueError, match="unpacks to 1025 or more"):
        unpack(lz4.frame.compress(bytes(1 << 24)), "lz4", 1024)


@pytest.mark.parametrize("wire", list(Wire))
def test_lengths_beyond_the_message_are_refused(wire: Wire) -> None:
    make = Messages(ROS1 if wire is Wire.ROS1 else ROS2)
    message = make.image(1.5, "eye", np.ones((2, 3), np.uint16), "16UC1")
    store = make.store
    data = (store.serialize_ros1 if wire is Wire.ROS1 else store.serialize_cdr)(message, message.__msgtype__)
    assert read_image(bytes(data), wire).header == RosHeader(1.5, "eye")
    for size in range(len(bytes(data))):
        with pytest.raises(ValueError, match=r"early|expected|begins"):
            read_image(bytes(data)[:size], wire)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_compressed_images_are_read(kind: str, source: Recording, tmp_path: Path) -> None:
    """PNG loses nothing, so the map is the same; compressedDepth has twelve bytes before its PNG."""

    def messages(make: Messages) -> Iterator[Timed]:
        for t, topic, message in recorded(source, make):
            if topic.endswith(("depth", "thermal")):
                pixels = message.data.view(np.uint16).reshape(message.height, message.width)
                head = bytes(12) if topic.endswith("depth") else b""
                text = "16UC1; compressedDepth png" if head else "16UC1; png compressed "
                yield t, topic, make.compressed(t, message.header.frame_id, text, head + png(pixels))
            elif topic.endswith("image_raw"):
                pixels = message.data.reshape(message.height, message.width, 3)[..., ::-1]
                yield t, topic, make.compressed(t, message.header.frame_id, "rgb8; png compressed bgr8", png(pixels))
            else:
                yield t, topic, message

    path = write_bag(tmp_path / "b", kind, messages)
    assert map_bytes(opened(path, source)) == map_bytes(source)
    entry = survey(path).index.topics["/tof/depth"]
    assert entry.encoding == "16UC1; compressedDepth png"


def raw(pixels: np.ndarray[Any, Any], encoding: str, **more: Any) -> RosImage:
    make = Messages(ROS2)
    data = ROS2.serialize_cdr(make.image(1, "eye", pixels, encoding, **more), "sensor_msgs/msg/Image")
    return read_image(bytes(data), Wire.CDR)


def test_colours_come_in_our_order_and_rows_without_their_padding() -> None:
    rgb = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    rgba = np.concatenate([rgb, np.full((2, 3, 1), 255, np.uint8)], axis=2)
    np.testing.assert_array_equal(colour_of(raw(rgb, "rgb8", pad=5), "it"), rgb)
    np.testing.assert_array_equal(colour_of(raw(rgb[..., ::-1], "bgr8"), "it"), rgb)
    np.testing.assert_array_equal(colour_of(raw(rgba, "rgba8"), "it"), rgb)
    np.testing.assert_array_equal(colour_of(raw(rgba[..., [2, 1, 0, 3]], "bgra8", pad=2), "it"), rgb)
    np.testing.assert_array_equal(colour_of(raw(rgb[..., 0], "mono8"), "it"), np.repeat(rgb[..., :1], 3, axis=2))


def test_depth_of_other_encodings() -> None:
    metres = np.array([[1.5, np.nan], [0.25, 3.0]], np.float32)
    np.testing.assert_array_equal(depth_of(raw(metres, "32FC1"), "it"), metres)
    big = replace(raw(np.array([[258]], np.uint16), "16UC1"), is_big_endian=True)
    assert depth_of(big, "it").tolist() == [[513]]
    # compressed_depth_image_transport: counts = a / z + b, with a and b in the head
    a, b = 100.0, 7.0
    counts = np.where(np.isnan(metres), 0, np.rint(a / np.nan_to_num(metres, nan=1.0) + b)).astype(np.uint16)
    file = struct.pack("<iff", 0, a, b) + png(counts)
    image = RosCompressedImage(RosHeader(1.0, "eye"), "32FC1; compressedDepth png", memoryview(file))
    np.testing.assert_allclose(depth_of(image, "it").astype(np.float32), metres, rtol=0.02)
    rvl = replace(image, format="16UC1; compressedDepth rvl", data=memoryview(bytes(40)))
    with pytest.raises(BadInputError, match="only PNG"):
        depth_of(rvl, "it")


def test_an_image_that_claims_more_than_it_has_is_damaged() -> None:
    image = raw(np.ones((2, 3), np.uint16), "16UC1")
    wrong: list[dict[str, Any]] = [{"height": 3}, {"width": 4}, {"step": 5}, {"width": 1 << 31}, {"height": 0}]
    for changes in wrong:
        with pytest.raises(DamagedDataError):
            depth_of(replace(image, **changes), "it")


def test_a_lens_that_we_do_not_have_is_refused_unless_its_images_are_rectified() -> None:
    K = np.array([500.0, 0, 320, 0, 500, 240, 0, 0, 1])
    P = np.array([450.0, 0, 300, 0, 0, 450, 200, 0, 0, 0, 1, 0])
    info = RosCameraInfo(RosHeader(0.0, "eye"), 640, 480, "equidistant", (0.1, 0.0, 0.0, 0.0), K, P)
    with pytest.raises(BadInputError, match="equidistant"):
        camera_of_info(info, is_rectified=False, name="eye")
    assert camera_of_info(info, is_rectified=True, name="eye").focal_px == (450.0, 450.0)
    plumb = replace(info, model="plumb_bob", distortion=(0.1, 0.2, 0.3, 0.4, 0.5))
    assert camera_of_info(plumb, is_rectified=False, name="eye").distortion == (0.1, 0.2, 0.3, 0.4, 0.5)
    with pytest.raises(BadInputError, match="not calibrated"):
        camera_of_info(replace(plumb, K=np.zeros(9)), is_rectified=False, name="eye")


def test_messages_out_of_order_in_overlapping_chunks_come_in_order(tmp_path: Path) -> None:
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=100)
        writer.start(profile="ros1", library="test")
        channel = writer.register_channel("/a", "ros1", writer.register_schema("std_msgs/String", "ros1msg", b""))
        times = np.random.default_rng(3).permutation(200)
        for n in times.tolist():
            writer.add_message(channel, log_time=n, publish_time=n, data=n.to_bytes(4, "little"))
        writer.finish()  # type: ignore[no-untyped-call]
    bag = open_bag(path)
    assert [message.log_ns for message in bag.messages(["/a"])] == list(range(200))
    assert [bytes(message.data) for message in bag.messages(["/a"], start_ns=198)] == [
        n.to_bytes(4, "little") for n in (198, 199)
    ]
    bag.close()


def test_scans_may_be_read_in_any_order(bag_path: Path, source: Recording) -> None:
    bag = opened(bag_path, source)
    forward = [scan.range_m for scan in bag]
    for n in (3, 0, 2, 2, 1, 3):
        np.testing.assert_array_equal(bag.scan(n).range_m, forward[n])
    with pytest.raises(NotFoundError):
        bag.scan(4)


def test_a_file_is_not_asked_for_more_than_it_has(tmp_path: Path) -> None:
    (tmp_path / "short").write_bytes(b"four")
    with BoundedFile(tmp_path / "short") as file, pytest.raises(EOFError, match="the file has 4"):
        file.read(1 << 62)


@pytest.mark.parametrize(
    ("module", "limit", "kind"),
    [(tf_tree, "POSES_MAX", "too_many_poses"), (bag_index, "MESSAGES_MAX", "bag_too_large")],
)
def test_what_does_not_fit_into_memory_is_refused(
    module: ModuleType, limit: str, kind: str, bag_path: Path, source: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, limit, 5)
    with pytest.raises(BadInputError) as caught:
        opened(bag_path, source)
    assert caught.value.kind == kind


def test_a_folder_that_is_packed_as_a_whole_is_refused_with_how_to_unpack_it(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "lab_0.db3").write_bytes(b"")
    (tmp_path / "lab" / "lab_1.db3.zstd").write_bytes(b"")
    with pytest.raises(BadInputError, match="zstd -d"):
        open_bag(tmp_path / "lab")


def test_messages_packed_one_by_one_are_unpacked(source: Recording, tmp_path: Path) -> None:
    """As `ros2 bag record --compression-mode message --compression-format zstd` leaves them."""
    path = write_bag(tmp_path / "lab", "db3", lambda make: recorded(source, make))
    file = next(path.glob("*.db3"))
    with closing(sqlite3.connect(file)) as database, database:
        for row, data in database.execute("SELECT id, data FROM messages").fetchall():
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (zstandard.compress(data), row))
    assert map_bytes(opened(path, source)) == map_bytes(source)
