"""Frames of a live robot: the poses of the last minute on each edge of its tree.

add        poses as they come: late, out of order, twice; a clock set back begins the edge again
tree       the tree that a bag would have around a time, for the same arithmetic as a replay's
hold       edges that carry the cameras: one of them that moves is an error, as the rig would be wrong
"""

from array import array
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from cairn_fusion.recording.pose_rounding import PoseRounding
from cairn_fusion.ros.messages import RosTransform
from cairn_fusion.ros.tf_tree import FrameTree
from cairn_map.errors import BadInputError

WINDOW_S = 60.0
EDGES_MAX = 1000
EDGE_POSES_MAX = 20_000
"""Poses of one edge within the window: some 300 Hz."""
POSES_MAX = 400_000
"""Poses of all edges: those of 60 joints at 100 Hz, some 200 MB. Beyond it every edge keeps its newest ones, half as
many in all."""


@dataclass(slots=True)
class LiveEdge:
    """Poses of one frame on its parent, in order of time, each time once: of equal ones the first."""

    parent: str
    is_static: bool = False
    times_s: list[float] = field(default_factory=list)
    poses: list[RosTransform] = field(default_factory=list)

    def add(self, found: RosTransform, window_s: float) -> None:
        """Add a pose, and forget those that are too old."""
        if self.times_s and found.time_s < self.times_s[-1] - window_s:
            self.times_s, self.poses = [], []  # the clock was set back: what was is of another time
        at = bisect_left(self.times_s, found.time_s)
        if at < len(self.times_s) and self.times_s[at] == found.time_s:
            return
        self.times_s.insert(at, found.time_s)
        self.poses.insert(at, found)
        old = max(bisect_left(self.times_s, self.times_s[-1] - window_s), len(self.times_s) - EDGE_POSES_MAX)
        self._forget(old)

    def keep_newest(self, count: int) -> None:
        """Forget all poses but so many."""
        self._forget(len(self.times_s) - count)

    def _forget(self, count: int) -> None:
        """Forget the oldest poses."""
        if count > 0:
            del self.times_s[:count], self.poses[:count]

    def between(self, first_s: float, last_s: float) -> list[RosTransform]:
        """Poses of a span of time, with the one before it and the one after it."""
        start = max(0, bisect_left(self.times_s, first_s) - 1)
        return self.poses[start : bisect_left(self.times_s, last_s) + 1]


class LiveFrames:
    """Edges of a live robot, by the child's name."""

    def __init__(self, source: str, *, window_s: float = WINDOW_S, poses_max: int = POSES_MAX) -> None:
        """Args: source: name of the robot in errors."""
        self.source = source
        self.rounding = PoseRounding()
        self.edges: dict[str, LiveEdge] = {}
        self.poses = 0
        """Poses of all edges."""
        self._window_s = window_s
        self._poses_max = poses_max
        self._held: dict[str, array[float]] = {}

    def add(self, found: RosTransform, *, is_static: bool) -> None:
        """Add a pose of one edge.

        Raises:
            BadInputError: it is no pose, the frame hangs on another one already, there are too many frames, or, kind
                `frames_moved`, the edge carries cameras.
        """
        name = f"{self.source}: {found.parent} -> {found.child} at {found.time_s:.3f} s"
        if not np.isfinite(found.pose).all():
            raise BadInputError("bad_transform", f"{name} is no pose: {found.pose.tolist()}")
        self.rounding.check_quaternion(found.pose[3:], name=name)
        held = self._held.get(found.child)
        if held is not None and not np.array_equal(held, found.pose):
            raise BadInputError(
                "frames_moved",
                f"{self.source}: {found.child} moves on {found.parent}, though it carries a camera; name the frame "
                "that carries the cameras as frames.base in the topics file",
            )
        edge = self.edges.get(found.child)
        if edge is None:
            if len(self.edges) >= EDGES_MAX:
                raise BadInputError("too_many_poses", f"{self.source} has more than {EDGES_MAX} frames")
            edge = self.edges[found.child] = LiveEdge(found.parent)
        if edge.parent != found.parent:
            raise BadInputError(
                "bad_frames",
                f"{self.source}: frame {found.child} hangs on {edge.parent} and, at {found.time_s:.3f} s, on "
                f"{found.parent}; only one of them may be published",
            )
        before = len(edge.poses)
        if is_static:
            edge.is_static, edge.times_s, edge.poses = True, [found.time_s], [found]
        elif not edge.is_static:
            edge.add(found, self._window_s)
        self.poses += len(edge.poses) - before
        if self.poses > self._poses_max:
            share = max(1, self._poses_max // 2 // len(self.edges))
            for one in self.edges.values():
                one.keep_newest(share)
            self.poses = sum(len(one.poses) for one in self.edges.values())

    def hold(self, children: Iterable[str], tree: FrameTree) -> None:
        """Refuse other poses of these edges than a tree has, from here on."""
        self._held = {child: tree.edges[child].poses[1:8] for child in children if child in tree.edges}

    def tree(self, first_s: float, last_s: float) -> FrameTree:
        """The frames around a span of time, as a bag has them."""
        tree = FrameTree(self.source)
        for edge in self.edges.values():
            for found in edge.poses if edge.is_static else edge.between(first_s, last_s):
                tree.add(found, is_static=edge.is_static)
        return tree
