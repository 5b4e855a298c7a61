"""Publisher of a map: its floor, occupied voxels, hot spots and robots, as messages to any number of sinks.

Topics:

/map                        nav_msgs/OccupancyGrid: the storey's floor, after each change
/cairn/points               sensor_msgs/PointCloud2: all occupied voxels, at most every 10 s
/cairn/changed_points       sensor_msgs/PointCloud2: those of the cells that changed
/cairn/hot_spots            visualization_msgs/MarkerArray: the hottest places
/cairn/marks                visualization_msgs/MarkerArray: what robots and people marked, after each change
/cairn/octomap              octomap_msgs/Octomap: occupied and free space, once, where it is asked for
/tf                         tf2_msgs/TFMessage: where robots are, each the frame of its name
/cairn/robots/NAME/path     nav_msgs/Path: the way of one since publishing began, a pose every 5 cm, at most every 3 s
"""

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

from cairn_client.http.api import MapApi
from cairn_client.http.mark_pages import mark_pages
from cairn_client.publish.followed_map import FollowedMap
from cairn_fusion.ros.map_messages import (
    TIME_S_MAX,
    HotSpot,
    MapMessage,
    RobotPose,
    cloud_message,
    grid_message,
    hot_spots_message,
    marks_message,
    octomap_message,
    path_message,
    transforms_message,
)
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_map.queries.floor_grid import Band, FloorGrid
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.wire.mark_messages import MarkEntry
from cairn_map.wire.messages import RobotStatus

HOT_SPOTS = 10
WHOLE_S = 10.0
"""Shortest time between two clouds of all voxels: they may be megabytes."""
PATH_S = 3.0
"""Shortest time between two messages of a robot's path: each holds the whole way."""
STEP_M = 0.05
"""Distance between poses of a path, until it is long."""
POSES_MAX = 2000
"""Poses of a path, even; one that grows longer keeps every second pose, and goes on with steps of twice the length."""
ROBOTS_MAX = 1000
MARKS_MAX = 2000
"""Marks in one message, the newest; each takes two markers of some 300 bytes."""
MARK_PAGES_MAX = 200
"""Most pages that are taken at a time; the next change goes on."""
TREE_BYTES_MAX = 256 << 20
STOREY_RATIO = 2.0
"""Free area of a storey that is published in another one's place, as a multiple of that one's: tables come and go."""


class Sink(Protocol):
    """Place that messages go to: a file, or a server of viewers."""

    def send(self, message: MapMessage) -> None:
        """Take a message."""
        ...


@dataclass(frozen=True, slots=True)
class FloorChoice:
    """Storey that is published, and the robot that drives on it."""

    ground_m: float | None
    """None: that of the largest storey, until another one has twice its free area."""
    band_m: Band | None
    frame: str
    """Frame of all messages: the map's."""


