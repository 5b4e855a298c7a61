"""ROS messages that a map is made from, as the standard packages define them, read out of untrusted bytes.

    ROS 1    little-endian, packed
    ROS 2    CDR (OMG formal/02-06-51, 15.3): four bytes of header, then each number at a multiple of its size

A bag carries the definitions of its messages. They are not used: to decode by a definition means to run a program that
the bag's author wrote, and these types have been the same since ROS 1, except for `seq` in the header. Every length is
compared with the bytes that are left before anything is taken, and pixels are not copied: rosbags' own deserialiser
takes 114 us for a colour image of 640 x 480 in CDR, this one 15 us, and 12 us for its header alone.
"""

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, transform_from_quaternion
from cairn_fusion.ros.bag import Wire

CDR_HEADER_BYTES = 4
TEXT_BYTES_MAX = 4096

IMAGE = "sensor_msgs/Image"
COMPRESSED = "sensor_msgs/CompressedImage"
CAMERA_INFO = "sensor_msgs/CameraInfo"
TRANSFORMS = frozenset(["tf2_msgs/TFMessage", "tf/tfMessage"])
ODOMETRY = "nav_msgs/Odometry"
POSES = frozenset(["geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped"])
PATH = "nav_msgs/Path"
POINTS = "sensor_msgs/PointCloud2"
LIVOX = frozenset(f"{package}/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces"))
"""Clouds of Livox' own message, one definition in three packages."""
CLOUDS = LIVOX | {POINTS}
STAMPED = frozenset([IMAGE, COMPRESSED, CAMERA_INFO, ODOMETRY]) | POSES | CLOUDS
"""Types that begin with a header."""
TRANSFORM_BYTES_MIN = 72
"""Time, two empty names, seven numbers."""
POSE_BYTES_MIN = 68
"""Time, an empty name, seven numbers."""
PATH_POSES_MAX = 100_000
"""Largest number of poses in a path: one a second for a day."""


