"""Opening of a live source: its topics checked, the head built from what it says, and nothing lost meanwhile.

    topics are offered  ->  types are as the mapping wants  ->  CameraInfo, a message of each camera, and tf  ->  rig

All of it takes eight seconds at most; what is missing after that is named, with what to do. The messages that came
meanwhile are the first ones to be mapped.
"""

import re
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.rig import Rig
from cairn_client.live.inbox import Inbox
from cairn_client.live.live_doors import open_door
from cairn_client.live.live_source import LiveSource
from cairn_fusion.ros.bag import BagMessage, Topic
from cairn_fusion.ros.bag_index import BagIndex, TopicIndex, add_message, wire_of
from cairn_fusion.ros.bag_recording import Survey, image_topics, images_of, rig_of
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import CAMERA_INFO, ODOMETRY, PATH, POSES, TRANSFORMS, RosTransform
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_fusion.ros.topic_mapping import BagMapping, mapping_from_yaml, mapping_of
from cairn_fusion.ros.topic_proposal import propose
from cairn_map.errors import BadInputError, DamagedDataError

OPEN_S = 8.0
"""Longest wait for all that a rig is built from, the connection included."""
SURVEY_S = 3.0
"""Time for which topics are listened to where no file names them."""
LOOK_S = 0.1
EARLY_BYTES_MAX = 256_000_000
"""Bytes of messages that are kept until the rig is known; beyond them the oldest images go."""


@dataclass(frozen=True, slots=True)
class OpenedLive:
    """A live source that can be mapped."""

    rig: Rig
    scans: LiveScans
    topics: dict[str, Topic]
    T_path_rig: Transform
    """Pose of the rig in the frame of the body whose poses the corrections are."""
    fixed: tuple[RosTransform, ...]
    """Poses between the base and what is fixed on it, of which the rig is built."""
    infos: tuple[BagMessage, ...]
    """The CameraInfo of which the rig is built."""
    early: list[BagMessage]
    """Messages that came while it was opened."""
    dropped: Counter[str]
    """Messages that went for room meanwhile, by topic."""


def open_live(
    source: LiveSource,
    mapping: BagMapping,
    *,
    within_s: float = OPEN_S,
    early_bytes_max: int = EARLY_BYTES_MAX,
    steady_s: Callable[[], float] = time.monotonic,
) -> OpenedLive:
    """Open a source, and build the rig of a mapping from what it says.

    Raises:
        BadInputError: no bridge, a topic is missing, silent, or of another type, or no rig can be made of it.
    """
    end_s = steady_s() + within_s
    named = named_topics(mapping)

    def is_wanted(topic: Topic) -> bool:
        """True of the mapping's topics and of all transforms that can be read."""
        return topic.name in named or (topic.type in TRANSFORMS and topic.wire is not None)

    source.open(is_wanted)
    # Stage 1: the topics of the mapping, and their types.
    while not named.keys() <= source.topics.keys() and steady_s() < end_s - within_s / 2:
        time.sleep(LOOK_S)
    topics = {name: topic for name, topic in source.topics.items() if is_wanted(topic)}
    _check_topics(source.url, mapping, topics, offered=source.topics.keys())
    # Stage 2: the rig, from the first message of each topic and all transforms so far.
    index = BagIndex({name: TopicIndex(topic) for name, topic in topics.items()}, FrameTree(source.url), {})
    early, infos = Inbox(bytes_max=early_bytes_max), dict[str, BagMessage]()
    while True:
        for message in source.take(within_s=LOOK_S):
            # A node that started meanwhile may offer transforms, too; one that is gone again counts no more.
            if message.topic not in topics:
                topic = source.topics.get(message.topic)
                if topic is None or not is_wanted(topic):
                    continue
                topics[topic.name], index.topics[topic.name] = topic, TopicIndex(topic)
            early.put(message)
            if topics[message.topic].type == CAMERA_INFO:
                infos.setdefault(message.topic, message)
            _add(index, message, source.url)
        try:
            rig, T_path_rig = _rig_of(index, mapping), _T_path_rig(index.tree, mapping)
            break
        except BadInputError as exc:
            if steady_s() >= end_s:
                raise _still_missing(exc, index, source, within_s) from exc
    scans = LiveScans(mapping.name, mapping, topics)
    fixed = _fixed_edges(index, mapping)
    scans.frames.hold([edge.child for edge in fixed], index.tree)
    waiting = early.take(within_s=0.0)
    return OpenedLive(rig, scans, topics, T_path_rig, fixed, tuple(infos.values()), waiting, early.dropped)


def mapping_for(url: str, file: Path | None, *, ca_file: Path | None = None, within_s: float = SURVEY_S) -> BagMapping:
    """The mapping of a source's topics: that of a topics file, else the proposed one if it leaves no question open.

    Raises:
        BadInputError: kind `undecided`: the proposal leaves something to decide; or the file is none, or no source is
            there.
    """
    if file is not None:
        return mapping_of(file)
    source = open_door(url, ca_file=ca_file)
    try:
        proposal = survey_live(source, seconds=within_s, on_message=lambda: None).proposal
    finally:
        source.close()
    if proposal.questions:
        raise BadInputError(
            "undecided",
            f"{url} leaves something to decide: {'; '.join(proposal.questions)}. Write a file by `cairn robot inspect "
            f"{url} --output live.yaml`, edit it, and give it with --topics live.yaml",
        )
    return mapping_from_yaml(proposal.text, f"the topics proposed for {url}")


