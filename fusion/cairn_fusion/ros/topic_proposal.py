"""Proposed mapping of a bag's topics, as the YAML text that `topic_mapping` reads, with questions that it leaves open.

    depth      16 bits or float, "depth" in its name          thermal    16 bits, a thermal camera's name
    amplitude  grey, "infra", "ir" or "amplitude" in its name  colour     every other picture
    labels     grey, "label" or "segmentation" in its name: a comment, for no message names the numbers
    poses      tf, if a moving edge lies above the range camera; else the one odometry or pose topic

A fact that only the maker of the bag knows becomes a question, and `replay` without a file refuses the bag.
"""

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cairn_calib.rig.rig import Spectrum
from cairn_fusion.ros.bag_index import BASE, BagIndex, TopicIndex
from cairn_fusion.ros.images import COLOURS, LABELS
from cairn_fusion.ros.messages import CAMERA_INFO, CLOUDS, COMPRESSED, IMAGE, TRANSFORMS
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_fusion.ros.topic_mapping import DECIDE

AMPLITUDE_WORDS = re.compile(r"infra|amplitude|intensity|(^|[_/])(ir|nir)\d*([_/]|$)")
THERMAL_WORDS = re.compile(r"therm|lwir|flir|boson|lepton|tau2|optris|seek")
IGNORED_WORDS = re.compile(r"confidence|theora|ffmpeg|aligned_.*_mask")
LABEL_WORDS = re.compile(r"segmentation|label")
CAMERA_WORDS = re.compile(r"depth|camera|stereo|rgb|color")
"""Words in the names of clouds that a depth camera's driver makes from its images."""
WORLD_FRAMES = ("odom", "map", "world", "earth")
TOLERANCE_S = (0.005, 0.05)
"""Least and greatest proposal of `time_tolerance_s`: half the time between range images, within these."""
GAP_S = (0.1, 5.0)
"""Least and greatest proposal of `max_gap_s`."""
GAPS = 3
"""Usual gaps between poses that the proposed `max_gap_s` spans."""


PACKETS = {
    **dict.fromkeys(
        ("ouster_ros/PacketMsg", "ouster_msgs/PacketMsg", "ouster_sensor_msgs/PacketMsg"),
        ("an Ouster", "`ros2 launch ouster_ros replay.launch.xml`"),
    ),
    **dict.fromkeys(
        ("velodyne_msgs/VelodyneScan", "velodyne_msgs/VelodynePacket"),
        ("a Velodyne", "the node `velodyne_transform_node` of velodyne_pointcloud"),
    ),
    **dict.fromkeys(
        ("rslidar_msg/RslidarPacket", "rslidar_msgs/rslidarScan", "rslidar_msgs/rslidarPacket"),
        ("a RoboSense", "the node of rslidar_sdk with msg_source 2"),
    ),
    **dict.fromkeys(
        ("pandar_msgs/PandarScan", "hesai_ros_driver/UdpFrame"),
        ("a Hesai", "the node of its driver that publishes points"),
    ),
}
"""Makers of lidars, and the program that makes points of their packets, by the packets' type."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """Proposed mapping, as text to edit."""

    text: str
    questions: tuple[str, ...]
    """Decisions left to the user; with none the text can be used unchanged."""


@dataclass(frozen=True, slots=True)
class Guess:
    """Guess of one camera."""

    name: str
    spectrum: Spectrum
    entry: TopicIndex
    info: str | None
    amplitude: str | None = None
    labels: str | None = None

    @property
    def is_rectified(self) -> bool:
        """True if the topic's name says that its images are rectified."""
        return "rect" in self.entry.topic.name.rsplit("/", 1)[-1]


