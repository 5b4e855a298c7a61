"""Readings of a map as messages of ROS 2, for bags, Foxglove and RViz.

    nav_msgs/OccupancyGrid            a storey's floor
    sensor_msgs/PointCloud2           occupied voxels: x y z rgb probability temperature
    tf2_msgs/TFMessage, nav_msgs/Path where robots are and were
    visualization_msgs/MarkerArray    hot spots
    octomap_msgs/Octomap              occupied and free space

The bytes are CDR as `rosbags` writes it, by the definitions of ROS 2 Humble, which later distributions share.
Lengths are metres, temperatures degrees Celsius (REP 103), NaN where there is none.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.voxels import Voxels
from cairn_map.queries.floor_grid import FloorGrid

GRID = "nav_msgs/msg/OccupancyGrid"
CLOUD = "sensor_msgs/msg/PointCloud2"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"
MARKERS = "visualization_msgs/msg/MarkerArray"
OCTOMAP = "octomap_msgs/msg/Octomap"
OCTOMAP_FIELDS = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"
"""As in github.com/OctoMap/octomap_msgs; the other types come with rosbags."""
POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "rgb", "probability", "temperature")])
FLOAT32 = 7
"""`PointField.FLOAT32`."""
SPHERE, TEXT, DELETE_ALL = 2, 9, 3
"""Two types and an action of `visualization_msgs/Marker`."""
ZERO_CELSIUS_K = 273.15
UNCOLOURED = 0x808080
"""Grey, for voxels that no colour camera saw."""
SPOT_M = 0.15
"""Diameter of a hot spot's marker, and height of its text."""
TIME_S_MAX = 2**31 - 1
"""Latest time of a message, UTC seconds since 1970: `builtin_interfaces/Time` has 32 bits with a sign."""
TREE_DATA = b"\ndata\n"
"""End of the head of OctoMap's files."""


class MapMessage(NamedTuple):
    """One message on its way."""

    topic: str
    type_name: str
    data: bytes
    """CDR."""
    time_ns: int
    """UTC nanoseconds since 1970."""


class RobotPose(NamedTuple):
    """Pose of a robot's rig in the map, with its time."""

    time_s: float
    """UTC seconds since 1970, 0 to `TIME_S_MAX`."""
    t_map_rig: Sequence[float]
    q_map_rig: Sequence[float]
    """x y z w."""


class HotSpot(NamedTuple):
    """A hot place of a map."""

    point_m: Sequence[float]
    kelvin: float


@lru_cache(maxsize=1)
def _store() -> Any:
    # Not when the module is imported: it compiles a class a type.
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(OCTOMAP_FIELDS, OCTOMAP))
    return store


@lru_cache
def definition_of(type_name: str) -> str:
    """Definition of a type and of all that it holds, in the form of `.msg` files."""
    text: str = _store().generate_msgdef(type_name, ros_version=2)[0]
    return text


def grid_message(topic: str, grid: FloorGrid, frame: str, time_ns: int) -> MapMessage:
    """A storey's floor."""
    H, W = grid.values.shape
    about = _made(
        "nav_msgs/msg/MapMetaData",
        map_load_time=_time(time_ns),
        resolution=grid.edge_m,
        width=W,
        height=H,
        origin=_pose((*grid.origin_m, grid.ground_m), (0.0, 0.0, 0.0, 1.0)),
    )
    message = _made(GRID, header=_header(frame, time_ns), info=about, data=grid.values.ravel())
    return _written(topic, GRID, message, time_ns)


def cloud_message(topic: str, voxels: Voxels, frame: str, time_ns: int) -> MapMessage:
    """Centres of voxels with colour, probability and temperature."""
    points = np.empty(len(voxels), POINT)
    points["x"], points["y"], points["z"] = voxels.centres_m.T
    points["rgb"] = _packed_colours(voxels)
    points["probability"] = voxels.probability
    warmth = voxels.of_kind(ChannelKind.TEMPERATURE)
    points["temperature"] = np.nan if warmth is None else warmth.mean - ZERO_CELSIUS_K
    fields = [
        _made("sensor_msgs/msg/PointField", name=name, offset=4 * n, datatype=FLOAT32, count=1)
        for n, name in enumerate(POINT.names or ())
    ]
    message = _made(
        CLOUD,
        header=_header(frame, time_ns),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8).ravel() if len(points) else np.empty(0, np.uint8),
        is_dense=False,
    )
    return _written(topic, CLOUD, message, time_ns)


def transforms_message(topic: str, poses: dict[str, RobotPose], frame: str, time_ns: int) -> MapMessage:
    """Poses of robots: `T_map_rig` of each, as the frame of its name."""
    edges = [
        _made(
            "geometry_msgs/msg/TransformStamped",
            header=_header(frame, _nanoseconds(pose)),
            child_frame_id=name,
            transform=_made(
                "geometry_msgs/msg/Transform",
                translation=_made("geometry_msgs/msg/Vector3", **_xyz(pose.t_map_rig)),
                rotation=_quaternion(pose.q_map_rig),
            ),
        )
        for name, pose in poses.items()
    ]
    return _written(topic, TRANSFORMS, _made(TRANSFORMS, transforms=edges), time_ns)


