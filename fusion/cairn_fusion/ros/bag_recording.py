"""Recording in a bag: scans found in one pass, read one at a time; with or without a mapping of its topics.

index_bag  ->  scans_of       times of all images, all poses           once
BagRecording.scan(i)          decode the images of one range image     each time
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from weakref import finalize

import numpy as np

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import AnyCamera
from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig, mount_camera
from cairn_fusion.clouds.sweep_image import T_LIDAR_CAMERA
from cairn_fusion.recording.frame_poses import PoseOptions, read_frame_poses
from cairn_fusion.recording.recording import measurements_of
from cairn_fusion.recording.scan import Scan
from cairn_fusion.ros.bag import Bag, BagMessage
from cairn_fusion.ros.bag_index import BagIndex, TopicIndex, index_bag, wire_of
from cairn_fusion.ros.bag_scans import scans_of
from cairn_fusion.ros.messages import CLOUDS, COMPRESSED, IMAGE, TRANSFORMS
from cairn_fusion.ros.open_bag import open_bag
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import BagMapping, MappedCamera, camera_of_info, mapping_from_yaml
from cairn_fusion.ros.topic_proposal import Proposal, propose
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError

SKIP_MAX = 256
"""Messages that are skipped one by one; for more of them the bag is searched again."""


@dataclass(slots=True)
class TopicReader:
    """Messages of one topic by number; fast for numbers in rising order."""

    bag: Bag
    index: TopicIndex
    _stream: Iterator[BagMessage] = field(default_factory=lambda: iter(()))
    _next: int = -1
    _last: tuple[int, BagMessage] | None = None

    def message(self, n: int) -> BagMessage:
        """Message n."""
        if self._last is not None and self._last[0] == n:
            return self._last[1]
        # Rewind, or jump: to the first message with the same time, from which numbers count on.
        if not 0 <= self._next <= n <= self._next + SKIP_MAX:
            log_ns = np.array(self.index.log_ns, dtype=np.int64)
            self._next = int(np.searchsorted(log_ns, log_ns[n]))
            self._stream = self.bag.messages([self.index.topic.name], start_ns=int(log_ns[n]))
        for message in self._stream:
            self._next += 1
            if self._next == n + 1:
                self._last = n, message
                return message
        raise DamagedDataError("bad_bag", f"{self.bag.path}: message {n} of {self.index.topic.name} has gone")


class BagRecording:
    """Scans of a bag; see `recording.ScanSource`. The file is closed when the object is garbage collected."""

    def __init__(
        self,
        bag: Bag,
        index: BagIndex,
        mapping: BagMapping,
        *,
        scans_per_measurement: int | None = None,
        poses: PoseOptions | None = None,
        is_deskewed: bool = False,
    ) -> None:
        """Find all scans in an index that holds the mapping's topics.

        Raises:
            BadInputError: a topic or frame is missing or of another type, a camera has no calibration, or there is no
                pose for a scan between others.
        """
        # Topics that are missing or of another type are refused before anything is computed.
        self._topics = {topic: images_of(index, topic, name, types) for topic, name, types in image_topics(mapping)}
        self._readers = {name: TopicReader(bag, entry) for name, entry in self._topics.items()}
        self.name = mapping.name
        self.rig = rig_of(index, mapping, self._topics)
        found = None if poses is None else read_frame_poses(poses, self.rig)
        self._scans, self._pose_at = scans_of(bag, index, mapping, self._topics, found)
        types = {name: entry.topic for name, entry in self._topics.items()}
        self._decoder = ScanDecoder(bag.path.name, mapping, self.rig, types, is_deskewed=is_deskewed)
        self.rounding = index.tree.rounding if found is None else found.rounding
        self.pose_notes: Sequence[str] = () if found is None else found.report()
        size = mapping.scans_per_measurement if scans_per_measurement is None else scans_per_measurement
        self._stops = measurements_of(len(self._scans), size)
        finalize(self, bag.close)

    @property
    def has_times(self) -> bool:
        """True: messages have times."""
        return True

    def __len__(self) -> int:
        return len(self._scans)

    def __iter__(self) -> Iterator[Scan]:
        return map(self.scan, range(len(self)))

    def measurements(self) -> Sequence[range]:
        """The scan indices of each measurement, in order; together all scans, each once."""
        return self._stops

    def place(self, index: int, /) -> tuple[float, Transform]:
        """Time and `T_map_rig` of the scan of an index; its images are not read."""
        return self._scans[index].time_s, self._scans[index].T_map_rig

    def scan(self, index: int, /) -> Scan:
        """One scan, its images read from the bag now.

        Raises:
            NotFoundError: `index` is not in 0 .. len - 1.
            BadInputError: an image is not its camera's in size, or has an encoding that is not read.
            DamagedDataError: an image cannot be decoded.
        """
        if not 0 <= index < len(self):
            raise NotFoundError("no_such_scan", f"{self.name} has scans 0 to {len(self) - 1}, asked for {index}")
        found = self._scans[index]
        return self._decoder.decode(
            found, lambda topic: self._readers[topic].message(found.images[topic]), self._pose_at
        )


def open_bag_recording(
    path: Path,
    mapping: BagMapping,
    *,
    scans_per_measurement: int | None = None,
    poses: PoseOptions | None = None,
    is_deskewed: bool = False,
) -> BagRecording:
    """Scans of a bag, indexed in one pass, its images not yet decoded.

    Raises:
        BadInputError: no bag, or as `BagRecording`.
        DamagedDataError: it is damaged.
    """
    bag = open_bag(path)
    try:
        # One pass over the topics of the mapping, and over all transforms.
        wanted = {*mapping.topics(), *([] if poses else [mapping.poses.topic])}
        if missing := sorted(wanted - bag.topics.keys()):
            raise BadInputError(
                "no_topic",
                f"{path} has no topic {', '.join(missing)}; it has {', '.join(sorted(bag.topics))[:1000]}; "
                "`cairn robot inspect` proposes what to take",
            )
        transforms = {name for name, topic in bag.topics.items() if topic.type in TRANSFORMS}
        index = index_bag(bag, wanted | transforms)
        return BagRecording(
            bag, index, mapping, scans_per_measurement=scans_per_measurement, poses=poses, is_deskewed=is_deskewed
        )
    except BaseException:
        bag.close()
        raise


def image_topics(mapping: BagMapping) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Topics of pixels and points, each with its camera and the types that it may have."""
    for name, camera in mapping.cameras.items():
        yield camera.first_topic, name, tuple(sorted(CLOUDS)) if camera.lidar else (IMAGE, COMPRESSED)
        for topic in camera.image_topics[1:]:
            yield topic, name, (IMAGE, COMPRESSED)