def propose(index: BagIndex, path: Path, *, command: str | None = None) -> Proposal:
    """Mapping that fits an index of all topics best.

    Args:
        index: of the whole bag.
        path: of the bag; names the recording.
        command: command that takes the file; None: the replay of a bag.
    """
    command = command or f"cairn robot replay {path.name}"
    # Stage 1: cameras by their names and encodings. Each stage adds the questions that it cannot answer.
    questions: list[str] = []
    cameras = _cameras(index, questions)
    ranges = [camera for camera in cameras if camera.spectrum is Spectrum.RANGE]
    questions += _packet_questions(index)
    if not ranges:
        questions.append("no topic looks like depth images; name one under cameras, with `spectrum: range`")
    # Stage 2: poses of the first range camera's frame, and times by its rate.
    frame = ranges[0].entry.frame if ranges else ""
    pose_lines = _pose_lines(index, frame, questions)
    rate_hz = ranges[0].entry.rate_hz if ranges else 0.0
    tolerance_s = float(np.clip(0.5 / rate_hz if rate_hz else 0.02, *TOLERANCE_S))
    # Stage 3: the text, with the questions as comments.
    lines = [
        f"# Which topics of {path.name} are what: {command} --topics THIS_FILE --map URL",
        *(f"# {DECIDE}: {question}" for question in questions),
        f"name: {_quoted(_name(path))}",
        *pose_lines,
        f"time_tolerance_s: {tolerance_s:.2g}  # an image goes with a range image that is at most so far away in time",
        f"scans_per_measurement: {max(1, round(rate_hz))}  # range images in one commit: about a second",
        "cameras:" + ("" if cameras else " {}"),
    ]
    for camera in cameras:
        lines += _camera_lines(camera, index)
    if any(camera.labels for camera in cameras):
        lines.append(
            "# label_names: {0: null, 1: wall, 2: floor}  # class of each number of labels; null: says nothing"
        )
    return Proposal("\n".join(lines) + "\n", tuple(questions))


def _packet_questions(index: BagIndex) -> list[str]:
    """Questions about topics of packets that a lidar's driver has not yet made points of."""
    packets = [
        (entry.topic.name, PACKETS[entry.topic.type]) for entry in index.topics.values() if entry.topic.type in PACKETS
    ]
    return [
        f"{name} holds raw packets of {maker}, no points: play the bag through {program}, record its PointCloud2, "
        "and take that bag"
        for name, (maker, program) in packets
    ]


def _cameras(index: BagIndex, questions: list[str]) -> list[Guess]:
    """One guess for each camera; of its raw and compressed topics the raw one."""
    images = [entry for entry in index.topics.values() if entry.topic.type in (IMAGE, COMPRESSED) and len(entry)]
    images = [entry for entry in images if entry.topic.wire is not None and not IGNORED_WORDS.search(_word(entry))]
    # A compressed topic lies one level below the raw topic of the same camera.
    plain = {entry.topic.name for entry in images if entry.topic.type == IMAGE}
    images = [e for e in images if e.topic.type == IMAGE or e.topic.name.rsplit("/", 1)[0] not in plain]
    roles = {entry.topic.name: _role(entry) for entry in images}
    amplitudes = [entry for entry in images if roles[entry.topic.name] == "amplitude"]
    labels = [entry for entry in images if roles[entry.topic.name] == "labels"]
    guesses: list[Guess] = []
    for spectrum in Spectrum:
        found = [entry for entry in images if roles[entry.topic.name] == spectrum.value]
        for entry in _one_of_each_place(found):
            name = _unique("depth" if spectrum is Spectrum.RANGE else spectrum.value, {g.name for g in guesses})
            info = _info_of(entry, index)
            amplitude = _same_raster(entry, amplitudes) if spectrum is Spectrum.RANGE else None
            guesses.append(Guess(name, spectrum, entry, info, amplitude, _same_raster(entry, labels)))
            if info is None:
                questions.append(f"camera {name}: no CameraInfo next to {entry.topic.name}; write its intrinsics")
    # Depth cameras first, so that the first range camera is one of them if there is any.
    ranges = [guess for guess in guesses if guess.spectrum is Spectrum.RANGE]
    guesses += _lidars(index)
    if len(ranges) > 1:
        names = ", ".join(guess.entry.topic.name for guess in ranges)
        questions.append(f"{names} may be one sensor seen twice (aligned to another camera): keep one of such")
    questions += [
        f"camera {guess.name}: how many kelvin one count is, and at zero counts; 0.01 and 0 are only the usual"
        for guess in guesses
        if guess.spectrum is Spectrum.THERMAL
    ]
    return guesses


