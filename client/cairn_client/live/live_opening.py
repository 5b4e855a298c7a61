"""Opening of a live source: its topics checked, the head built from what it says, and nothing lost meanwhile.

    topics are offered  ->  types are as the mapping wants  ->  CameraInfo, a message of each camera, and tf  ->  rig

All of it takes eight seconds at most; what is missing after that is named, with what to do. The messages that came
meanwhile are the first ones to be mapped.
"""

import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from cairn_calib.rig.rig import Rig
from cairn_client.live.foxglove_source import FoxgloveSource
from cairn_client.live.inbox import Inbox
from cairn_fusion.ros.bag import BagMessage, Topic
from cairn_fusion.ros.bag_index import BagIndex, TopicIndex, add_message, wire_of
from cairn_fusion.ros.bag_recording import Survey, image_topics, images_of, rig_of
from cairn_fusion.ros.live_frames import LiveFrames
from cairn_fusion.ros.live_scans import LiveScans
from cairn_fusion.ros.messages import CAMERA_INFO, ODOMETRY, POSES, TRANSFORMS
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_fusion.ros.topic_mapping import BagMapping
from cairn_fusion.ros.topic_proposal import propose
from cairn_map.errors import BadInputError, DamagedDataError

OPEN_S = 8.0
"""Longest wait for all that a rig is built from, the connection included."""
LOOK_S = 0.1
EARLY_BYTES_MAX = 256_000_000
"""Bytes of messages that are kept until the rig is known; beyond them the oldest images go."""


@dataclass(frozen=True, slots=True)
class OpenedLive:
    """A live source that can be mapped."""

    rig: Rig
    scans: LiveScans
    topics: dict[str, Topic]
    early: list[BagMessage]
    """Messages that came while it was opened."""
    dropped: Counter[str]
    """Messages that went for room meanwhile, by topic."""


def open_live(
    source: FoxgloveSource,
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
    named = {**dict.fromkeys(mapping.topics()), mapping.poses.topic: None}

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
    early = Inbox(bytes_max=early_bytes_max)
    while True:
        for message in source.take(within_s=LOOK_S):
            # A node that started meanwhile may offer transforms, too; one that is gone again counts no more.
            if message.topic not in topics:
                topic = source.topics.get(message.topic)
                if topic is None or not is_wanted(topic):
                    continue
                topics[topic.name], index.topics[topic.name] = topic, TopicIndex(topic)
            early.put(message)
            _add(index, message, source.url)
        try:
            rig = _rig_of(index, mapping)
            break
        except BadInputError as exc:
            if steady_s() >= end_s:
                raise _still_missing(exc, index, source, within_s) from exc
    scans = LiveScans(mapping.name, mapping, topics)
    _hold_cameras(scans.frames, index.tree, mapping, index)
    return OpenedLive(rig, scans, topics, early.take(within_s=0.0), early.dropped)


def survey_live(
    source: FoxgloveSource,
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
    name = source.url.partition("://")[2].replace(":", "-").strip("/")
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
    purposes = {**mapping.topics(), mapping.poses.topic: "poses"}
    missing = [f"{name} ({what})" for name, what in purposes.items() if name not in topics]
    if missing:
        raise BadInputError(
            "no_topic",
            f"{url} offers no topic {', '.join(missing)}; it offers {', '.join(sorted(offered))[:1000] or 'none'}. "
            "Start what publishes it, or write another topic into the topics file (`cairn robot inspect` proposes one)",
        )
    wanted = [(topic, f"camera {camera}", types) for topic, camera, types in image_topics(mapping)]
    wanted += [(c.info, f"camera {name}", (CAMERA_INFO,)) for name, c in mapping.cameras.items() if c.info is not None]
    wanted.append((mapping.poses.topic, "poses", (*sorted(TRANSFORMS), ODOMETRY, *sorted(POSES))))
    for name, what, types in wanted:
        if topics[name].type not in types:
            raise BadInputError(
                "wrong_topic", f"{what}: {name} of {url} holds {topics[name].type}; {' or '.join(types)} is expected"
            )
        wire_of(topics[name])


def _rig_of(index: BagIndex, mapping: BagMapping) -> Rig:
    found = {topic: images_of(index, topic, camera, types) for topic, camera, types in image_topics(mapping)}
    return rig_of(index, mapping, found)


def _still_missing(exc: BadInputError, index: BagIndex, source: FoxgloveSource, within_s: float) -> BadInputError:
    """The error of a source that does not bring what a rig is built from."""
    silent = sorted(name for name, entry in index.topics.items() if not len(entry))
    if exc.kind == "no_messages" and silent:
        return BadInputError(
            "no_messages",
            f"a publisher is there, nothing came in {within_s:g} s: {', '.join(silent)}. Look on the robot with `ros2 "
            f"topic hz {silent[0]}`: its driver may stand still, or no subscriber matches its QoS",
        )
    return BadInputError(exc.kind, f"{exc.message} (after {within_s:g} s at {source.url})")


def _hold_cameras(frames: LiveFrames, tree: FrameTree, mapping: BagMapping, index: BagIndex) -> None:
    """Hold the edges between the base and its cameras, of which the rig is built."""
    children: set[str] = set()
    for camera in mapping.cameras.values():
        if camera.T_base_camera is None:
            above_base = tree.way_up(mapping.frames.base)
            above_camera = tree.way_up(camera.frame or index.topics[camera.topic].frame)
            children |= set(above_base).symmetric_difference(above_camera)
    frames.hold(children, tree)
