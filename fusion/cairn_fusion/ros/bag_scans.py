"""Scans of a bag: the images that belong together, and the pose of the robot.

The range images are the scans, in order of their headers' times; of every other camera the nearest image within
`time_tolerance_s` goes with it. Its pose leads from `frames.base` to `frames.map` at its time.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Spectrum
from cairn_fusion.recording.frame_poses import FrameKey, FramePoses
from cairn_fusion.recording.timed_lists import TimedList
from cairn_fusion.ros.bag import Bag
from cairn_fusion.ros.bag_index import BASE, BagIndex, TopicIndex
from cairn_fusion.ros.messages import TRANSFORMS
from cairn_fusion.ros.topic_mapping import BagMapping, MappedCamera
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)


PoseAt = Callable[[float], Transform]
"""`T_map_base` by time; before the first and after the last pose that one."""


@dataclass(frozen=True, slots=True)
class BagScan:
    """One scan: numbers of its images' messages in their topics."""

    time_s: float
    T_map_rig: Transform
    camera: str
    images: Mapping[str, int]
    """Number of the message, by topic."""


def scans_of(
    bag: Bag,
    index: BagIndex,
    mapping: BagMapping,
    topics: Mapping[str, TopicIndex],
    poses: FramePoses | None = None,
) -> tuple[tuple[BagScan, ...], PoseAt | None]:
    """A scan for each range image between the first and the last pose, in order of time; and the way between them.

    The way is None for poses that are not by time.

    Args:
        bag: named in messages.
        index: of its topics and transforms.
        mapping: meaning of the topics.
        topics: of all images, as they are in the index.
        poses: pose file that counts instead of the bag's poses; then every range image must have a pose.

    Raises:
        BadInputError: no poses of that kind, no way between the two frames, no scan with a pose, or too long a gap.
    """
    lists = {name: _by_time(entry) for name, entry in topics.items()}
    if poses is not None:
        return _scans_with_poses(bag, mapping, lists, poses), poses.pose_near if poses.is_by_time else None
    pose_at, first_s, last_s = poses_of(index, mapping)
    scans: list[BagScan] = []
    for name, camera in mapping.cameras.items():
        if camera.spectrum is not Spectrum.RANGE:
            continue
        times_s = lists[camera.first_topic].times_s
        has_pose = (times_s >= first_s) & (times_s <= last_s)
        if not has_pose.all():
            log.warning(
                "%s: %d of %d images of %s are before the first or after the last pose, and are left out",
                bag.path.name,
                int((~has_pose).sum()),
                len(times_s),
                camera.first_topic,
            )
        for time_s in times_s[has_pose].tolist():
            images = images_near(mapping, camera, lists, time_s)
            scans.append(BagScan(time_s=time_s, T_map_rig=pose_at(time_s), camera=name, images=images))
    if not scans:
        raise BadInputError(
            "no_pose",
            f"{bag.path} has no range image between its first pose ({first_s:.3f} s) and its last ({last_s:.3f} s) of "
            f"{mapping.frames.base} in {mapping.frames.map}; see `cairn robot inspect` for its topics and times",
        )
    in_order = tuple(sorted(scans, key=lambda scan: scan.time_s))
    return in_order, lambda time_s: pose_at(min(max(time_s, first_s), last_s))


def _scans_with_poses(
    bag: Bag, mapping: BagMapping, lists: Mapping[str, TimedList[int]], poses: FramePoses
) -> tuple[BagScan, ...]:
    """A scan for each range image, its pose from a pose file; those without one are left out."""
    found = [
        (time_s, name, camera)
        for name, camera in mapping.cameras.items()
        if camera.spectrum is Spectrum.RANGE
        for time_s in lists[camera.first_topic].times_s.tolist()
    ]
    found.sort(key=lambda entry: entry[0])
    keys = [
        FrameKey(label=f"the image of {camera.first_topic} at {time_s:.6f} s in {bag.path}", number=n, time_s=time_s)
        for n, (time_s, _, camera) in enumerate(found)
    ]
    return tuple(
        BagScan(time_s=time_s, T_map_rig=T, camera=name, images=images_near(mapping, camera, lists, time_s))
        for (time_s, name, camera), T in zip(found, poses.of_frames(keys), strict=True)
        if T is not None
    )


def others_of(mapping: BagMapping, camera: MappedCamera) -> list[str]:
    """Topics of the images that go with those of a range camera; none with points that have no raster."""
    if camera.is_loose:
        return []
    cameras = mapping.cameras.values()
    others = [other.topic for other in cameras if other.spectrum is not Spectrum.RANGE]
    found = [*others, camera.amplitude, *(other.labels for other in cameras)]
    return [topic for topic in found if topic is not None]


def images_near(
    mapping: BagMapping, camera: MappedCamera, lists: Mapping[str, TimedList[int]], time_s: float
) -> dict[str, int]:
    """The images of one scan: the range image itself, and the nearest of every other topic, earlier one of a tie."""
    images = {camera.first_topic: lists[camera.first_topic].nearest(time_s, max_gap_s=0.0)}
    for topic in others_of(mapping, camera):
        images[topic] = lists[topic].nearest(time_s, max_gap_s=mapping.time_tolerance_s)
    return {topic: n for topic, n in images.items() if n is not None}


def _by_time(entry: TopicIndex) -> TimedList[int]:
    """Numbers of messages in order of their headers' times; of equal times the first."""
    times_s, first = np.unique(entry.times(), return_index=True)
    return TimedList(times_s, tuple(first.tolist()))


def poses_of(index: BagIndex, mapping: BagMapping) -> tuple[Callable[[float], Transform], float, float]:
    """`T_map_base` by time, and the first and last time of it.

    Raises:
        BadInputError: the topic holds no poses, or no way leads between the two frames.
    """
    frames, poses = mapping.frames, mapping.poses
    entry = index.topics[poses.topic]
    if entry.topic.type in TRANSFORMS:
        tree, target, source, T_source_base = index.tree, frames.map, frames.base, np.eye(4)
    elif poses.topic in index.tracks:
        tree = index.tracks[poses.topic]
        ((source, edge),) = tree.edges.items()
        target = edge.parent
        # Poses of another frame of the same body, such as its footprint, or of the camera itself.
        is_other = source not in (BASE, frames.base)
        T_source_base = index.tree.fixed_pose(source, frames.base) if is_other else np.eye(4)
        if target != frames.map:
            raise BadInputError(
                "bad_frames", f"{poses.topic} has poses in {target}, not in {frames.map}: say `map: {target}` in frames"
            )
    else:
        raise BadInputError(
            "wrong_topic",
            f"{poses.topic} holds {len(entry)} messages of {entry.topic.type}; tf, nav_msgs/Odometry or "
            "geometry_msgs/PoseStamped with poses is expected",
        )
    first_s, last_s = tree.span_s(target, source)

    def pose_at(time_s: float) -> Transform:
        T_target_source = tree.pose_at(target, source, time_s, max_gap_s=poses.max_gap_s)
        return T_target_source @ T_source_base if is_moved else T_target_source

    is_moved = not np.array_equal(T_source_base, np.eye(4))
    return pose_at, first_s, last_s
