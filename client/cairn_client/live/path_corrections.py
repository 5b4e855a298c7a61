"""Corrections of a live robot's past measurements by the path that its SLAM optimised, and jumps that lack one.

    T_odom_rig      continuous, as odometry is: T_map_odom^-1 @ T_map_rig, both as tf had them at the scan
    path            T_map_rig at the times of its own poses; with T_odom_rig there it gives the corrected T_map_odom
    T_map_rig  =    T_map_odom, interpolated between the path's poses, @ T_odom_rig

So the poses of a path may be metres apart, and tf may have jumped between two scans. A measurement is moved if the path
reaches its last scan and moves one scan by more than half a voxel. Each move is one amend (`Robot.amend`): the robot's
map is then the one that the corrected poses would have given from the start. A new path counts at most every 10 s.
"""

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import Transform, inverse, quaternion_from_transform
from cairn_client.robot.robot import Robot
from cairn_fusion.ros.messages import RosPath
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError, UnreachableError

log = logging.getLogger(__name__)

EVERY_S = 10.0
"""Shortest time between two paths that count."""
AMEND_S = 1.0
"""Longest time between two amends of a robot whose scans wait for their turn."""
REACH_M = 3.0
"""Distance at which a turn counts as a way."""
GAP_S = 3.0
"""Longest time between two scans between which the odometry is interpolated: at rest one comes every 2 s."""
SCANS_MAX = 200_000
"""Scans whose poses are remembered, some 50 MB; beyond them the oldest measurements stay where they are."""
QUATERNION_ERROR_MAX = 1e-3
SLERP_MIN_RAD = 1e-6
NOTE = "poses corrected"
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TimedPoses:
    """Poses in order of their times."""

    times_s: Floats
    """(N,)"""
    t: Floats
    """(N, 3), metres"""
    q: Floats
    """(N, 4) unit quaternions, x y z w."""

    @classmethod
    def of_transforms(cls, times_s: npt.ArrayLike, transforms: npt.ArrayLike) -> Self:
        """Poses from N times and (N, 4, 4) matrices."""
        T = np.asarray(transforms, np.float64).reshape(-1, 4, 4)
        q = np.array([quaternion_from_transform(one) for one in T]).reshape(-1, 4)
        return cls(np.asarray(times_s, np.float64), T[:, :3, 3], q)

    def at(self, times_s: Floats) -> Self:
        """Poses at times between the first and the last, by a straight line and slerp; outside them the nearest."""
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, max(1, len(self.times_s) - 1))
        before, after = after - 1, np.minimum(after, len(self.times_s) - 1)
        span_s = self.times_s[after] - self.times_s[before]
        share = np.clip((times_s - self.times_s[before]) / np.where(span_s > 0, span_s, 1.0), 0.0, 1.0)[:, None]
        t = (1 - share) * self.t[before] + share * self.t[after]
        return type(self)(times_s, t, _slerp(self.q[before], self.q[after], share))

    def gaps_s(self, times_s: Floats) -> Floats:
        """Time between the two neighbours of each time; 0 at the time of a pose, infinite outside all."""
        after = np.searchsorted(self.times_s, times_s)
        is_inside = (after > 0) & (after < len(self.times_s))
        is_same = self.times_s[np.minimum(after, len(self.times_s) - 1)] == times_s
        between = np.minimum(np.maximum(after, 1), len(self.times_s) - 1)
        span_s = self.times_s[between] - self.times_s[np.maximum(between - 1, 0)]
        return np.where(is_same, 0.0, np.where(is_inside, span_s, np.inf))

    def transforms(self) -> Floats:
        """Matrices, (N, 4, 4)."""
        x, y, z, w = self.q.T
        T = np.zeros((len(self.q), 4, 4))
        T[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1)
        T[:, 1, :3] = np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)
        T[:, 2, :3] = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
        T[:, :3, 3], T[:, 3, 3] = self.t, 1.0
        return T


@dataclass(slots=True)
class _Measured:
    """One measurement of this run."""

    commit: CommitId
    times_s: Floats
    T_map_rig: Floats
    """(N, 4, 4) where its scans are in the map now."""
    T_odom_rig: Floats


