"""Bags of every kind, written from a recording by the libraries that ROS users have; all that is in one is in all."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, quaternion_from_transform
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.images import read_colour, read_grey16
from cairn_fusion.recording.recording import Recording

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
KINDS = ("bag", "db3", "mcap", "mcap-dir", "ros1.mcap")
Timed = tuple[float, str, Any]
Pose = Sequence[float]
"""x y z in metres, qx qy qz qw."""


class Messages:
    """The messages of one recording, made for ROS 1 or ROS 2."""

    def __init__(self, store: Typestore) -> None:
        self.store = store
        self.is_ros1 = store is ROS1

    def make(self, name: str, /, **fields: Any) -> Any:
        package, _, kind = name.partition("/")
        return self.store.types[f"{package}/msg/{kind}"](**fields)

    def header(self, time_s: float, frame: str) -> Any:
        ns = round(time_s * 1e9)
        stamp = self.make("builtin_interfaces/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.is_ros1 else {}))

    def image(self, time_s: float, frame: str, pixels: np.ndarray[Any, Any], encoding: str, *, pad: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        return self.make(
            "sensor_msgs/Image",
            header=self.header(time_s, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, time_s: float, frame: str, text: str, data: bytes) -> Any:
        data_array = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/CompressedImage", header=self.header(time_s, frame), format=text, data=data_array)

    def info(self, time_s: float, frame: str, camera: Camera) -> Any:
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        matrices = {
            "d": np.array(camera.distortion),
            "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]),
            "r": np.eye(3).ravel(),
            "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], np.float64),
        }
        named = {name.upper() if self.is_ros1 else name: value for name, value in matrices.items()}
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(time_s, frame),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **named,
        )

    def transform(self, time_s: float, parent: str, child: str, pose: Pose) -> Any:
        x, y, z, *q = pose
        return self.make(
            "geometry_msgs/TransformStamped",
            header=self.header(time_s, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/Transform",
                translation=self.make("geometry_msgs/Vector3", x=x, y=y, z=z),
                rotation=self.make("geometry_msgs/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
            ),
        )

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/TFMessage", transforms=list(transforms))

    def pose(self, pose: Pose) -> Any:
        x, y, z, *q = pose
        return self.make(
            "geometry_msgs/Pose",
            position=self.make("geometry_msgs/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
        )

    def odometry(self, time_s: float, parent: str, child: str, pose: Pose) -> Any:
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(time_s, parent),
            child_frame_id=child,
            pose=self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(pose), covariance=np.zeros(36)),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def pose_stamped(self, time_s: float, parent: str, pose: Pose) -> Any:
        return self.make("geometry_msgs/PoseStamped", header=self.header(time_s, parent), pose=self.pose(pose))


def pose_of(T: Transform) -> Pose:
    return [float(v) for v in (*T[:3, 3], *quaternion_from_transform(T))]


def poses_of(source: Recording) -> dict[float, Pose]:
    """The very numbers of the recording's trajectory, by time."""
    text = (source.files[0].range_path.parents[2] / "trajectory.txt").read_text()
    rows = [[float(word) for word in line.split()] for line in text.splitlines() if not line.startswith("#")]
    return {time_s: pose for time_s, *pose in rows}


def optical(name: str) -> str:
    return f"{name}_optical_frame"


def recorded(source: Recording, make: Messages) -> Iterator[Timed]:
    """The messages of a robot that had made this recording: one scan after the other, tf first."""
    first_s = source.files[0].time_s
    poses = poses_of(source)
    yield first_s, "/tf_static", make.tf(*static_transforms(source.rig, first_s, make))
    for scan in source.files:
        t = scan.time_s
        yield t, "/tf", make.tf(make.transform(t, "odom", "base_link", poses[t]))
        counts = {f"/{scan.range_camera}/depth": (scan.range_path, "16UC1")}
        if scan.amplitude_path:
            counts[f"/{scan.range_camera}/amplitude"] = (scan.amplitude_path, "mono16")
        counts |= {f"/{name}/thermal": (path, "16UC1") for name, path in scan.thermal.items()}
        for topic, (path, encoding) in counts.items():
            yield t, topic, make.image(t, optical(topic.split("/")[1]), read_grey16(path), encoding)
        for name, path in scan.colour.items():
            yield t, f"/{name}/image_raw", make.image(t, optical(name), read_colour(path), "rgb8")
        for name in {scan.range_camera, *scan.thermal, *scan.colour}:
            camera = source.rig[name].camera
            assert isinstance(camera, Camera)
            yield t, f"/{name}/camera_info", make.info(t, optical(name), camera)


