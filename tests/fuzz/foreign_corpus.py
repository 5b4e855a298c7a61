"""Seeds of what other programs write: small bags of every kind, ROS messages one by one, files of cameras."""

import json
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from tests.fixtures.calib.foreign_rigs import KALIBR, ROS, ROS1_ECHO, ROS2_ECHO
from tests.fixtures.fusion.bags import ROS1, ROS2, Messages, Timed, optical, png, write_bag
from tests.fixtures.fusion.drive_mapping import TOPICS
from tests.fixtures.fusion.live_drive import drive, wire_of
from tests.fuzz.live_target import NAMES, TEXT
from tests.fuzz.sections import joined

from cairn_calib.exchange.placed_camera import PlacedCamera
from cairn_calib.exchange.rig_exchange import FORMATS
from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.fisheye import FisheyeCamera

Seed = tuple[str, str, bytes]

CAMERA = camera_from_field_of_view(8, 6, horizontal_deg=60.0)
LENS = Camera(width=8, height=6, focal_px=(7.0, 7.5), centre_px=(3.5, 2.5), distortion=(-0.2, 0.05, 1e-3, -1e-5, 0.0))
FISHEYE = FisheyeCamera(width=8, height=6, focal_px=(3.0, 3.0), centre_px=(3.5, 2.5), distortion=(0.1, 0.0, 0.0, 1e-5))
T_RIG_RIGHT = np.array([[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]])
POSE = (0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0)
COUNTS = (np.arange(48, dtype=np.uint16).reshape(6, 8) + 20) * 40
MAPPING = {
    "frames": {"map": "odom", "base": "base_link"},
    "cameras": {"tof": {"spectrum": "range", "topic": "/tof/depth", "info": "/tof/camera_info", "units_per_m": 1000}},
}


def foreign_seeds() -> Iterator[Seed]:
    """Target, name and bytes of each."""
    mapping = json.dumps(MAPPING).encode()
    for kind, (file, data) in _bags().items():
        yield "bag", kind, joined([("bag.yaml", mapping), (file, data)])
    yield "bag", "proposed", joined([_bags()["mcap"]])
    for name, make in (("ros1", Messages(ROS1)), ("cdr", Messages(ROS2))):
        for topic, message in _messages(make):
            yield "ros-message", f"{topic}-{name}", f"{plain(message)} {name}\n".encode() + _wire(make, message)
    yield from _camera_files()
    yield from _live_frames()


def plain(message: Any) -> str:
    """`sensor_msgs/Image`."""
    return str(message.__msgtype__).replace("/msg/", "/")


def _messages(make: Messages) -> Iterator[tuple[str, Any]]:
    """One of each type that is read."""
    t, eye = 1.5, optical("tof")
    yield "tf", make.tf(make.transform(t, "odom", "base_link", POSE), make.transform(t, "base_link", eye, POSE))
    yield "odometry", make.odometry(t, "odom", "base_link", POSE)
    yield "pose", make.pose_stamped(t, "odom", POSE)
    stamped = [make.pose_stamped(t, "map", POSE), make.pose_stamped(t + 1, "", POSE)]
    yield "path", make.make("nav_msgs/Path", header=make.header(t, "map"), poses=stamped)
    yield "info", make.info(t, eye, LENS)
    for encoding, pixels in (("16UC1", COUNTS), ("32FC1", COUNTS.astype(np.float32)), ("mono8", COUNTS.astype("u1"))):
        yield encoding, make.image(t, eye, pixels, encoding)
    yield "bgra8", make.image(t, eye, np.zeros((2, 3, 4), np.uint8), "bgra8", pad=3)
    yield "png", make.compressed(t, eye, "16UC1; png compressed ", png(COUNTS))
    yield "depth-png", make.compressed(t, eye, "32FC1; compressedDepth png", bytes(12) + png(COUNTS))
    yield "points", _points(make, t, rows=2)
    yield "no-points", _points(make, t, rows=0)
    few = np.random.default_rng(2).normal(0, 3, (3, 3)).astype(np.float32)
    yield "livox", make.livox(t, "livox", few, np.arange(3, dtype=np.uint32) * 10_000)


def _points(make: Messages, time_s: float, *, rows: int) -> Any:
    fields = [
        make.make("sensor_msgs/PointField", name=name, offset=4 * n, datatype=7, count=1)
        for n, name in enumerate("xyz")
    ]
    points = np.random.default_rng(1).normal(0, 3, (rows, 5, 3)).astype(np.float32)
    return make.make(
        "sensor_msgs/PointCloud2",
        header=make.header(time_s, "lidar"),
        height=rows,
        width=5,
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=60,
        data=points.view(np.uint8).ravel(),
        is_dense=True,
    )


def _drive(make: Messages) -> Iterator[Timed]:
    """Two scans of one camera."""
    yield 1.0, "/tf_static", make.tf(make.transform(1.0, "base_link", optical("tof"), POSE))
    for t in (1.0, 1.5):
        yield t, "/tf", make.tf(make.transform(t, "odom", "base_link", (t, *POSE[1:])))
        yield t, "/tof/camera_info", make.info(t, optical("tof"), CAMERA)
        yield t, "/tof/depth", make.image(t, optical("tof"), COUNTS, "16UC1")