@dataclass(slots=True)
class JumpWatch:
    """Watch over the pose of odometry's frame in the map: what was mapped before a jump stays where it was."""

    step_m: float
    """Way of the robot at a jump from which on it counts."""
    count: int = 0
    largest_m: float = 0.0
    last_s: float = -np.inf
    """Stamp of the newest scan after a jump."""
    _T_map_odom: Transform | None = None

    def note(self, time_s: float, T_map_rig: Transform, T_map_odom: Transform) -> None:
        """Note both poses at a scan."""
        if self._T_map_odom is None:
            self._T_map_odom = T_map_odom
        if np.array_equal(T_map_odom, self._T_map_odom):
            return
        T_old_rig = self._T_map_odom @ inverse(T_map_odom) @ T_map_rig
        step_m = float(_steps_m(T_old_rig[None], T_map_rig[None])[0])
        if step_m > self.step_m:
            self.count, self.last_s, self._T_map_odom = self.count + 1, time_s, T_map_odom
            self.largest_m = max(self.largest_m, step_m)


class PathCorrections:
    """Corrections of one live robot's measurements, by the thread that maps."""

    def __init__(self, robot: Robot, *, topic: str, frame: str, T_path_rig: Transform) -> None:
        """Args: topic: of the path; frame: the map's; T_path_rig: pose of the rig on the body of the path's poses."""
        self.amended = 0
        """Measurements that were moved, each as often as it was."""
        self.lost = 0
        """Measurements that could not be moved, as their scans are not kept any more."""
        self.refusal = ""
        """Reason for which the newest path, or amend, does not count; empty: there is none."""
        self.newest_s = -np.inf
        """Time of the path's last pose."""
        self._robot = robot
        self._topic = topic
        self._frame = frame
        self._T_path_rig = T_path_rig
        self._step_m = robot.replica.geometry.voxel_edge_m / 2
        self._open: list[tuple[float, Transform, Transform]] = []
        self._measured: deque[_Measured] = deque()
        self._scans = 0
        self._path: TimedPoses | None = None
        self._is_new = False
        """True if the path, or a commit, came since the moves were planned."""
        self._moves: deque[tuple[_Measured, Floats]] = deque()
        self._plan_due_s = self._amend_due_s = -np.inf

    @property
    def waiting(self) -> int:
        """Measurements that are still to be moved."""
        return len(self._moves)

    def note_scan(self, time_s: float, T_map_rig: Transform, T_map_odom: Transform) -> None:
        """Note a scan of the open measurement."""
        self._open.append((time_s, T_map_rig, inverse(T_map_odom) @ T_map_rig))

    def note_commit(self, commit: CommitId | None) -> None:
        """Note that the scans so far became a commit; None: that they became none."""
        if commit is not None and self._open:
            times_s, T_map_rig, T_odom_rig = zip(*self._open, strict=True)
            measured = _Measured(commit, np.array(times_s), np.array(T_map_rig), np.array(T_odom_rig))
            self._measured.append(measured)
            self._scans += len(times_s)
            self._is_new = True
            while self._scans > SCANS_MAX and len(self._measured) > 1:
                self._scans -= len(self._measured.popleft().times_s)
        self._open = []

    def note_path(self, path: RosPath) -> None:
        """Note the newest path; poses that are none are left out."""
        rows = np.array([(one.time_s, *one.pose) for one in path.poses], np.float64).reshape(-1, 8)
        is_pose = np.isfinite(rows).all(axis=1)
        is_pose &= (
            np.abs(np.linalg.norm(np.where(np.isfinite(rows), rows, 0.0)[:, 4:], axis=1) - 1) < QUATERNION_ERROR_MAX
        )
        frames = {one.parent for one in path.poses} - {self._frame}
        if frames:
            stray = min(frames)
            self.refusal = (
                f"{self._topic} has poses in {stray}, not in {self._frame}: say `map: {stray}` under frames, or name "
                "the topic with poses in it"
            )
            return
        if not is_pose.any():
            return
        rows = rows[is_pose][::-1]  # of equal times the last counts
        times_s, at = np.unique(rows[:, 0], return_index=True)
        q = rows[at, 4:] / np.linalg.norm(rows[at, 4:], axis=1, keepdims=True)
        self._path, self._is_new, self.refusal = TimedPoses(times_s, rows[at, 1:4], q), True, ""
        self.newest_s = float(times_s[-1])

    def is_due(self, now_s: float) -> bool:
        """True if a new path may count now."""
        return not self._moves and now_s >= self._plan_due_s

    def step(self, now_s: float, *, is_idle: bool) -> None:
        """Plan the moves of the newest path, or make one of them.

        Args:
            now_s: steady seconds.
            is_idle: no scan waits for its turn.
        """
        if self._path is not None and self._is_new and self.is_due(now_s):
            self._plan()
            self._plan_due_s = now_s + EVERY_S
        if self._moves and (is_idle or now_s >= self._amend_due_s):
            self._amend(*self._moves.popleft())
            self._amend_due_s = now_s + AMEND_S

    def finish(self, may_go_on: Callable[[], bool]) -> None:
        """Make the moves of the newest path, the last commit's included, as long as there is time."""
        self._moves.clear()
        self._plan()
        while self._moves and may_go_on():
            self._amend(*self._moves.popleft())
        if self._moves:
            log.warning(
                "%d measurements are not where %s has them: `cairn robot amend` moves them",
                len(self._moves),
                self._topic,
            )

    def _plan(self) -> None:
        """Find the measurements that the path moves, oldest first."""
        self._is_new = False
        anchors = self._anchors()
        if anchors is None:
            return
        for measured in self._measured:
            if measured.times_s.max() > anchors.times_s[-1]:
                continue  # the path goes on
            T_map_rig = anchors.at(measured.times_s).transforms() @ measured.T_odom_rig
            if _steps_m(measured.T_map_rig, T_map_rig).max() > self._step_m:
                self._moves.append((measured, T_map_rig))

    def _anchors(self) -> TimedPoses | None:
        """`T_map_odom` at the times of the path's poses at which the odometry is known; None: at none of them."""
        if self._path is None or not self._measured:
            return None
        times_s = np.concatenate([measured.times_s for measured in self._measured])
        times_s, first = np.unique(times_s, return_index=True)
        T_odom_rig = np.concatenate([measured.T_odom_rig for measured in self._measured])[first]
        odometry = TimedPoses.of_transforms(times_s, T_odom_rig)
        is_known = odometry.gaps_s(self._path.times_s) <= GAP_S
        if not is_known.any():
            return None
        at_s = self._path.times_s[is_known]
        T_map_path = TimedPoses(at_s, self._path.t[is_known], self._path.q[is_known]).transforms()
        T_rig_odom = np.array([inverse(T) for T in odometry.at(at_s).transforms()])
        return TimedPoses.of_transforms(at_s, T_map_path @ self._T_path_rig @ T_rig_odom)

    def _amend(self, measured: _Measured, T_map_rig: Floats) -> None:
        try:
            self._robot.amend(measured.commit, T_map_rig, note=NOTE)
        except UnreachableError as exc:  # no room: the next one would find none either
            self.refusal = exc.message
            self._moves.clear()
            self._is_new = True
        except (NotFoundError, ConflictError, BadInputError, DamagedDataError) as exc:
            log.warning("commit %s stays where it is: %s", measured.commit, exc.message)
            self.lost += 1
            self._forget(measured)
        else:
            measured.T_map_rig = T_map_rig
            self.amended += 1

    def _forget(self, measured: _Measured) -> None:
        self._measured = deque(one for one in self._measured if one is not measured)
        self._scans -= len(measured.times_s)


