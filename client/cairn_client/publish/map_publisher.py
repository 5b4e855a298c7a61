"""Publisher of a map: its floor, occupied voxels, hot spots and robots, as messages to any number of sinks.

Topics:

/map                        nav_msgs/OccupancyGrid: the storey's floor, after each change
/cairn/points               sensor_msgs/PointCloud2: all occupied voxels, at most every 10 s
/cairn/changed_points       sensor_msgs/PointCloud2: those of the cells that changed
/cairn/hot_spots            visualization_msgs/MarkerArray: the hottest places
/cairn/octomap              octomap_msgs/Octomap: occupied and free space, once, where it is asked for
/tf                         tf2_msgs/TFMessage: where robots are, each the frame of its name
/cairn/robots/NAME/path     nav_msgs/Path: the way of one, since publishing began
"""

import time
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from cairn_client.http.api import MapApi
from cairn_client.publish.followed_map import FollowedMap
from cairn_fusion.ros.map_messages import (
    HotSpot,
    MapMessage,
    RobotPose,
    cloud_message,
    grid_message,
    hot_spots_message,
    octomap_message,
    path_message,
    transforms_message,
)
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import CellKey
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_map.queries.floor_grid import Band
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.wire.messages import RobotStatus

HOT_SPOTS = 10
WHOLE_S = 10.0
"""Shortest time between two clouds of all voxels: they may be megabytes."""
POSES_MAX = 10_000
"""Poses of a path; older ones are dropped."""
ROBOTS_MAX = 1000
TREE_BYTES_MAX = 256 << 20


class Sink(Protocol):
    """Place that messages go to: a file, or a server of viewers."""

    def send(self, message: MapMessage) -> None:
        """Take a message."""
        ...


@dataclass(frozen=True, slots=True)
class FloorChoice:
    """Storey that is published, and the robot that drives on it."""

    ground_m: float | None
    """None: that of the largest storey, once there is one."""
    band_m: Band | None
    frame: str
    """Frame of all messages: the map's."""


class MapPublisher:
    """Publisher of a followed map; not thread-safe."""

    def __init__(self, api: MapApi, followed: FollowedMap, sinks: Sequence[Sink], choice: FloorChoice) -> None:
        self._api = api
        self._followed = followed
        self._sinks = sinks
        self._choice = choice
        self.ground_m = choice.ground_m
        self._occupied: dict[CellKey, Voxels] = {}
        """Occupied voxels by cell; cells without any are left out."""
        self._whole_due_s = 0.0
        self._is_whole_new = False
        self._paths: dict[str, deque[RobotPose]] = {}

    def publish_changes(self, changed: Collection[CellKey]) -> None:
        """Publish what the change of some cells makes new: first the floor, which robots drive by."""
        snapshot, frame, now_ns = self._followed.snapshot, self._choice.frame, time.time_ns()
        self._publish_floor(snapshot, now_ns)
        parts = self._occupied_in(snapshot, changed)
        self._send(cloud_message("/cairn/changed_points", _joined(parts, snapshot), frame, now_ns))
        self._is_whole_new = True
        self.publish_whole()
        self._publish_hot_spots(now_ns)

    def publish_whole(self) -> None:
        """Publish the cloud of all occupied voxels, if it changed and the last one is long enough ago."""
        if not self._is_whole_new or time.monotonic() < self._whole_due_s:
            return
        whole = _joined(list(self._occupied.values()), self._followed.snapshot)
        self._send(cloud_message("/cairn/points", whole, self._choice.frame, time.time_ns()))
        self._whole_due_s = time.monotonic() + WHOLE_S
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

    def publish_robot(self, name: str, status: RobotStatus | None) -> None:
        """Publish where a robot says it is, and its way so far."""
        if status is None or status.pose is None or (name not in self._paths and len(self._paths) >= ROBOTS_MAX):
            return
        pose = RobotPose(status.pose.time_s, status.pose.t_map_rig, status.pose.q_map_rig)
        path = self._paths.setdefault(name, deque(maxlen=POSES_MAX))
        if path and path[-1] == pose:
            return
        path.append(pose)
        now_ns, frame = time.time_ns(), self._choice.frame
        # Of all robots, so that one who joins later finds them all in the last message.
        self._send(transforms_message("/tf", {robot: way[-1] for robot, way in self._paths.items()}, frame, now_ns))
        self._send(path_message(f"/cairn/robots/{name}/path", list(path), frame, now_ns))

    def forget_robot(self, name: str) -> None:
        """Forget a robot that left the map."""
        self._paths.pop(name, None)

    def _publish_floor(self, snapshot: MapSnapshot, now_ns: int) -> None:
        if self.ground_m is None:
            try:
                self.ground_m = snapshot.grounds(band_m=self._choice.band_m)[0][0]
            except NotFoundError:
                return
        grid = snapshot.floor_grid(ground_m=self.ground_m, band_m=self._choice.band_m)
        if grid.values.size:
            self._send(grid_message("/map", grid, self._choice.frame, now_ns))

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


def _joined(parts: list[Voxels], snapshot: MapSnapshot) -> Voxels:
    # Of no part there are no channels to read.
    return joined_voxels(parts) if parts else snapshot.occupied_in([[0.0] * 3] * 2)