def _wire(make: Messages, message: Any) -> bytes:
    write = make.store.serialize_ros1 if make.is_ros1 else make.store.serialize_cdr
    return bytes(write(message, message.__msgtype__))


def _bags() -> dict[str, tuple[str, bytes]]:
    """Of each kind the name and the bytes of a file; without definitions of messages, which nobody reads."""
    made: dict[str, tuple[str, bytes]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, packing in (("mcap", CompressionType.NONE), ("mcap-zstd", CompressionType.ZSTD)):
            made[kind] = "lab.mcap", _mcap(folder / f"{kind}.mcap", Messages(ROS2), packing)
        made["ros1-mcap"] = "lab.mcap", _mcap(folder / "1.mcap", Messages(ROS1), CompressionType.LZ4)
        made["bag"] = "lab.bag", _bag(folder / "lab.bag", Messages(ROS1))
        file = next(write_bag(folder / "lab", "db3", _drive).glob("*.db3"))
        database = apsw.Connection(str(file))
        database.execute("UPDATE message_definitions SET encoded_message_definition = ''")
        small = folder / "small.db3"
        database.execute("PRAGMA page_size = 512")
        database.execute("VACUUM INTO ?", (str(small),))
        database.close()
        made["db3"] = "lab.db3", small.read_bytes()
    return made


def _mcap(path: Path, make: Messages, packing: CompressionType) -> bytes:
    with path.open("wb") as file:
        writer = McapWriter(file, compression=packing, enable_crcs=False)
        writer.start()
        channels: dict[str, int] = {}
        for time_s, topic, message in _drive(make):
            if topic not in channels:
                schema = writer.register_schema(plain(message), "ros1msg" if make.is_ros1 else "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "ros1" if make.is_ros1 else "cdr", schema)
            ns = round(time_s * 1e9)
            writer.add_message(channels[topic], log_time=ns, publish_time=ns, data=_wire(make, message))
        writer.finish()  # type: ignore[no-untyped-call]
    return path.read_bytes()


def _bag(path: Path, make: Messages) -> bytes:
    with Writer1(path) as writer:
        connections: dict[str, Any] = {}
        for time_s, topic, message in _drive(make):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, msgdef="bool a", md5sum="0" * 32)
            writer.write(connections[topic], round(time_s * 1e9), _wire(make, message))
    return path.read_bytes()


def _camera_files() -> Iterator[Seed]:
    left, right = (PlacedCamera(name, LENS, T) for name, T in (("left", np.eye(4)), ("right", T_RIG_RIGHT)))
    round_one = PlacedCamera("left", FISHEYE, None)
    written = {
        "kalibr": FORMATS["kalibr"].write([left, right]),
        "opencv": FORMATS["opencv"].write([right]),
        "opencv-fisheye": FORMATS["opencv"].write([round_one]),
        "ros": FORMATS["ros"].write([PlacedCamera("left", LENS, None)]),
        "mrcal": FORMATS["mrcal"].write([right]),
        "kalibr-foreign": KALIBR,
        "ros-foreign": ROS,
        "camera_info-1": ROS1_ECHO,
        "camera_info-2": ROS2_ECHO,
        "kalibr-json": json.dumps(
            {
                "cam0": {
                    "camera_model": "pinhole",
                    "intrinsics": [7.0, 7.5, 3.5, 2.5],
                    "distortion_model": "equidistant",
                    "distortion_coeffs": [0.1, 0.0, 0.0, 1e-5],
                    "resolution": [8, 6],
                }
            }
        ),
        "mrcal-json": json.dumps(
            {
                "lensmodel": "LENSMODEL_OPENCV4",
                "intrinsics": [7.0, 7.5, 3.5, 2.5, 0.1, 0.0, 0.0, 1e-5],
                "extrinsics": [0.1, 0.2, 0.3, 1.0, 2.0, 3.0],
                "imagersize": [8, 6],
            }
        ),
    }
    for name, text in written.items():
        yield "camera-file", name, joined([(name.partition("-")[0], text.encode())])


def _live_frames() -> Iterator[Seed]:
    channels = [
        {"id": n, "topic": name, "encoding": "cdr", "schemaName": TOPICS[name].type, "schema": "", "schemaEncoding": ""}
        for n, name in enumerate(NAMES)
    ]
    texts = {
        "hello": {"op": "serverInfo", "name": "mole", "capabilities": ["time"], "sessionId": "1"},
        "advertise": {"op": "advertise", "channels": channels},
        "unadvertise": {"op": "unadvertise", "channelIds": [0, 1]},
        "status": {"op": "status", "level": 2, "message": "Unknown channel ID: 1"},
    }
    for name, content in texts.items():
        yield "live", name, joined([(TEXT, json.dumps(content).encode())])
    sent = drive(Messages(ROS2), scans=3)
    frames = [
        ("binary", struct.pack("<BIQ", 1, NAMES.index(topic), 1) + wire_of(message)) for _, topic, message in sent
    ]
    yield "live", "drive", joined(frames)
