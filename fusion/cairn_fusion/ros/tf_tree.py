"""Tree of frames in a bag: the pose of each frame on its parent over time (tf, tf_static, odometry).

    map -> odom -> base_link -> camera_link -> camera_optical_frame
     moving   moving       fixed          fixed

A chain of edges leads from any frame to any other of one tree. Between two poses of a moving edge a pose is
interpolated as in a trajectory; an edge that never moves counts at all times.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import takewhile

import numpy as np

from cairn_calib.rig.poses import Transform, inverse, transform_from_quaternion
from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.recording.timed_lists import TimedList
from cairn_fusion.recording.trajectory import Trajectory
from cairn_fusion.ros.messages import RosTransform
from cairn_map.errors import BadInputError

EDGES_MAX = 10_000
POSES_MAX = 4_000_000
"""Largest number of poses in one bag, 64 bytes each: 30 moving frames at 50 Hz for three quarters of an hour."""
DEPTH_MAX = 256


@dataclass(slots=True)
class Edge:
    """Pose of one frame on its parent, over time."""

    parent: str
    is_static: bool
    poses: "array[float]" = field(default_factory=lambda: array("d"))
    """Rows of time_s, x, y, z, qx, qy, qz, qw."""
    _trajectory: Trajectory | None = None

    def add(self, found: RosTransform, *, is_static: bool) -> None:
        """Add a pose; a static one replaces all others."""
        if is_static:
            self.poses, self.is_static = array("d"), True
        self.poses.extend((found.time_s, *found.pose.tolist()))

    def trajectory(self, name: str) -> Trajectory:
        """All poses in order of time, each time once."""
        if self._trajectory is None:
            rows = np.array(self.poses, dtype=np.float64).reshape(-1, 8)
            _, first = np.unique(rows[:, 0], return_index=True)
            poses = tuple(transform_from_quaternion(row[1:4], row[4:]) for row in rows[first])
            self._trajectory = Trajectory(name, TimedList(rows[first, 0], poses))
        return self._trajectory

    @property
    def is_fixed(self) -> bool:
        """True if it never moves."""
        rows = np.array(self.poses, dtype=np.float64).reshape(-1, 8)
        return self.is_static or bool((rows[:, 1:] == rows[0, 1:]).all())


@dataclass(slots=True)
class FrameTree:
    """Edges of a bag, by the child's name."""

    source: str
    """Name of the bag in errors."""
    rounding: PoseRounding = field(default_factory=PoseRounding)
    """Poses whose quaternions were not quite of length 1."""
    edges: dict[str, Edge] = field(default_factory=dict)
    _count: int = 0

    def add(self, found: RosTransform, *, is_static: bool) -> None:
        """Add a pose of one edge.

        Raises:
            BadInputError: the frame has another parent already, or there are too many poses or frames.
        """
        name = f"{self.source}: {found.parent} -> {found.child} at {found.time_s:.3f} s"
        if not np.isfinite(found.pose).all():
            raise BadInputError("bad_transform", f"{name} is no pose: {found.pose.tolist()}")
        self.rounding.check_quaternion(found.pose[3:], name=name)
        edge = self.edges.setdefault(found.child, Edge(found.parent, is_static))
        if edge.parent != found.parent:
            raise BadInputError(
                "bad_frames",
                f"{self.source}: frame {found.child} hangs on {edge.parent} and, at {found.time_s:.3f} s, on "
                f"{found.parent}; only one of them may be published",
            )
        self._count += 1
        if self._count > POSES_MAX or len(self.edges) > EDGES_MAX:
            raise BadInputError(
                "too_many_poses",
                f"{self.source} has more than {POSES_MAX} poses or {EDGES_MAX} frames; take the poses from an odometry "
                "topic instead",
            )
        edge.add(found, is_static=is_static)

    def fixed_pose(self, target: str, source: str) -> Transform:
        """`T_target_source` of two frames that are rigid to each other.

        Raises:
            BadInputError: they are not in one tree, or something between them moves.
        """
        up_target, up_source = self._ways(target, source)
        for child in [*up_target, *up_source]:
            if not self.edges[child].is_fixed:
                raise BadInputError(
                    "bad_frames",
                    f"{self.source}: {source} is not fixed on {target}: {child} moves on {self.edges[child].parent}; "
                    "name the frame that carries the cameras as frames.base",
                )
        return inverse(self._product(up_target, None, 0)) @ self._product(up_source, None, 0)

    def pose_at(self, target: str, source: str, time_s: float, *, max_gap_s: float) -> Transform:
        """`T_target_source` at a time.

        Raises:
            BadInputError: not in one tree, or no poses near that time.
        """
        up_target, up_source = self._ways(target, source)
        ends = [self._product(way, time_s, max_gap_s) for way in (up_target, up_source)]
        return inverse(ends[0]) @ ends[1] if up_target else ends[1]

    def span_s(self, target: str, source: str) -> tuple[float, float]:
        """The first and last time at which all moving edges between two frames have poses."""
        times = [self._moving(child) for way in self._ways(target, source) for child in way]
        known = [(float(t[0]), float(t[-1])) for t in times if len(t)]
        return max((first for first, _ in known), default=-np.inf), min((last for _, last in known), default=np.inf)

    def roots(self) -> list[str]:
        """Frames without a parent, in order of their names."""
        return sorted({edge.parent for edge in self.edges.values()} - self.edges.keys())

    def frames(self) -> set[str]:
        """All frames."""
        return self.edges.keys() | {edge.parent for edge in self.edges.values()}

    def way_up(self, frame: str) -> list[str]:
        """A frame and its ancestors, up to the root.

        Raises:
            BadInputError: the frames form a circle.
        """
        way = [frame]
        while way[-1] in self.edges:
            way.append(self.edges[way[-1]].parent)
            if len(way) > DEPTH_MAX:
                raise BadInputError("bad_frames", f"{self.source}: the frames above {frame} hang in a circle")
        return way

    def _ways(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Edges, by their children, from both frames up to their first common ancestor."""
        above_target, above_source = self.way_up(target), self.way_up(source)
        meeting = next((frame for frame in above_source if frame in above_target), None)
        if meeting is None:
            known = ", ".join(sorted(self.frames())[:20]) or "no frames at all"
            raise BadInputError(
                "no_transform",
                f"{self.source}: no transforms lead from {source} to {target}; it knows {known}: name others under "
                "frames, or give T_base_camera",
            )
        up = [list(takewhile(lambda frame: frame != meeting, way)) for way in (above_target, above_source)]
        return up[0], up[1]

    def _product(self, children: list[str], time_s: float | None, max_gap_s: float) -> Transform:
        """`T_meeting_frame` along the edges above a frame."""
        poses = list(self._poses(children, time_s, max_gap_s))
        T = poses[-1] if poses else np.eye(4)
        for nearer in reversed(poses[:-1]):
            T = T @ nearer
        return T

    def _poses(self, children: list[str], time_s: float | None, max_gap_s: float) -> Iterator[Transform]:
        for child in children:
            trajectory = self._trajectory(child)
            if self.edges[child].is_static or time_s is None:
                yield trajectory.poses.values[0]
            else:
                yield trajectory.pose_at(time_s, max_gap_s=max_gap_s)

    def _moving(self, child: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.empty(0) if self.edges[child].is_static else self._trajectory(child).poses.times_s

    def _trajectory(self, child: str) -> Trajectory:
        edge = self.edges[child]
        return edge.trajectory(f"{self.source}: {edge.parent} -> {child}")