class MapPublisher:
    """Publisher of a followed map; not thread-safe."""

    def __init__(
        self,
        api: MapApi,
        followed: FollowedMap,
        sinks: Sequence[Sink],
        choice: FloorChoice,
        *,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._api = api
        self._followed = followed
        self._sinks = sinks
        self._choice = choice
        self._steady_s = steady_s
        self.ground_m = choice.ground_m
        self._occupied: dict[CellKey, Voxels] = {}
        """Occupied voxels by cell; cells without any are left out."""
        self._unpublished: set[CellKey] = set()
        """Changed cells whose publishing has not ended yet."""
        self._whole_due_s = -math.inf
        self._is_whole_new = False
        self._ways: dict[str, _Way] = {}
        self._marks: dict[str, MarkEntry] = {}
        """Marks of the map by key, oldest first."""
        self._marks_sent: set[str] = set()
        self._marks_cursor: str | None = None

    @property
    def is_behind(self) -> bool:
        """True if the link broke while a change was published: `publish_changes` goes on with it."""
        return bool(self._unpublished)

    def publish_changes(self, changed: Collection[CellKey]) -> int:
        """Publish what the change of some cells makes new: first the floor, which robots drive by.

        Returns:
            Number of cells, with those whose publishing a broken link ended before.
        """
        self._unpublished |= set(changed)
        snapshot, frame, now_ns = self._followed.snapshot, self._choice.frame, time.time_ns()
        self._publish_floor(snapshot, now_ns)
        parts = self._occupied_in(snapshot, sorted(self._unpublished))
        self._send(cloud_message("/cairn/changed_points", _joined(parts, snapshot), frame, now_ns))
        self._is_whole_new = True
        self._publish_whole()
        self._publish_hot_spots(now_ns)
        count = len(self._unpublished)
        self._unpublished.clear()
        return count

    def publish_due(self) -> None:
        """Publish the cloud of all occupied voxels and the paths that changed, if the last ones are long enough ago."""
        self._publish_whole()
        for name in self._ways:
            self._publish_path(name)

    def _publish_whole(self) -> None:
        if not self._is_whole_new or self._steady_s() < self._whole_due_s:
            return
        whole = _joined(list(self._occupied.values()), self._followed.snapshot)
        self._send(cloud_message("/cairn/points", whole, self._choice.frame, time.time_ns()))
        self._whole_due_s = self._steady_s() + WHOLE_S
        self._is_whole_new = False

    def publish_octree(self) -> None:
        """Publish occupied and free space as OctoMap's octree, which the server makes.

        Raises:
            BadInputError: kind `bad_box`: the map reaches beyond an octree of 16 levels.
        """
        path = f"/maps/{self._followed.info.name}/main/export?format=bt"
        tree = b"".join(self._api.stream(path, at_most_bytes=TREE_BYTES_MAX))
        edge_m = self._followed.info.geometry.voxel_edge_m
        self._send(octomap_message("/cairn/octomap", tree, edge_m, self._choice.frame, time.time_ns()))

    def publish_marks(self) -> None:
        """Publish the map's marks, if some came or went; none of a server that knows of none."""
        pages = mark_pages(self._api, self._followed.info.name, after=self._marks_cursor)
        try:
            for page in islice(pages, MARK_PAGES_MAX):
                gone = set(page.removed)
                kept = {} if page.from_start else self._marks
                self._marks = {key: entry for key, entry in kept.items() if key.partition(":")[0] not in gone}
                self._marks |= {entry.key: entry for entry in page.marks}
                self._marks_cursor = page.cursor
        except NotFoundError:
            return
        if self._marks.keys() != self._marks_sent:
            self._marks_sent = set(self._marks)
            newest = [entry.mark for entry in self._marks.values()][-MARKS_MAX:]
            self._send(marks_message("/cairn/marks", newest, self._choice.frame, time.time_ns()))

    def publish_robot(self, name: str, status: RobotStatus | None) -> None:
        """Publish where a robot says it is, and its way so far; nothing at a time that no message of ROS 2 can hold."""
        if status is None or status.pose is None or not 0 <= status.pose.time_s <= TIME_S_MAX:
            return
        pose = RobotPose(status.pose.time_s, status.pose.t_map_rig, status.pose.q_map_rig)
        way = self._ways.get(name)
        if way is None:
            if len(self._ways) >= ROBOTS_MAX:
                return
            self._ways[name] = _Way(pose)
        elif way.newest == pose:
            return
        else:
            way.add(pose)
        # Of all robots, so that one who joins later finds them all in the last message.
        newest = {robot: way.newest for robot, way in self._ways.items()}
        self._send(transforms_message("/tf", newest, self._choice.frame, time.time_ns()))
        self._publish_path(name)

    def forget_robot(self, name: str) -> None:
        """Forget a robot that left the map."""
        self._ways.pop(name, None)

    def _publish_path(self, name: str) -> None:
        way = self._ways[name]
        if not way.is_new or self._steady_s() < way.due_s:
            return
        poses = way.poses if way.poses[-1] == way.newest else [*way.poses, way.newest]
        self._send(path_message(path_topic(name), poses, self._choice.frame, time.time_ns()))
        way.due_s = self._steady_s() + PATH_S
        way.is_new = False

    def _publish_floor(self, snapshot: MapSnapshot, now_ns: int) -> None:
        grid = self._floor_of(snapshot)
        if grid is not None and grid.values.size:
            self._send(grid_message("/map", grid, self._choice.frame, now_ns))

    def _floor_of(self, snapshot: MapSnapshot) -> FloorGrid | None:
        """Floor of the storey in use, until another one is `STOREY_RATIO` times as large; None: none is free."""
        band_m = self._choice.band_m
        used = None if self.ground_m is None else snapshot.floor_grid(ground_m=self.ground_m, band_m=band_m)
        if self._choice.ground_m is not None:
            return used
        if used is not None and STOREY_RATIO * used.free_m2 > used.values.size * used.edge_m**2:
            return used  # no storey is larger than all columns: most changes need no search for one
        try:
            ground_m, free_m2 = snapshot.grounds(band_m=band_m)[0]
        except NotFoundError:
            return used
        if used is not None and free_m2 < STOREY_RATIO * used.free_m2:
            return used
        self.ground_m = ground_m
        return snapshot.floor_grid(ground_m=ground_m, band_m=band_m)

    def _occupied_in(self, snapshot: MapSnapshot, keys: Collection[CellKey]) -> list[Voxels]:
        """Occupied voxels of some cells, which are kept for the whole cloud."""
        frozen = snapshot.frozen
        slots = {key: slot for slot, key in enumerate(frozen.keys)}
        found = []
        for key in keys:
            self._occupied.pop(key, None)
            if key not in slots:
                continue
            evidence = frozen.cells[slots[key]].packed()
            voxels = voxels_of_evidence(key, evidence, frozen.geometry, frozen.model, occupied_only=True)
            if len(voxels):
                self._occupied[key] = voxels
                found.append(voxels)
        return found

    def _publish_hot_spots(self, now_ns: int) -> None:
        try:
            found = self._api.hottest(self._followed.info.name, count=HOT_SPOTS).voxels
        except BadInputError as exc:
            if exc.kind != "unknown_channel":
                raise
            return  # a map without temperatures
        spots = [HotSpot(voxel.point_m, voxel.mean) for voxel in found]
        self._send(hot_spots_message("/cairn/hot_spots", spots, self._choice.frame, now_ns))

    def _send(self, message: MapMessage) -> None:
        for sink in self._sinks:
            sink.send(message)


def path_topic(robot: str) -> str:
    """Topic of a robot's way, of no other robot: ROS takes no name with a hyphen, nor one that begins with a digit."""
    # Names have no capitals, so that `_U` is never one's own.
    name = robot.replace("_", "_U").replace("-", "_")
    return f"/cairn/robots/{f'_{name}' if name[0].isdigit() else name}/path"


class _Way:
    """Way of a robot: its newest pose, and poses some steps apart."""

    def __init__(self, pose: RobotPose) -> None:
        self.newest = pose
        self.poses = [pose]
        self.is_new = True
        """True if the way grew since it was published."""
        self.due_s = -math.inf
        """Time from which on it may be published again, of the publisher's clock."""
        self._step_m = STEP_M

    def add(self, pose: RobotPose) -> None:
        """Go on to a pose; one less than a step from the last of the way is the newest alone."""
        self.newest = pose
        if math.dist(self.poses[-1].t_map_rig, pose.t_map_rig) < self._step_m:
            return
        self.poses.append(pose)
        self.is_new = True
        if len(self.poses) > POSES_MAX:
            del self.poses[1::2]
            self._step_m *= 2


def _joined(parts: list[Voxels], snapshot: MapSnapshot) -> Voxels:
    # Of no part there are no channels to read.
    return joined_voxels(parts) if parts else snapshot.occupied_in([[0.0] * 3] * 2)
