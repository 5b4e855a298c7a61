"""Scans of a live robot: messages in, in any order, and the scans out that a replay of the same messages would find.

    range image at t   waits for   a pose at or after t on every moving edge      else: no tf, tf late, gap in tf
                                   images of other cameras later than t + tolerance     else: without them
                                   at most `max_wait_s`

The choice itself is a bag's (`bag_scans`): of every other camera the nearest image within the tolerance, and the pose
interpolated between its neighbours, never extrapolated. What does not become a scan is counted by its cause.
"""

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import takewhile

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Spectrum
from cairn_fusion.recording.timed_lists import TimedList
from cairn_fusion.ros.bag import HELD_BYTES, BagMessage, Topic
from cairn_fusion.ros.bag_index import BASE, STATIC_NAME, BagIndex, TopicIndex, translate_message_damage, wire_of
from cairn_fusion.ros.bag_scans import BagScan, PoseAt, images_near, others_of, poses_of
from cairn_fusion.ros.live_frames import WINDOW_S, LiveFrames
from cairn_fusion.ros.messages import (
    ODOMETRY,
    POSES,
    TRANSFORMS,
    RosPath,
    RosTransform,
    read_header,
    read_path,
    read_pose,
    read_transforms,
)
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_fusion.ros.topic_mapping import BagMapping, MappedCamera
from cairn_map.errors import BadInputError, DamagedDataError

MAX_WAIT_S = 0.5
SWEEP_S = 0.25
"""Time before and after a cloud's stamp from which its points may be."""
SEEN_MAX = 4096
"""Stamps of one camera that are remembered, so that no image becomes a scan twice."""
IMAGE_BYTES_MAX = 256_000_000
"""Most bytes of images that wait for a decision; beyond it the oldest go, of the topic that holds most."""
OTHERS_S = 2.0
"""Age at which an image that no range image needed is forgotten, behind the newest of its topic."""


Edges = tuple[tuple[RosTransform, bool], ...]
"""Poses, each with True if it holds at all times."""


class Cause(StrEnum):
    """Cause for which a range image becomes no scan."""

    NO_TF = "no tf"
    """No way leads from the base to the map's frame, or none did yet at its time."""
    TF_LATE = "tf late"
    """No pose at or after its time came within the wait."""
    TF_GAP = "gap in tf"
    """The poses before and after it are too far apart."""
    DAMAGED = "damaged"
    AGAIN = "sent twice"
    CLOCK_BACK = "clock set back"
    """The clock of its camera was set back by a minute or more while it waited."""
    NO_ROOM = "no room"
    """Dropped, oldest first, for the bytes of images that may wait."""


@dataclass(frozen=True, slots=True)
class ReadyScan:
    """One scan, its images not yet decoded."""

    found: BagScan
    messages: Mapping[str, BagMessage]
    pose_at: PoseAt
    """Way of the robot around the scan."""
    arrived_s: float
    T_map_odom: Transform
    """Pose in the map of the frame in which the base never jumps; the unit matrix where none is known."""
    edges: Edges
    """Poses that its own is computed from, of tf or of the topic of poses."""


@dataclass(slots=True)
class _Images:
    """Images of one topic in order of their stamps."""

    times_s: list[float] = field(default_factory=list)
    messages: list[BagMessage] = field(default_factory=list)
    size_bytes: int = 0
    """Memory of all images."""

    def is_set_back(self, time_s: float) -> bool:
        """True if a stamp is of a clock that was set back since the newest image."""
        return bool(self.times_s) and time_s < self.times_s[-1] - WINDOW_S

    def add(self, time_s: float, message: BagMessage) -> bool:
        """Add an image; False if there is one of that stamp."""
        at = bisect_left(self.times_s, time_s)
        if at < len(self.times_s) and self.times_s[at] == time_s:
            return False
        self.times_s.insert(at, time_s)
        self.messages.insert(at, message)
        self.size_bytes += _held_bytes(message)
        return True

    def forget(self, time_s: float) -> None:
        """Drop the image of a stamp, if it is there."""
        at = bisect_left(self.times_s, time_s)
        if at < len(self.times_s) and self.times_s[at] == time_s:
            self._drop(slice(at, at + 1))

    def forget_before(self, time_s: float) -> None:
        """Drop the images before a time."""
        self._drop(slice(0, bisect_left(self.times_s, time_s)))

    def clear(self) -> None:
        """Drop all images."""
        self._drop(slice(0, None))

    def timed(self) -> TimedList[int]:
        """Numbers of the images by time."""
        return TimedList(np.array(self.times_s, np.float64), tuple(range(len(self.times_s))))

    def _drop(self, which: slice) -> None:
        self.size_bytes -= sum(map(_held_bytes, self.messages[which]))
        del self.times_s[which], self.messages[which]