def images_of(index: BagIndex, topic: str, camera: str, types: tuple[str, ...]) -> TopicIndex:
    """The topic of a camera's images.

    Raises:
        BadInputError: it is of another type, coded as ROS does not, or without messages.
    """
    entry = index.topics[topic]
    if entry.topic.type not in types:
        raise BadInputError(
            "wrong_topic", f"camera {camera}: {topic} holds {entry.topic.type}, {' or '.join(types)} is expected"
        )
    wire_of(entry.topic)
    if not len(entry):
        raise BadInputError("no_messages", f"camera {camera}: {topic} has no messages")
    return entry


def rig_of(index: BagIndex, mapping: BagMapping, topics: Mapping[str, TopicIndex]) -> Rig:
    """The cameras at their places on the base.

    Raises:
        BadInputError: a camera has no calibration, or its frame is not fixed on the base.
    """
    cameras = {}
    for name, camera in mapping.cameras.items():
        if camera.T_base_camera is not None:
            T_base_camera = np.array(camera.T_base_camera)
        else:
            frame = camera.frame or topics[camera.first_topic].frame
            T_base_camera = index.tree.fixed_pose(mapping.frames.base, frame)
        # A lidar's frame has ROS's axes, not a camera's.
        if camera.lidar is not None:
            T_base_camera = T_base_camera @ T_LIDAR_CAMERA
        cameras[name] = mount_camera(camera.spectrum, _camera_of(index, name, camera), T_base_camera)
    return Rig(name=mapping.name, cameras=cameras)


def _camera_of(index: BagIndex, name: str, camera: MappedCamera) -> AnyCamera:
    if camera.lidar is not None:
        return camera.lidar.lidar()
    if camera.intrinsics is not None:
        return Camera.model_validate(camera.intrinsics.model_dump())
    info = index.topics[camera.info or ""].info
    if info is None:
        raise BadInputError(
            "no_messages", f"camera {name}: {camera.info} has no CameraInfo messages; give intrinsics instead of info"
        )
    return camera_of_info(info, is_rectified=camera.is_rectified, name=f"camera {name}, {camera.info}")


@dataclass(frozen=True, slots=True)
class Survey:
    """All topics of a bag, and the mapping proposed for it."""

    path: Path
    index: BagIndex
    proposal: Proposal


def survey(path: Path, *, on_message: Callable[[], object] | None = None) -> Survey:
    """Index a whole bag, and propose a mapping for it.

    Raises:
        BadInputError: no bag, or the libraries that read bags are not installed.
        DamagedDataError: it is damaged.
    """
    bag = open_bag(path)
    try:
        index = index_bag(bag, on_message=on_message)
        return Survey(path, index, propose(index, path))
    finally:
        bag.close()


def open_any_bag(
    path: Path,
    mapping: BagMapping | None,
    *,
    scans_per_measurement: int | None = None,
    poses: PoseOptions | None = None,
    is_deskewed: bool = False,
) -> BagRecording:
    """Scans of a bag by a mapping, or by the proposed one if it leaves no question open.

    Raises:
        BadInputError: `undecided`: the message lists the questions; else as `open_bag_recording`.
        DamagedDataError: it is damaged.
    """
    if mapping is None:
        proposal = survey(path).proposal
        if proposal.questions:
            asked = "; ".join(proposal.questions)
            raise BadInputError(
                "undecided",
                f"{path} leaves something to decide: {asked}. Write a file by `cairn robot inspect {path} --output "
                "bag.yaml`, edit it, and give it with --topics bag.yaml",
            )
        mapping = mapping_from_yaml(proposal.text, f"the topics proposed for {path}")
    return open_bag_recording(
        path, mapping, scans_per_measurement=scans_per_measurement, poses=poses, is_deskewed=is_deskewed
    )