def _lidars(index: BagIndex) -> list[Guess]:
    """Guesses for topics of point clouds that a lidar may have made."""
    clouds = [e for e in index.topics.values() if e.topic.type in CLOUDS and len(e) and e.topic.wire is not None]
    found = [e for e in clouds if not CAMERA_WORDS.search(_word(e))]
    return [Guess(f"lidar{n or ''}", Spectrum.RANGE, entry, None) for n, entry in enumerate(found)]


def _role(entry: TopicIndex) -> str:
    """Role of a topic's pictures, by their encoding and name."""
    word, encoding = _word(entry), entry.encoding
    if LABEL_WORDS.search(word):
        return "labels" if encoding in LABELS else "none"
    is_deep = encoding.startswith(("16UC1", "mono16", "32FC1")) or "compressedDepth" in encoding
    if is_deep and ("depth" in word or encoding.startswith("32FC1") or "compressedDepth" in encoding):
        return Spectrum.RANGE
    if is_deep and THERMAL_WORDS.search(word):
        return Spectrum.THERMAL
    if AMPLITUDE_WORDS.search(word) and (is_deep or encoding in ("mono8", "8UC1")):
        return "amplitude"
    if entry.topic.type == COMPRESSED or encoding in COLOURS:
        return "none" if THERMAL_WORDS.search(word) else Spectrum.COLOUR
    return "none"


def _one_of_each_place(entries: list[TopicIndex]) -> Iterator[TopicIndex]:
    """The first topic of each camera: raw before rectified, as its calibration is the raw image's."""
    seen = set()
    for entry in sorted(entries, key=lambda e: ("rect" in e.topic.name.rsplit("/", 1)[-1], e.topic.name)):
        if (place := _place(entry)) not in seen:
            seen.add(place)
            yield entry


def _place(entry: TopicIndex) -> str:
    """The namespace of a camera's topics."""
    depth = 2 if entry.topic.type == COMPRESSED else 1
    return entry.topic.name.rsplit("/", depth)[0]


def _info_of(entry: TopicIndex, index: BagIndex) -> str | None:
    infos = [e for e in index.topics.values() if e.topic.type == CAMERA_INFO and e.info is not None]
    siblings = [e for e in infos if e.topic.name == f"{_place(entry)}/camera_info"]
    alike = [e for e in infos if e.frame == entry.frame and entry.image_size in (None, e.image_size)]
    found = siblings or alike
    return found[0].topic.name if len(found) == 1 else None


def _same_raster(camera: TopicIndex, candidates: Iterable[TopicIndex]) -> str | None:
    """Topic of other images of a camera: the only one with the same frame and raster, or None."""
    mine = (camera.frame, camera.image_size)
    found = [entry for entry in candidates if (entry.frame, entry.image_size) == mine]
    return found[0].topic.name if len(found) == 1 else None


def _pose_lines(index: BagIndex, camera_frame: str, questions: list[str]) -> list[str]:
    """Lines of frames and poses."""
    tf_topics = [e.topic.name for e in index.topics.values() if e.topic.type in TRANSFORMS and len(e)]
    way = index.tree.way_up(camera_frame) if camera_frame else []
    moving = [child for child in way[:-1] if not index.tree.edges[child].is_fixed]
    tracks = {topic: next(iter(track.edges.items())) for topic, track in index.tracks.items()}
    if not moving and not tracks:  # a robot at rest: REP 105 names the frames in which it moves
        edges = [(child, index.tree.edges[child]) for child in way[:-1]]
        moving = [child for child, edge in edges if not edge.is_static and edge.parent in WORLD_FRAMES]
    # A moving edge above the camera; else the only topic of odometry or poses; else a question.
    if moving:
        topic, base, root = next(t for t in [*tf_topics] if "static" not in t), moving[0], way[-1]
        gap_s = max(_gap_s(index.tree, child) for child in moving)
    elif len(tracks) == 1:
        ((topic, (child, edge)),) = tracks.items()
        base, root = child, edge.parent
        gap_s = _gap_s(index.tracks[topic], child)
        if child == BASE:
            base = camera_frame or BASE
            questions.append(f"{topic} does not say what its poses are of; {base} is a guess for frames.base")
        elif camera_frame not in index.tree.frames() | {base} or base not in index.tree.frames() | {camera_frame}:
            questions.append(f"no transforms lead from {camera_frame} to {base}: give each camera T_base_camera")
    else:
        topic, base, root, gap_s = "/tf", BASE, "map", GAP_S[0]
        what = f"choose one of {', '.join(tracks)}" if tracks else "there are neither moving transforms nor odometry"
        questions.append(f"where poses come from: {what}")
    return [
        "frames:",
        f"  map: {_quoted(root)}  # stays; the map's voxels are in this frame",
        f"  base: {_quoted(base)}  # moves, and carries the cameras rigidly",
        "poses:",
        f"  topic: {_quoted(topic)}  # tf, nav_msgs/Odometry or geometry_msgs/PoseStamped",
        f"  max_gap_s: {gap_s:.2g}  # between two poses that are at most so far apart, one is interpolated (slerp)",
    ]


