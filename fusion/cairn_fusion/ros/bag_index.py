"""Index of a bag, made in one pass: times and sizes of all messages, and the poses of frames.

Of images only the header is read; pixels are read with their scan (`bag_recording`).
"""

from array import array
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_fusion.ros.bag import MESSAGES_MAX, Bag, BagMessage, Topic, Wire
from cairn_fusion.ros.images import encoding_of
from cairn_fusion.ros.messages import (
    CAMERA_INFO,
    CLOUDS,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    POSES,
    STAMPED,
    TRANSFORMS,
    RosCameraInfo,
    RosHeader,
    RosTransform,
    read_camera_info,
    read_compressed_image,
    read_header,
    read_image,
    read_pose,
    read_transforms,
)
from cairn_fusion.ros.point_clouds import elevations_of, read_cloud
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_map.errors import BadInputError, DamagedDataError

BASE = "base"
"""Child of a pose that names none."""
STATIC_NAME = "static"
"""Part of the names of topics whose transforms hold at all times."""


@dataclass(slots=True)
class TopicIndex:
    """The messages of one topic, in the order in which they were recorded."""

    topic: Topic
    log_ns: "array[int]" = field(default_factory=lambda: array("q"))
    times_s: "array[float]" = field(default_factory=lambda: array("d"))
    """Times of the headers, or of the recording for messages without one."""
    size_bytes: int = 0
    frame: str = ""
    """Frame that the first message names."""
    encoding: str = ""
    """Encoding of the first image, or the format of the first compressed one."""
    image_size: tuple[int, int] | None = None
    """Width and height of the first image or camera info."""
    info: RosCameraInfo | None = None
    elevations_deg: tuple[float, ...] | None = None
    """Elevations of the beams in the first point cloud, degrees, the highest first."""
    columns: int = 0
    """Largest number of points of a beam in the first point cloud."""

    def __len__(self) -> int:
        return len(self.log_ns)

    @property
    def rate_hz(self) -> float:
        """Messages a second, from the first to the last; 0 for one alone."""
        times_s = self.times()
        length_s = float(times_s.max() - times_s.min()) if len(times_s) else 0.0
        return (len(self) - 1) / length_s if length_s > 0 else 0.0

    def times(self) -> npt.NDArray[np.float64]:
        """(N,) `times_s`."""
        return np.array(self.times_s, dtype=np.float64)

    def add(self, message: BagMessage, time_s: float) -> None:
        """Add a message with the time of its header."""
        self.log_ns.append(message.log_ns)
        self.times_s.append(time_s)
        self.size_bytes += len(message.data)

    def describe(self, header: RosHeader, message: BagMessage, wire: Wire) -> None:
        """Take over the properties that all messages of the topic share, from the first one."""
        self.frame = header.frame
        if self.topic.type == IMAGE:
            image = read_image(message.data, wire)
            self.encoding, self.image_size = image.encoding, (image.width, image.height)
        elif self.topic.type == COMPRESSED:
            self.encoding = encoding_of(read_compressed_image(message.data, wire))
        elif self.topic.type == CAMERA_INFO:
            self.info = read_camera_info(message.data, wire)
            self.image_size = (self.info.width, self.info.height)
        elif self.topic.type in CLOUDS:
            points = read_cloud(message.data, wire, type_name=self.topic.type)
            self.elevations_deg, self.image_size = elevations_of(points), (points.width, points.height)
            beams = len(self.elevations_deg or ()) or 1
            self.columns = -(-points.width * points.height // beams)


@dataclass(frozen=True, slots=True)
class BagIndex:
    """Indexes of topics, and all transforms."""

    topics: dict[str, TopicIndex]
    tree: FrameTree
    """Tree of tf alone: a robot that publishes odometry too states the same pose twice."""
    tracks: dict[str, FrameTree]
    """Tree of each topic of odometry or poses, with its one edge; a child without a name is `BASE`."""


def index_bag(
    bag: Bag, topics: Collection[str] | None = None, *, on_message: Callable[[], object] | None = None
) -> BagIndex:
    """Index a bag in one pass.

    Args:
        bag: the bag.
        topics: which topics; None: all.
        on_message: called after each message.

    Raises:
        DamagedDataError: the bag is damaged; the message names topic, time and a next step.
        BadInputError: two topics of poses for one frame, or more than the memory should hold.
    """
    wanted = set(bag.topics if topics is None else topics)
    index = BagIndex({name: TopicIndex(bag.topics[name]) for name in sorted(wanted)}, FrameTree(bag.path.name), {})
    for n, message in enumerate(bag.messages(wanted)):
        add_message(index, message, bag.path)
        if n >= MESSAGES_MAX:
            raise BadInputError("bag_too_large", f"{bag.path} has more than {MESSAGES_MAX} messages; split it")
        if on_message is not None:
            on_message()
    return index


@contextmanager
def translate_message_damage(source: Path | str, message: BagMessage) -> Iterator[None]:
    """Translate errors in a message's bytes into one with its source, topic and time."""
    try:
        yield
    except ValueError as exc:
        raise DamagedDataError(
            "bad_message",
            f"{source}: the message of {message.topic} at {message.log_ns / 1e9:.6f} s is damaged: {exc}; leave the "
            "topic out of the YAML, or record it again",
        ) from exc


def wire_of(topic: Topic) -> Wire:
    """Serialisation of a topic's messages.

    Raises:
        BadInputError: none of ROS.
    """
    if topic.wire is None:
        raise BadInputError(
            "unknown_encoding", f"messages of {topic.name} ({topic.type}) are coded neither as ROS 1 nor CDR"
        )
    return topic.wire


def add_message(index: BagIndex, message: BagMessage, source: Path | str) -> None:
    """Add a message of one of an index's topics.

    Raises:
        DamagedDataError: its bytes are none of its type, or it was recorded before the one before.
        BadInputError: a frame hangs on two others, a pose is none, or there are too many of them.
    """
    entry = index.topics[message.topic]
    if entry.log_ns and message.log_ns < entry.log_ns[-1]:
        raise DamagedDataError("bad_bag", f"{source}: messages of {message.topic} are not in the order of their times")
    time_s = message.log_ns / 1e9
    topic = entry.topic
    if topic.wire is not None:
        with translate_message_damage(source, message):
            if topic.type in STAMPED:
                header = read_header(message.data, topic.wire)
                time_s = header.time_s
                if not len(entry):
                    entry.describe(header, message, topic.wire)
            _add_poses(index, message, topic, topic.wire)
    entry.add(message, time_s)


def _add_poses(index: BagIndex, message: BagMessage, topic: Topic, wire: Wire) -> None:
    """Add the transforms, or the pose, in a message."""
    if topic.type in TRANSFORMS:
        for edge in read_transforms(message.data, wire):
            index.tree.add(edge, is_static=STATIC_NAME in topic.name)
    elif topic.type == ODOMETRY or topic.type in POSES:
        pose = read_pose(message.data, wire, type_name=topic.type)
        track = index.tracks.setdefault(
            topic.name, FrameTree(f"{index.tree.source}: {topic.name}", index.tree.rounding)
        )
        track.add(RosTransform(pose.time_s, pose.parent or "map", pose.child or BASE, pose.pose), is_static=False)
