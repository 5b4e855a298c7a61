"""Readings of a map, and a robot's own poses, as messages of ROS 2, for bags, Foxglove and RViz.

    nav_msgs/OccupancyGrid            a storey's floor
    sensor_msgs/PointCloud2           occupied voxels: x y z rgb probability temperature
    tf2_msgs/TFMessage, nav_msgs/Path where robots are and were
    visualization_msgs/MarkerArray    hot spots, marks
    octomap_msgs/Octomap              occupied and free space
    nav_msgs/Odometry, PoseStamped    poses as they came from a robot, bit for bit

The bytes are CDR as `rosbags` writes it, by the definitions of ROS 2 Humble, which later distributions share.
Lengths are metres, temperatures degrees Celsius (REP 103), NaN where there is none.
"""

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cairn_fusion.ros.bag import Wire
from cairn_fusion.ros.messages import RosTransform
from cairn_map.commits.mark import Mark
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.voxels import Voxels
from cairn_map.files.cell_files import colours
from cairn_map.queries.floor_grid import FloorGrid

GRID = "nav_msgs/msg/OccupancyGrid"
CLOUD = "sensor_msgs/msg/PointCloud2"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
MARKERS = "visualization_msgs/msg/MarkerArray"
OCTOMAP = "octomap_msgs/msg/Octomap"
OCTOMAP_FIELDS = "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"
"""As in github.com/OctoMap/octomap_msgs; the other types come with rosbags."""
POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "rgb", "probability", "temperature")])
FLOAT32 = 7
"""`PointField.FLOAT32`."""
CUBE, SPHERE, TEXT, DELETE_ALL = 1, 2, 9, 3
"""Three types and an action of `visualization_msgs/Marker`."""
ZERO_CELSIUS_K = 273.15
UNCOLOURED = 0x808080
"""Grey, for voxels that no colour camera saw."""
SPOT_M = 0.15
"""Diameter of the marker of a point, and height of a text."""
THIN_M = 0.01
"""Least edge of a box's marker: viewers draw none without."""
HOT, MARKED = (1.0, 0.25, 0.0, 0.8), (0.1, 0.5, 1.0, 0.5)
"""Colours of markers: red, green, blue, opacity."""
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
def definition_of(type_name: str, wire: Wire = Wire.CDR) -> str:
    """Definition of a type and of all that it holds, in the form of `.msg` files."""
    is_ros1 = wire is Wire.ROS1
    store = get_typestore(Stores.ROS1_NOETIC) if is_ros1 else _store()
    text: str = store.generate_msgdef(type_name, ros_version=1 if is_ros1 else 2)[0]
    return text


def hash_of(type_name: str) -> str:
    """Hash of a type's definition, RIHS01 (REP 2011), as ROS 2 from Iron on has it."""
    return str(_store().hash_rihs01(type_name))


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


def edges_message(topic: str, edges: Sequence[RosTransform], time_ns: int) -> MapMessage:
    """Transforms as they came from a robot: `read_transforms` reads the same numbers."""
    stamped = [
        _made(
            "geometry_msgs/msg/TransformStamped",
            header=_header(edge.parent, exact_ns(edge.time_s)),
            child_frame_id=edge.child,
            transform=_made(
                "geometry_msgs/msg/Transform",
                translation=_made("geometry_msgs/msg/Vector3", **_xyz(edge.pose[:3].tolist())),
                rotation=_quaternion(edge.pose[3:].tolist()),
            ),
        )
        for edge in edges
    ]
    return _written(topic, TRANSFORMS, _made(TRANSFORMS, transforms=stamped), time_ns)


def pose_message(topic: str, pose: RosTransform, *, is_odometry: bool, time_ns: int) -> MapMessage:
    """A pose as it came from a robot, as `Odometry` or `PoseStamped`: `read_pose` reads the same numbers."""
    header = _header(pose.parent, exact_ns(pose.time_s))
    place = _pose(pose.pose[:3].tolist(), pose.pose[3:].tolist())
    if not is_odometry:
        return _written(topic, POSE, _made(POSE, header=header, pose=place), time_ns)
    still = _made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = _made("geometry_msgs/msg/Twist", linear=still, angular=still)
    message = _made(
        ODOMETRY,
        header=header,
        child_frame_id=pose.child,
        pose=_made("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=np.zeros(36)),
        twist=_made("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    return _written(topic, ODOMETRY, message, time_ns)


def exact_ns(time_s: float) -> int:
    """Nanoseconds of a header's time, of which `header_of` makes the same float again, 0.2 us from the next one."""
    near = time_s * 1e9
    # As `header_of` divides: the nanoseconds as a float, of which several are next to each other here.
    floats = [near, *(math.nextafter(near, end) for end in (-math.inf, math.inf))]
    return next((int(ns) for ns in floats if ns / 1e9 == time_s), round(near))


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


def marks_message(topic: str, marks: Sequence[Mark], frame: str, time_ns: int) -> MapMessage:
    """A box or a sphere, and its name, for each mark; they replace all that were sent before."""
    made = partial(_marker, frame, time_ns, space="marks", colour=MARKED)
    markers = [made(action=DELETE_ALL)]
    for n, mark in enumerate(marks):
        x, y, z = (mm / 1000 for mm in mark.place_mm)
        is_box = any(mark.extent_mm)
        size_m = [max(mm / 1000, THIN_M) for mm in mark.extent_mm] if is_box else [SPOT_M] * 3
        above = (x, y, z + size_m[2] / 2 + SPOT_M)
        markers.append(made(number=2 * n, kind=CUBE if is_box else SPHERE, place=(x, y, z), size_m=size_m))
        markers.append(made(number=2 * n + 1, kind=TEXT, place=above, text=f"{mark.name} ({mark.kind})"))
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
    shown = voxels.of_kind(ChannelKind.COLOUR) or voxels.of_kind(ChannelKind.CLASSES)
    packed = np.full(len(voxels), UNCOLOURED, np.uint32)
    if shown is not None:
        seen = shown.weight > 0
        red, green, blue = colours(voxels)[seen].astype(np.uint32).T
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
    space: str = "hot_spots",
    size_m: Sequence[float] = (SPOT_M, SPOT_M, SPOT_M),
    colour: Sequence[float] = HOT,
) -> Any:
    empty_image = _made("sensor_msgs/msg/CompressedImage", header=_header("", 0), format="", data=np.empty(0, np.uint8))
    return _made(
        "visualization_msgs/msg/Marker",
        header=_header(frame, time_ns),
        ns=space,
        id=number,
        type=kind,
        action=action,
        pose=_pose(place, (0.0, 0.0, 0.0, 1.0)),
        scale=_made("geometry_msgs/msg/Vector3", **_xyz(size_m)),
        color=_made("std_msgs/msg/ColorRGBA", **dict(zip("rgba", colour, strict=True))),
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