def _gap_s(tree: FrameTree, child: str) -> float:
    """A few times the usual gap between two poses, seconds."""
    gaps_s = np.diff(tree.edges[child].trajectory(child).poses.times_s)
    return float(np.clip(GAPS * np.median(gaps_s) if len(gaps_s) else 0.0, *GAP_S))


def _camera_lines(camera: Guess, index: BagIndex) -> Iterator[str]:
    yield f"  {camera.name}:"
    yield f"    spectrum: {camera.spectrum.value}"
    yield f"    topic: {_quoted(camera.entry.topic.name)}  # {camera.entry.encoding}, {camera.entry.rate_hz:.3g} Hz"
    if camera.entry.topic.type in CLOUDS:
        known = camera.entry.elevations_deg
        if known is None:
            yield "    lidar: {kind: cloud}  # neither rows nor rings tell its beams: each point is a beam of its own"
        else:
            yield "    lidar:"
            yield f"      columns: {min(camera.entry.columns, 4096)}"
            yield f"      elevations_deg: {list(known)}"
        yield f"    frame: {_quoted(camera.entry.frame)}  # x forward, y left, z up"
        return
    if camera.info:
        yield f"    info: {_quoted(camera.info)}"
    else:
        yield "    # intrinsics: {width: 640, height: 480, focal_px: [600, 600], centre_px: [319.5, 239.5]}"
    if camera.is_rectified:
        yield "    rectified: true  # undistorted: of info the matrix P counts, and no distortion"
    yield f"    frame: {_quoted(camera.entry.frame)}  # optical: x right, y down, z forward"
    if camera.entry.frame not in index.tree.frames():
        yield "    # T_base_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # instead of tf; metres"
    if camera.spectrum is Spectrum.RANGE:
        if not camera.entry.encoding.startswith("32FC1"):
            yield "    units_per_m: 1000  # one count is a millimetre, as ROS wants it (REP 118)"
        yield "    convention: z  # along the optical axis; `range`: along each beam, as time of flight measures"
        if camera.amplitude:
            yield f"    amplitude: {_quoted(camera.amplitude)}  # of the range camera's own light, same raster"
    if camera.labels:
        yield f"    # labels: {_quoted(camera.labels)}  # for a layer of classes; give label_names below, too"
    if camera.spectrum is Spectrum.THERMAL:
        yield "    kelvin_per_count: 0.01  # kelvin = counts * kelvin_per_count + kelvin_at_zero"
        yield "    kelvin_at_zero: 0"


def _word(entry: TopicIndex) -> str:
    return entry.topic.name.lower()


def _unique(name: str, taken: set[str]) -> str:
    return next(text for n in range(1, 1000) if (text := name if n == 1 else f"{name}{n}") not in taken)


def _name(path: Path) -> str:
    letters = "".join(c if c.isascii() and c.isalnum() else "-" for c in path.stem).strip("-")
    return letters[:64] or "bag"


def _quoted(text: str) -> str:
    """A string as YAML: JSON's, where it is not plain."""
    return (
        text
        if re.fullmatch(r"[A-Za-z/][A-Za-z0-9_/.-]*", text)
        and text not in ("true", "false", "null", "yes", "no", "on", "off")
        else json.dumps(text)
    )