def path_message(topic: str, poses: Sequence[RobotPose], frame: str, time_ns: int) -> MapMessage:
    """A robot's way, oldest pose first."""
    stamped = [
        _made(
            "geometry_msgs/msg/PoseStamped",
            header=_header(frame, _nanoseconds(pose)),
            pose=_pose(pose.t_map_rig, pose.q_map_rig),
        )
        for pose in poses
    ]
    return _written(topic, PATH, _made(PATH, header=_header(frame, time_ns), poses=stamped), time_ns)


def hot_spots_message(topic: str, spots: Sequence[HotSpot], frame: str, time_ns: int) -> MapMessage:
    """A sphere and its temperature for each spot; they replace all that were sent before."""
    markers = [_marker(frame, time_ns, action=DELETE_ALL)]
    for n, spot in enumerate(spots):
        x, y, z = spot.point_m
        text = f"{spot.kelvin - ZERO_CELSIUS_K:.1f} \N{DEGREE SIGN}C"
        markers.append(_marker(frame, time_ns, number=2 * n, kind=SPHERE, place=(x, y, z)))
        markers.append(_marker(frame, time_ns, number=2 * n + 1, kind=TEXT, place=(x, y, z + SPOT_M), text=text))
    return _written(topic, MARKERS, _made(MARKERS, markers=markers), time_ns)


def octomap_message(topic: str, tree_file: bytes, edge_m: float, frame: str, time_ns: int) -> MapMessage:
    """An octree of OctoMap's out of its `.bt` file.

    Raises:
        DamagedDataError: kind `bad_octree`: the file has no head.
    """
    head, mark, tree = tree_file.partition(TREE_DATA)
    if not mark or not head.startswith(b"# Octomap OcTree binary file"):
        raise DamagedDataError("bad_octree", f"a .bt file begins with its head; this one with {tree_file[:32]!r}")
    message = _made(
        OCTOMAP,
        header=_header(frame, time_ns),
        binary=True,
        id="OcTree",
        resolution=edge_m,
        data=np.frombuffer(tree, np.int8),
    )
    return _written(topic, OCTOMAP, message, time_ns)


def _written(topic: str, type_name: str, message: Any, time_ns: int) -> MapMessage:
    return MapMessage(topic, type_name, bytes(_store().serialize_cdr(message, type_name)), time_ns)


def _made(type_name: str, **fields: object) -> Any:
    return _store().types[type_name](**fields)


def _time(time_ns: int) -> Any:
    return _made("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def _nanoseconds(pose: RobotPose) -> int:
    return int(pose.time_s * 1e9)


def _header(frame: str, time_ns: int) -> Any:
    return _made("std_msgs/msg/Header", stamp=_time(time_ns), frame_id=frame)


def _xyz(place: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, place), strict=True))


def _quaternion(q: Sequence[float]) -> Any:
    return _made("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q), strict=True)))


def _pose(t: Sequence[float], q: Sequence[float]) -> Any:
    place = _made("geometry_msgs/msg/Point", **_xyz(t))
    return _made("geometry_msgs/msg/Pose", position=place, orientation=_quaternion(q))


def _packed_colours(voxels: Voxels) -> npt.NDArray[np.float32]:
    """(N,) 0x00RRGGBB, as the bits of a float, which is how PCL has colours."""
    colour = voxels.of_kind(ChannelKind.COLOUR)
    packed = np.full(len(voxels), UNCOLOURED, np.uint32)
    if colour is not None:
        seen = colour.weight > 0
        red, green, blue = np.clip(np.rint(colour.mean[seen]), 0, 255).astype(np.uint32).T
        packed[seen] = (red << 16) | (green << 8) | blue
    return packed.view(np.float32)


def _marker(
    frame: str,
    time_ns: int,
    *,
    number: int = 0,
    kind: int = SPHERE,
    action: int = 0,
    place: Sequence[float] = (0.0, 0.0, 0.0),
    text: str = "",
) -> Any:
    empty_image = _made("sensor_msgs/msg/CompressedImage", header=_header("", 0), format="", data=np.empty(0, np.uint8))
    return _made(
        "visualization_msgs/msg/Marker",
        header=_header(frame, time_ns),
        ns="hot_spots",
        id=number,
        type=kind,
        action=action,
        pose=_pose(place, (0.0, 0.0, 0.0, 1.0)),
        scale=_made("geometry_msgs/msg/Vector3", x=SPOT_M, y=SPOT_M, z=SPOT_M),
        color=_made("std_msgs/msg/ColorRGBA", r=1.0, g=0.25, b=0.0, a=0.8),
        lifetime=_made("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=empty_image,
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=_made("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