def named_topics(mapping: BagMapping) -> dict[str, str]:
    """Topics that a mapping needs, each with its purpose."""
    named = {**mapping.topics(), mapping.poses.topic: "poses"}
    return named if mapping.corrections is None else {**named, mapping.corrections.topic: "corrections"}


def survey_live(
    source: LiveSource,
    *,
    seconds: float,
    on_message: Callable[[], object],
    steady_s: Callable[[], float] = time.monotonic,
) -> Survey:
    """Listen to all topics of a source for some seconds, and propose a mapping.

    Raises:
        BadInputError: no bridge.
    """
    source.open(lambda topic: topic.wire is not None)
    index = BagIndex({}, FrameTree(source.url), {})
    end_s = steady_s() + seconds
    while steady_s() < end_s:
        for message in source.take(within_s=LOOK_S):
            if message.topic not in index.topics:
                topic = source.topics.get(message.topic)
                if topic is None:
                    continue
                index.topics[message.topic] = TopicIndex(topic)
            _add(index, message, source.url)
            on_message()
    for name, topic in source.topics.items():
        index.topics.setdefault(name, TopicIndex(topic))
    ordered = BagIndex(dict(sorted(index.topics.items())), index.tree, index.tracks)
    name = re.sub(r"[^\w.]+", "-", source.url.partition(":")[2]).strip("-") or "robot"
    return Survey(Path(name), ordered, propose(ordered, Path(name), command=f"cairn robot live {source.url}"))


def _add(index: BagIndex, message: BagMessage, url: str) -> None:
    """Add a message; one that is damaged, or a transform that contradicts another, is left to the assembler."""
    try:
        add_message(index, message, url)
    except (BadInputError, DamagedDataError):
        return


def _check_topics(url: str, mapping: BagMapping, topics: dict[str, Topic], *, offered: Collection[str]) -> None:
    """Refuse topics that are not there, or of another type.

    Raises:
        BadInputError: kind `no_topic`, `wrong_topic` or `unknown_encoding`.
    """
    missing = [f"{name} ({what})" for name, what in named_topics(mapping).items() if name not in topics]
    if missing:
        raise BadInputError(
            "no_topic",
            f"{url} offers no topic {', '.join(missing)}; it offers {', '.join(sorted(offered))[:1000] or 'none'}. "
            "Start what publishes it, or write another topic into the topics file (`cairn robot inspect` proposes one)",
        )
    wanted = [(topic, f"camera {camera}", types) for topic, camera, types in image_topics(mapping)]
    wanted += [(c.info, f"camera {name}", (CAMERA_INFO,)) for name, c in mapping.cameras.items() if c.info is not None]
    wanted.append((mapping.poses.topic, "poses", (*sorted(TRANSFORMS), ODOMETRY, *sorted(POSES))))
    if mapping.corrections is not None:
        wanted.append((mapping.corrections.topic, "corrections", (PATH,)))
    for name, what, types in wanted:
        if topics[name].type not in types:
            raise BadInputError(
                "wrong_topic", f"{what}: {name} of {url} holds {topics[name].type}; {' or '.join(types)} is expected"
            )
        wire_of(topics[name])


def _rig_of(index: BagIndex, mapping: BagMapping) -> Rig:
    found = {topic: images_of(index, topic, camera, types) for topic, camera, types in image_topics(mapping)}
    return rig_of(index, mapping, found)


def _still_missing(exc: BadInputError, index: BagIndex, source: LiveSource, within_s: float) -> BadInputError:
    """The error of a source that does not bring what a rig is built from."""
    silent = sorted(name for name, entry in index.topics.items() if not len(entry))
    if exc.kind == "no_messages" and silent:
        return BadInputError(
            "no_messages",
            f"a publisher is there, nothing came in {within_s:g} s: {', '.join(silent)}. Look on the robot with `ros2 "
            f"topic hz {silent[0]}`: its driver may stand still, or no subscriber matches its QoS",
        )
    return BadInputError(exc.kind, f"{exc.message} (after {within_s:g} s at {source.url})")


def _T_path_rig(tree: FrameTree, mapping: BagMapping) -> Transform:
    """Pose of the rig, which is the base, on the body of the corrections.

    Raises:
        BadInputError: kind `bad_frames` or `no_transform`: they are not rigid to each other.
    """
    frame = None if mapping.corrections is None else mapping.corrections.frame
    return np.eye(4) if frame is None else tree.fixed_pose(frame, mapping.frames.base)


def _fixed_edges(index: BagIndex, mapping: BagMapping) -> tuple[RosTransform, ...]:
    """Poses between the base and its cameras, and the body of the topic of poses."""
    tree = index.tree
    frames = [
        camera.frame or index.topics[camera.first_topic].frame
        for camera in mapping.cameras.values()
        if camera.T_base_camera is None
    ]
    if mapping.poses.topic in index.tracks:
        frames += index.tracks[mapping.poses.topic].edges.keys() & tree.frames()
    above_base = set(tree.way_up(mapping.frames.base))
    children = {child for frame in frames for child in above_base.symmetric_difference(tree.way_up(frame))}
    edges = {child: tree.edges[child] for child in sorted(children & tree.edges.keys())}
    return tuple(
        RosTransform(edge.poses[0], edge.parent, child, np.array(edge.poses[1:8])) for child, edge in edges.items()
    )