def static_transforms(rig: Rig, time_s: float, make: Messages) -> list[Any]:
    return [
        make.transform(time_s, "base_link", optical(name), pose_of(camera.transform))
        for name, camera in rig.cameras.items()
    ]


def write_bag(path: Path, kind: str, messages: Callable[[Messages], Iterator[Timed]]) -> Path:
    """A bag of a kind with these messages; returns what to open."""
    make = Messages(ROS1 if kind in ("bag", "ros1.mcap") else ROS2)
    timed = list(messages(make))
    if kind == "bag":
        return _write1(path.with_suffix(".bag"), timed)
    if kind == "ros1.mcap":
        return _write_mcap1(path.with_suffix(".mcap"), timed)
    plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for time_s, topic, message in timed:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=ROS2)
            writer.write(connections[topic], round(time_s * 1e9), ROS2.serialize_cdr(message, name))
    return path / f"{path.name}.mcap" if kind == "mcap" else path


def _write1(path: Path, timed: list[Timed]) -> Path:
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.LZ4)
    with writer:
        connections: dict[str, Any] = {}
        for time_s, topic, message in timed:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=ROS1)
            writer.write(connections[topic], round(time_s * 1e9), ROS1.serialize_ros1(message, name))
    return path


def _write_mcap1(path: Path, timed: list[Timed]) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=1 << 16, compression=CompressionType.LZ4)
        writer.start(profile="ros1", library="test")
        channels: dict[str, int] = {}
        for time_s, topic, message in timed:
            name = message.__msgtype__
            if topic not in channels:
                definition, _ = ROS1.generate_msgdef(name)
                schema = writer.register_schema(name.replace("/msg/", "/"), "ros1msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "ros1", schema)
            ns = round(time_s * 1e9)
            data = bytes(ROS1.serialize_ros1(message, name))
            writer.add_message(channels[topic], log_time=ns, publish_time=ns, data=data)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def mapping_text(source: Recording, **changes: object) -> str:
    """The YAML that fits what `recorded` gives."""
    scan = source.files[0]
    cameras: dict[str, dict[str, object]] = {
        scan.range_camera: {
            "spectrum": "range",
            "topic": f"/{scan.range_camera}/depth",
            "convention": source.range_encodings[scan.range_camera].convention.value,
            "units_per_m": source.range_encodings[scan.range_camera].units_per_m,
        }
    }
    if scan.amplitude_path:
        cameras[scan.range_camera]["amplitude"] = f"/{scan.range_camera}/amplitude"
    cameras |= {name: {"spectrum": "colour", "topic": f"/{name}/image_raw"} for name in scan.colour}
    for name in scan.thermal:
        encoding = source.thermal_encodings[name]
        cameras[name] = {"spectrum": "thermal", "topic": f"/{name}/thermal", **encoding.model_dump()}
    for name, camera in cameras.items():
        camera |= {"info": f"/{name}/camera_info", "T_base_camera": source.rig[name].transform.tolist()}
    mapping = {
        "name": "bagged",
        "frames": {"map": "odom", "base": "base_link"},
        "poses": {"topic": "/tf", "max_gap_s": 0.0},
        "time_tolerance_s": 0.0,
        "cameras": cameras,
    }
    return json.dumps(mapping | changes)  # JSON is YAML


def png(pixels: np.ndarray[Any, Any]) -> bytes:
    done, data = cv2.imencode(".png", pixels)
    assert done
    return bytes(data)
