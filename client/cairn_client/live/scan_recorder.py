"""Recorder of a live robot's scans: the messages that became them, as a bag that replays to the same map, bit for bit.

    DIR/scans.mcap     images and CameraInfo as they came; the poses that each scan's own is computed from
    DIR/topics.yaml    what the topics are, which `cairn robot replay DIR` follows

An image that went with two scans is in it once, and what became no scan is not. Until it is closed the bag is
`scans.mcap.part`, without an index.
"""

import logging
from collections import deque
from pathlib import Path

from cairn_client.live.live_opening import OpenedLive
from cairn_client.publish.mcap_file import McapFile
from cairn_fusion.ros.bag import BagMessage, Topic
from cairn_fusion.ros.bag_index import BASE, wire_of
from cairn_fusion.ros.live_scans import Edges, ReadyScan
from cairn_fusion.ros.map_messages import MapMessage, edges_message, exact_ns, pose_message
from cairn_fusion.ros.messages import ODOMETRY, TRANSFORMS, RosTransform
from cairn_fusion.ros.topic_mapping import TOPICS_FILE, BagMapping
from cairn_map.errors import BadInputError, ConflictError

log = logging.getLogger(__name__)

BAG_FILE = "scans.mcap"
REMEMBERED = 4096
"""Messages of one topic, or poses of one frame, that are remembered as written: scans that share them are near."""
KINDS = ("topic", "amplitude", "labels")
"""Topics of images that a camera of the topics file may have, or lack where none of them is in the bag."""
HEAD_BYTES = 32
"""Bytes of a message that hold its stamp: two may come at one time of a coarse clock."""


class ScanRecorder:
    """Recorder into one new folder, by the thread that maps."""

    def __init__(self, folder: Path, opened: OpenedLive, mapping: BagMapping) -> None:
        """Begin with what the rig is built from.

        Raises:
            ConflictError: kind `recording_exists`: the folder holds something already.
            BadInputError: kind `bad_output`: it cannot be made.
        """
        self.scans = 0
        """Scans so far."""
        self.refusal = ""
        """Reason for which no more is recorded; empty: there is none."""
        self._is_closed = False
        self._folder = folder
        self._mapping = mapping
        self._topics = opened.topics
        self._has_tf = self._topics[mapping.poses.topic].type in TRANSFORMS
        self._moving = mapping.poses.topic if self._has_tf else "/tf"
        self._written: dict[str, deque[object]] = {}
        self._recorded: set[str] = set()
        """Topics of images so far."""
        self._file = _new_file(folder)
        for info in opened.infos:
            self._send(info)
        if opened.fixed:
            first_ns = min(exact_ns(edge.time_s) for edge in opened.fixed)
            self._file.send(edges_message(self._static, opened.fixed, first_ns))

    @property
    def size_bytes(self) -> int:
        """Size of the bag as far as it is written; 0 if nothing was."""
        return self._file.path.stat().st_size if self._file.path.exists() else 0

    def add(self, ready: ReadyScan) -> None:
        """Record a scan; where the disk is full recording ends, and mapping goes on."""
        if self.refusal:
            return
        try:
            for message in ready.messages.values():
                if self._is_new(message.topic, (message.log_ns, bytes(message.data[:HEAD_BYTES]))):
                    self._send(message)
            self._send_edges(ready.edges, ready.found.time_s)
            if not ready.messages.keys() <= self._recorded:
                self._recorded |= ready.messages.keys()
                self._write_topics()
            self.scans += 1
        except OSError as exc:
            self.refusal = f"recording into {self._folder} has ended: {exc.strerror or exc}"
            log.error("%s", self.refusal)

    def close(self) -> None:
        """Give the bag its index and its name; once."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self._file.__exit__(None, None, None)
        except OSError as exc:
            log.error("%s has no index: %s; `mcap recover` makes one", self._file.path, exc.strerror or exc)

    @property
    def _static(self) -> str:
        return f"{self._moving}_static"

    def _is_new(self, name: str, key: object) -> bool:
        written = self._written.setdefault(name, deque(maxlen=REMEMBERED))
        if key in written:
            return False
        written.append(key)
        return True

    def _send(self, message: BagMessage) -> None:
        topic: Topic = self._topics[message.topic]
        kind = topic.type.replace("/", "/msg/")
        self._file.send(MapMessage(topic.name, kind, bytes(message.data), message.log_ns), wire_of(topic))

    def _send_edges(self, edges: Edges, time_s: float) -> None:
        time_ns = exact_ns(time_s)
        fresh = [(edge, is_static) for edge, is_static in edges if self._is_new(f"edge {edge.child}", edge.time_s)]
        if not self._has_tf:
            is_odometry = self._topics[self._mapping.poses.topic].type == ODOMETRY
            for edge, _ in fresh:
                named = RosTransform(edge.time_s, edge.parent, "" if edge.child == BASE else edge.child, edge.pose)
                topic = self._mapping.poses.topic
                self._file.send(pose_message(topic, named, is_odometry=is_odometry, time_ns=time_ns))
            return
        for topic, of_static in ((self._static, True), (self._moving, False)):
            chosen = [edge for edge, is_static in fresh if is_static is of_static]
            if chosen:
                self._file.send(edges_message(topic, chosen, time_ns))

    def _write_topics(self) -> None:
        """Write the mapping of the cameras that are in the bag."""
        cameras = {
            name: camera.model_copy(
                update={kind: None for kind in KINDS if getattr(camera, kind) not in self._recorded}
            )
            for name, camera in self._mapping.cameras.items()
            if self._recorded.intersection(camera.image_topics)
        }
        names = self._mapping.label_names if any(camera.labels for camera in cameras.values()) else {}
        changed = self._mapping.model_copy(update={"cameras": cameras, "corrections": None, "label_names": names})
        # JSON is YAML.
        text = changed.model_dump_json(by_alias=True, exclude_defaults=True, indent=1)
        (self._folder / TOPICS_FILE).write_text(f"{text}\n", encoding="utf-8")


def _new_file(folder: Path) -> McapFile:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        is_empty = not any(folder.iterdir())
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot record into {folder}: {exc.strerror}") from exc
    if not is_empty:
        raise ConflictError("recording_exists", f"{folder} must be empty to record into it")
    return McapFile(folder / BAG_FILE, packing="LZ4")