def _held_bytes(message: BagMessage) -> int:
    return len(message.data) + HELD_BYTES


@dataclass(frozen=True, slots=True)
class _Pending:
    """Range image that waits for its pose and for other images."""

    camera: str
    time_s: float
    arrived_s: float


@dataclass(frozen=True, slots=True)
class _Way:
    """Way of the robot around the time of a range image."""

    pose_at: PoseAt
    first_s: float
    last_s: float
    T_map_odom: Transform
    edges: Edges


class LiveScans:
    """Assembler of one robot's scans; by one thread."""

    def __init__(
        self,
        source: str,
        mapping: BagMapping,
        topics: Mapping[str, Topic],
        *,
        max_wait_s: float = MAX_WAIT_S,
        image_bytes_max: int = IMAGE_BYTES_MAX,
    ) -> None:
        """Args: source: name of the robot in errors; topics: those of the mapping, and all transforms."""
        self.frames = LiveFrames(source)
        self.arrived: Counter[str] = Counter()
        """Range images that came, by camera."""
        self.left_out: Counter[Cause] = Counter()
        """Range images that became no scan, by cause."""
        self.alone = 0
        """Scans that lack an image of another camera."""
        self.damaged = 0
        """Messages of any topic that could not be read."""
        self.frame_error = ""
        """Newest reason for which a transform was not taken, or no way leads to the map; empty: there is none."""
        self.last_s = -np.inf
        """Stamp of the range image that came last; a newest one would stay at one wrong stamp of the future."""
        self._path: BagMessage | None = None
        self._source = source
        self._mapping = mapping
        self._topics = dict(topics)
        self._max_wait_s = max_wait_s
        self._image_bytes_max = image_bytes_max
        self._track = LiveFrames(f"{source}: {mapping.poses.topic}")
        self._ranges = {c.first_topic: name for name, c in mapping.cameras.items() if c.spectrum is Spectrum.RANGE}
        self._images = {topic: _Images() for camera in mapping.cameras.values() for topic in camera.image_topics}
        self._pending: list[_Pending] = []
        self._seen: dict[str, deque[float]] = {topic: deque(maxlen=SEEN_MAX) for topic in self._ranges}

    @property
    def waiting(self) -> int:
        """Range images that wait for their pose, or for other images."""
        return len(self._pending)

    @property
    def held_bytes(self) -> int:
        """Memory of the images that wait, bytes."""
        return sum(images.size_bytes for images in self._images.values())

    def take_path(self) -> RosPath | None:
        """The newest path of the topic of corrections that can be read, once; None: there is no new one."""
        # Read here, not when it comes: a path of a day takes a second, and each keyframe publishes it again.
        message, self._path = self._path, None
        if message is None:
            return None
        try:
            with translate_message_damage(self._source, message), np.errstate(all="ignore"):
                return read_path(message.data, wire_of(self._topics[message.topic]))
        except DamagedDataError:
            self.damaged += 1
            return None

    def add(self, message: BagMessage, now_s: float) -> None:
        """Add a message of one of the topics; one that cannot be read is counted.

        Args:
            message: as it came.
            now_s: steady seconds.

        Raises:
            BadInputError: kind `frames_moved`: a frame that carries cameras moves.
        """
        topic = self._topics.get(message.topic)
        if topic is None:
            return
        try:
            # Numbers of strangers may be as large as they like: what overflows is refused by its size.
            with translate_message_damage(self._source, message), np.errstate(all="ignore"):
                self._add(message, topic, now_s)
        except DamagedDataError:
            self.damaged += 1
            if message.topic in self._ranges:
                self.arrived[self._ranges[message.topic]] += 1
                self.left_out[Cause.DAMAGED] += 1

    def _add(self, message: BagMessage, topic: Topic, now_s: float) -> None:
        wire = wire_of(topic)
        if topic.type in TRANSFORMS:
            for edge in read_transforms(message.data, wire):
                self._add_pose(self.frames, edge, is_static=STATIC_NAME in topic.name)
        elif topic.name == self._mapping.poses.topic and (topic.type == ODOMETRY or topic.type in POSES):
            pose = read_pose(message.data, wire, type_name=topic.type)
            named = RosTransform(pose.time_s, pose.parent or "map", pose.child or BASE, pose.pose)
            if self._track.edges and named.child not in self._track.edges:
                self.frame_error = f"{topic.name} has poses of {named.child} and of {next(iter(self._track.edges))}"
                return
            self._add_pose(self._track, named, is_static=False)
        elif topic.name in self._images:
            self._add_image(message, topic, read_header(message.data, wire).time_s, now_s)
        elif self._mapping.corrections is not None and topic.name == self._mapping.corrections.topic:
            self._path = message

    def _add_pose(self, frames: LiveFrames, found: RosTransform, *, is_static: bool) -> None:
        try:
            frames.add(found, is_static=is_static)
        except BadInputError as exc:
            if exc.kind == "frames_moved":
                raise
            self.frame_error = exc.message

    def _add_image(self, message: BagMessage, topic: Topic, time_s: float, now_s: float) -> None:
        camera = self._ranges.get(topic.name)
        if camera is not None:
            self.arrived[camera] += 1
            self.last_s = time_s
            if time_s in self._seen[topic.name]:
                self.left_out[Cause.AGAIN] += 1
                return
            self._seen[topic.name].append(time_s)
        images = self._images[topic.name]
        if images.is_set_back(time_s):
            # What waits is of the other time, and a scan is nothing without its own image.
            for pending in [one for one in self._pending if one.camera == camera]:
                self._leave_out(pending, Cause.CLOCK_BACK)
            images.clear()
        is_new = images.add(time_s, message)
        if camera is not None and is_new:
            self._pending.append(_Pending(camera, time_s, now_s))
        elif camera is not None:  # more stamps ago than are remembered
            self.left_out[Cause.AGAIN] += 1
        self._keep_bounds(images)

    def _keep_bounds(self, images: _Images) -> None:
        """Forget images that no range image can need, and beyond the bytes that may wait the oldest."""
        needed_s = min((pending.time_s for pending in self._pending), default=np.inf)
        images.forget_before(min(needed_s - self._mapping.time_tolerance_s, images.times_s[-1] - OTHERS_S))
        while self.held_bytes > self._image_bytes_max and len(self._pending) > 1:
            self._leave_out(min(self._pending, key=lambda pending: pending.arrived_s), Cause.NO_ROOM)
            for one in self._images.values():
                one.forget_before(min(pending.time_s for pending in self._pending) - self._mapping.time_tolerance_s)
        # Images that no range image asks for, or of stamps that are close together, have no end of their own.
        while self.held_bytes > self._image_bytes_max:
            topic, largest = max(self._images.items(), key=lambda entry: entry[1].size_bytes)
            oldest_s = largest.times_s[0]
            camera = self._ranges.get(topic)
            for pending in [one for one in self._pending if one.camera == camera and one.time_s == oldest_s]:
                self._leave_out(pending, Cause.NO_ROOM)
            largest.forget(oldest_s)

    def ready(self, now_s: float, *, is_over: bool = False) -> Iterator[ReadyScan]:
        """Scans that are complete, in order of time; those that waited too long are taken as they are, or left out.

        Args:
            now_s: steady seconds.
            is_over: no more messages come.
        """
        for pending in sorted(self._pending, key=lambda pending: pending.time_s):
            camera = self._mapping.cameras[pending.camera]
            is_overdue = is_over or now_s - pending.arrived_s >= self._max_wait_s
            if not is_overdue and not self._has_others(camera, pending.time_s):
                continue
            way = self._way(camera, pending.time_s, is_overdue=is_overdue)
            if way is None:
                continue
            self._pending.remove(pending)
            if isinstance(way, Cause):
                self.left_out[way] += 1
            else:
                yield self._scan(pending, camera, way)

    def _has_others(self, camera: MappedCamera, time_s: float) -> bool:
        """True if no later image of another camera can be nearer."""
        for topic in others_of(self._mapping, camera):
            images = self._images[topic]
            if not images.times_s:
                return False
            at = bisect_left(images.times_s, time_s)
            has_same = at < len(images.times_s) and images.times_s[at] == time_s
            if not has_same and images.times_s[-1] < time_s + self._mapping.time_tolerance_s:
                return False
        return True

    def _way(self, camera: MappedCamera, time_s: float, *, is_overdue: bool) -> _Way | Cause | None:
        """The way of the robot around a time; None: more may come; a cause: it comes too late."""
        reach_s = SWEEP_S if camera.is_loose else 0.0
        span = time_s - reach_s, time_s + reach_s
        topic = self._topics[self._mapping.poses.topic]
        index = BagIndex(
            {topic.name: TopicIndex(topic)}, self.frames.tree(*span), {topic.name: self._track.tree(*span)}
        )
        try:
            if topic.type not in TRANSFORMS and not self._track.edges:
                return Cause.NO_TF if is_overdue else None
            pose_at, first_s, last_s = poses_of(index, self._mapping)
        except BadInputError as exc:
            self.frame_error = exc.message
            return Cause.NO_TF if is_overdue else None
        if not first_s <= time_s <= last_s or (not is_overdue and last_s < span[1]):
            return (Cause.NO_TF if time_s < first_s else Cause.TF_LATE) if is_overdue else None
        try:
            pose_at(time_s)
            T_map_odom = self._T_map_odom(index.tree, time_s)
        except BadInputError as exc:
            self.frame_error = exc.message
            return Cause.TF_GAP if is_overdue else None
        self.frame_error = ""
        return _Way(pose_at, first_s, last_s, T_map_odom, tuple(self._edges(index.tree, span)))

    def _edges(self, tree: FrameTree, span: tuple[float, float]) -> Iterator[tuple[RosTransform, bool]]:
        """Poses around a span of time on the way from the base to the map."""
        if self._topics[self._mapping.poses.topic].type not in TRANSFORMS:
            edges = list(self._track.edges.values())
        else:
            ways = tree.way_up(self._mapping.frames.base), tree.way_up(self._mapping.frames.map)
            children = set(ways[0]).symmetric_difference(ways[1]) & self.frames.edges.keys()
            edges = [self.frames.edges[child] for child in sorted(children)]
        for edge in edges:
            yield from ((found, edge.is_static) for found in edge.between(*span))

    def _T_map_odom(self, tree: FrameTree, time_s: float) -> Transform:
        """Pose of the odometry's frame at a time at which the base has one; the unit matrix without such a frame."""
        frames, poses = self._mapping.frames, self._mapping.poses
        if self._topics[poses.topic].type not in TRANSFORMS:
            return np.eye(4)
        way = list(takewhile(lambda frame: frame != frames.map, tree.way_up(frames.base)))
        if frames.odom not in way:
            return np.eye(4)
        return tree.pose_at(frames.map, frames.odom, time_s, max_gap_s=poses.max_gap_s)

    def _scan(self, pending: _Pending, camera: MappedCamera, way: _Way) -> ReadyScan:
        pose_at, first_s, last_s = way.pose_at, way.first_s, way.last_s
        lists = {
            topic: self._images[topic].timed() for topic in (camera.first_topic, *others_of(self._mapping, camera))
        }
        numbers = images_near(self._mapping, camera, lists, pending.time_s)
        self.alone += len(numbers) < len(lists)
        messages = {topic: self._images[topic].messages[n] for topic, n in numbers.items()}
        self._images[camera.first_topic].forget(pending.time_s)
        found = BagScan(time_s=pending.time_s, T_map_rig=pose_at(pending.time_s), camera=pending.camera, images=numbers)
        return ReadyScan(
            found,
            messages,
            lambda time_s: pose_at(min(max(time_s, first_s), last_s)),
            pending.arrived_s,
            way.T_map_odom,
            way.edges,
        )

    def _leave_out(self, pending: _Pending, cause: Cause) -> None:
        """Drop a range image that waits, and count it."""
        self._pending.remove(pending)
        self._images[self._mapping.cameras[pending.camera].first_topic].forget(pending.time_s)
        self.left_out[cause] += 1