class WireReader:
    """Reader of a message's fields, one after the other.

    Raises:
        ValueError: the message ends before the field does, or a field cannot be what it says.
    """

    __slots__ = ("_at", "_data", "_is_aligned", "_order", "_origin")

    def __init__(self, data: bytes | memoryview, wire: Wire) -> None:
        self._data = memoryview(data)
        self._is_aligned = wire is Wire.CDR
        self._origin = self._at = CDR_HEADER_BYTES if self._is_aligned else 0
        self._order = "<"
        if self._is_aligned:
            kind = bytes(self._data[:2])
            if len(self._data) < CDR_HEADER_BYTES or kind not in (b"\0\0", b"\0\1"):
                raise ValueError(f"plain CDR (00 00 or 00 01) is expected, it begins with {kind.hex(' ')}")
            self._order = "<" if kind[1] else ">"

    def integer(self, code: str) -> int:
        """A number of the `struct` codes B, H, i, I, Q."""
        number: int = struct.unpack_from(self._order + code, self._data, self._take(struct.calcsize(code), 1))[0]
        return number

    def floats(self, count: int) -> npt.NDArray[np.float64]:
        """(count,) float64."""
        start = self._take(8, count)
        return np.frombuffer(self._data, dtype=f"{self._order}f8", count=count, offset=start).astype(np.float64)

    def text(self) -> str:
        """A string; in CDR its length includes the final zero."""
        size = self.integer("I")
        if size > TEXT_BYTES_MAX:
            raise ValueError(f"a text of {size} bytes, at most {TEXT_BYTES_MAX} are read")
        raw = bytes(self._data[(start := self._take(1, size)) : start + size])
        return (raw.removesuffix(b"\0") if self._is_aligned else raw).decode("utf-8", "replace")

    @property
    def order(self) -> str:
        """Order of the bytes of a number, as `struct` and NumPy name it."""
        return self._order

    def records(self, size: int) -> tuple[memoryview, int, int]:
        """A sequence of structures without gaps inside: its bytes, their number, and the bytes from one to the next.

        Args:
            size: bytes of one, of which the first member is a number of four; in CDR the next one begins at a multiple
                of four, so the last one is shorter than the step.
        """
        count = self.length(size)
        step = -(-size // 4) * 4 if self._is_aligned else size
        taken = max(0, (count - 1) * step + size) if count else 0
        start = self._take(1, taken)
        return self._data[start : start + taken], count, step

    def octets(self) -> memoryview:
        """A sequence of bytes, not copied."""
        size = self.integer("I")
        start = self._take(1, size)
        return self._data[start : start + size]

    def length(self, element_bytes_min: int) -> int:
        """Number of elements of a sequence, each of at least so many bytes."""
        count = self.integer("I")
        if count * element_bytes_min > len(self._data) - self._at:
            raise ValueError(f"{count} elements are announced, {len(self._data) - self._at} bytes are left")
        return count

    def _take(self, size: int, count: int) -> int:
        """Place at which the next field begins; the reader moves behind it."""
        start = self._at
        if self._is_aligned and count:
            start += -(start - self._origin) % size
        if size * count > len(self._data) - start:
            raise ValueError(
                f"the message ends early: {size * count} bytes are expected at {start} of {len(self._data)}"
            )
        self._at = start + size * count
        return start


@dataclass(frozen=True, slots=True)
class RosHeader:
    """Time and frame of a message."""

    time_s: float
    """Seconds since 1970; of the stamp's nanoseconds a float keeps 2e-7 s."""
    frame: str


@dataclass(frozen=True, slots=True)
class RosImage:
    """`sensor_msgs/Image`: rows of `step` bytes."""

    header: RosHeader
    width: int
    height: int
    encoding: str
    is_big_endian: bool
    step: int
    data: memoryview


@dataclass(frozen=True, slots=True)
class RosCompressedImage:
    """`sensor_msgs/CompressedImage`: a file, after some transports with a head of their own."""

    header: RosHeader
    format: str
    data: memoryview


@dataclass(frozen=True, slots=True)
class RosCameraInfo:
    """`sensor_msgs/CameraInfo` as far as a pinhole camera needs it; pixels."""

    header: RosHeader
    width: int
    height: int
    model: str
    distortion: tuple[float, ...]
    K: npt.NDArray[np.float64]
    """(9,) of the raw image."""
    P: npt.NDArray[np.float64]
    """(12,) of the rectified image."""


@dataclass(frozen=True, slots=True)
class RosTransform:
    """Edge of the tree of frames: `T_parent_child` at a time; also the content of pose messages."""

    time_s: float
    parent: str
    child: str
    pose: npt.NDArray[np.float64]
    """(7,) x y z in metres, qx qy qz qw."""

    @property
    def T_parent_child(self) -> Transform:
        """The pose as (4, 4); raises BadInputError if the quaternion is none."""
        return transform_from_quaternion(self.pose[:3], self.pose[3:])


@dataclass(frozen=True, slots=True)
class RosPath:
    """`nav_msgs/Path`: poses of one frame, each with its time."""

    frame: str
    """Frame that the poses are in."""
    poses: list[RosTransform]
    """In their order; a child has no name."""


def plain_type(name: str) -> str:
    """`sensor_msgs/Image` of ROS 2's `sensor_msgs/msg/Image`."""
    return name.replace("/msg/", "/")


def read_header(data: bytes | memoryview, wire: Wire) -> RosHeader:
    """Header of a message of a `STAMPED` type. This and all other readers raise ValueError for other bytes."""
    return header_of(WireReader(data, wire), wire)


def read_image(data: bytes | memoryview, wire: Wire) -> RosImage:
    """A `sensor_msgs/Image`; its pixels are not copied."""
    fields = WireReader(data, wire)
    header = header_of(fields, wire)
    height, width, encoding = fields.integer("I"), fields.integer("I"), fields.text()
    return RosImage(header, width, height, encoding, bool(fields.integer("B")), fields.integer("I"), fields.octets())


def read_compressed_image(data: bytes | memoryview, wire: Wire) -> RosCompressedImage:
    """A `sensor_msgs/CompressedImage`, not yet unpacked."""
    fields = WireReader(data, wire)
    return RosCompressedImage(header_of(fields, wire), fields.text(), fields.octets())


def read_camera_info(data: bytes | memoryview, wire: Wire) -> RosCameraInfo:
    """A `sensor_msgs/CameraInfo`."""
    fields = WireReader(data, wire)
    header = header_of(fields, wire)
    height, width, model = fields.integer("I"), fields.integer("I"), fields.text()
    distortion = tuple(fields.floats(fields.length(8)).tolist())
    K, _, P = fields.floats(9), fields.floats(9), fields.floats(12)
    return RosCameraInfo(header, width, height, model, distortion, K, P)


def read_transforms(data: bytes | memoryview, wire: Wire) -> list[RosTransform]:
    """The edges in a `tf2_msgs/TFMessage`."""
    fields = WireReader(data, wire)
    edges = []
    for _ in range(fields.length(TRANSFORM_BYTES_MIN)):
        header = header_of(fields, wire)
        edges.append(RosTransform(header.time_s, _frame(header.frame), _frame(fields.text()), fields.floats(7)))
    return edges


def read_pose(data: bytes | memoryview, wire: Wire, *, type_name: str) -> RosTransform:
    """The pose in a `nav_msgs/Odometry`, or in one of the `POSES`, whose child has no name."""
    fields = WireReader(data, wire)
    header = header_of(fields, wire)
    child = fields.text() if type_name == ODOMETRY else ""
    return RosTransform(header.time_s, _frame(header.frame), _frame(child), fields.floats(7))


def read_path(data: bytes | memoryview, wire: Wire) -> RosPath:
    """A `nav_msgs/Path`."""
    fields = WireReader(data, wire)
    frame = header_of(fields, wire).frame
    count = fields.length(POSE_BYTES_MIN)
    if count > PATH_POSES_MAX:
        raise ValueError(f"a path of {count} poses, at most {PATH_POSES_MAX} are read")
    poses = []
    for _ in range(count):
        header = header_of(fields, wire)
        poses.append(RosTransform(header.time_s, header.frame or frame, "", fields.floats(7)))
    return RosPath(frame, poses)


def header_of(fields: WireReader, wire: Wire) -> RosHeader:
    """Header at a reader's place."""
    if wire is Wire.ROS1:
        fields.integer("I")  # seq
    seconds, nanoseconds = fields.integer("I" if wire is Wire.ROS1 else "i"), fields.integer("I")
    if nanoseconds >= 10**9:
        raise ValueError(f"a stamp has {nanoseconds} nanoseconds")
    return RosHeader((seconds * 10**9 + nanoseconds) / 1e9, _frame(fields.text()))


def _frame(name: str) -> str:
    """Name of a frame without the slash that ROS 1 wrote before some."""
    return name.removeprefix("/")
