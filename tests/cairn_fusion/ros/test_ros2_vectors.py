"""Messages as two distributions of ROS 2 code them: they are read, and what we write has the same bytes and hashes."""

from typing import Any

import numpy as np
import pytest
from tests.fixtures.fusion.ros2_messages import HEADER, MESSAGES, POSE, rosbags_message, store, vectors, without_padding

from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.map_messages import GRID, grid_message
from cairn_fusion.ros.messages import (
    ODOMETRY,
    RosHeader,
    read_camera_info,
    read_compressed_image,
    read_image,
    read_path,
    read_pose,
)
from cairn_fusion.ros.point_clouds import read_points
from cairn_map.queries.floor_grid import FloorGrid

EACH = [(name, kind) for name, kinds in vectors().items() for kind in kinds]
STAMPED = RosHeader(1_700_000_001.123456789, "camera_optical")
POSE_ROW = [*POSE["position"].values(), *POSE["orientation"].values()]


def of(name: str, kind: str) -> bytes:
    return bytes.fromhex(vectors()[name][kind]["bytes"])


def test_two_distributions_have_all_types() -> None:
    assert {name: set(kinds) for name, kinds in vectors().items()} == {
        name: set(MESSAGES) for name in ("jazzy", "kilted")
    }


@pytest.mark.parametrize(("name", "kind"), EACH)
def test_types_have_the_hash_and_messages_the_bytes_of_ros(name: str, kind: str) -> None:
    assert store().hash_rihs01(kind) == vectors()[name][kind]["hash"]
    ours = bytes(store().serialize_cdr(rosbags_message(kind, MESSAGES[kind]), kind))
    assert ours == without_padding(kind, of(name, kind))


@pytest.mark.parametrize("name", sorted(vectors()))
def test_messages_of_ros_are_read(name: str) -> None:
    image = read_image(of(name, "sensor_msgs/msg/Image"), Wire.CDR)
    assert (image.header, image.width, image.height, image.encoding, image.step) == (STAMPED, 3, 2, "16UC1", 6)
    assert list(image.data) == list(range(12))
    packed = read_compressed_image(of(name, "sensor_msgs/msg/CompressedImage"), Wire.CDR)
    assert (packed.format, list(packed.data)) == ("jpeg", [255, 216, 255, 217, 7])
    info = read_camera_info(of(name, "sensor_msgs/msg/CameraInfo"), Wire.CDR)
    assert (info.width, info.height, info.model, len(info.distortion)) == (640, 480, "plumb_bob", 5)
    assert info.K.tolist() == (np.arange(9) + 0.5).tolist() and info.P.tolist() == (np.arange(12) + 0.25).tolist()
    points = read_points(of(name, "sensor_msgs/msg/PointCloud2"), Wire.CDR)
    assert points.xyz().tolist() == [[0.0, 1.0, 2.0], [4.0, 5.0, 6.0]]
    odometry = read_pose(of(name, "nav_msgs/msg/Odometry"), Wire.CDR, type_name=ODOMETRY)
    assert (odometry.parent, odometry.child) == ("camera_optical", "base_link") and odometry.pose.tolist() == POSE_ROW
    stamped = read_pose(of(name, "geometry_msgs/msg/PoseStamped"), Wire.CDR, type_name="geometry_msgs/PoseStamped")
    assert stamped.pose.tolist() == POSE_ROW
    path = read_path(of(name, "nav_msgs/msg/Path"), Wire.CDR)
    assert [one.parent for one in path.poses] == ["camera_optical"] * 2  # the path's own where a pose names none
    assert all(one.pose.tolist() == POSE_ROW and one.time_s == STAMPED.time_s for one in path.poses)


def test_a_floor_is_coded_as_ros_codes_it() -> None:
    info: dict[str, Any] = MESSAGES[GRID]["info"]  # type: ignore[assignment]
    ours = grid_message("/map", FloorGrid(np.array([[0, 100, -1], [50, 0, -1]], np.int8), (1.5, -2.25), 0.05, 0.125),
                        HEADER["frame_id"], 1_700_000_001_123_456_789)  # fmt: skip
    straight = {**info, "origin": {**POSE, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}}
    expected = rosbags_message(GRID, {**MESSAGES[GRID], "info": straight})
    assert ours.data == bytes(store().serialize_cdr(expected, GRID))