def _slerp(q_start: Floats, q_end: Floats, share: Floats) -> Floats:
    """(N, 4) rotations at a share (N, 1) of the way (Shoemake 1985)."""
    q_end = np.where((q_start * q_end).sum(axis=1, keepdims=True) < 0, -q_end, q_end)
    chord = np.linalg.norm(q_end - q_start, axis=1, keepdims=True)
    angle_rad = 2 * np.arctan2(chord, np.linalg.norm(q_end + q_start, axis=1, keepdims=True))
    sine = np.where(angle_rad < SLERP_MIN_RAD, 1.0, np.sin(angle_rad))
    is_short = angle_rad < SLERP_MIN_RAD
    start = np.where(is_short, 1 - share, np.sin((1 - share) * angle_rad) / sine)
    end = np.where(is_short, share, np.sin(share * angle_rad) / sine)
    q = start * q_start + end * q_end
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def _steps_m(T_before: Floats, T_after: Floats) -> Floats:
    """(N,) way between two poses of each scan, with that of its turn `REACH_M` away."""
    way_m = np.linalg.norm(T_after[:, :3, 3] - T_before[:, :3, 3], axis=1)
    chord = np.linalg.norm(T_after[:, :3, :3] - T_before[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
    return np.asarray(np.maximum(way_m, 2 * np.arcsin(np.minimum(1.0, chord)) * REACH_M))
