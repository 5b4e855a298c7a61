"""Start of the joint solve: poses of cameras and boards, from the board poses that each camera found alone.

    T_gauge_camera = T_gauge_board T_camera_board^-1       once for each frame that both saw

These agree up to noise, except for boards that were mistaken: a small board's tilt may be mirrored, and a board whose
corners were named from the wrong end is turned by half a turn. So each frame votes with all readings of its two poses,
the reading that most frames agree on is taken, and the poses that agree with it are averaged: rotations by the chordal
mean (Hartley et al., Rotation averaging, 2013), translations by the median. Cameras are connected along a maximum
spanning tree, weighted by the corners that two cameras saw in common. Then each frame's board takes the reading that
all its cameras meet best.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.rig.poses import Transform, inverse
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.camera_alone import CameraAlone
from cairn_calib.solve.corner_residuals import CornerData, corner_data, corner_misses
from cairn_calib.solve.rig_state import RigState, warp_shape
from cairn_calib.solve.zhang import mirrored_pose
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

Poses = Mapping[str, Transform]
"""T_camera_board of one camera, by frame."""

AGREE_RAD = 0.2
"""Largest distance between readings of a relative pose that agree: rotation plus translation over the board's range."""
TURNED_RAD = 0.05
"""Radians a frame by which boards must agree better for corners to count as named from the other end."""


@dataclass(frozen=True, slots=True)
class RigStart:
    """Cameras and boards in the gauge's frame, and views whose corners are named from the wrong end."""

    T_rig_camera: Mapping[str, Transform]
    reversed_views: tuple[tuple[str, str], ...]
    """(camera, frame)"""


@dataclass(frozen=True, slots=True)
class _Edge:
    one: str
    other: str
    T_one_other: Transform
    weight: float
    reversed_frames: tuple[str, ...]
    """Frames in which one of both cameras named the corners from the other end."""


def rig_start(
    poses: Mapping[str, Poses], board: Board, gauge: str, weights: Mapping[tuple[str, str], float]
) -> RigStart:
    """The cameras' places from T_camera_board by camera and frame; `weights` by camera and frame, their corners.

    Frames connect all cameras (`BoardViews.refuse_unpaired`).

    Raises:
        BadInputError: all of a camera's corners are named from the wrong end.
    """
    # Readings of each board, as found, then mirrored.
    middle = board.points().mean(axis=0)
    readings = {
        name: {frame: np.stack([T, mirrored_pose(T, middle)]) for frame, T in frames.items()}
        for name, frames in poses.items()
    }
    # An edge for each two cameras that saw boards together.
    edges = []
    names = list(poses)
    for n, one in enumerate(names):
        for other in names[n + 1 :]:
            common = sorted(set(poses[one]) & set(poses[other]))
            if common:
                weight = sum(min(weights[one, frame], weights[other, frame]) for frame in common)
                pairs = [np.stack([readings[name][frame] for frame in common]) for name in (one, other)]
                edges.append(_edge((one, other), common, pairs[0], pairs[1], half_turn(board), weight))
    # Prim's maximum spanning tree from the gauge: of all edges that leave the tree, the heaviest joins it.
    T_rig_camera: dict[str, Transform] = {gauge: np.eye(4)}
    edges_to: dict[str, list[_Edge]] = {name: [] for name in names}
    while len(T_rig_camera) < len(names):
        open_edges = [edge for edge in edges if (edge.one in T_rig_camera) != (edge.other in T_rig_camera)]
        best = max(open_edges, key=lambda edge: edge.weight)
        # The edge may lead either way.
        known, new, T = (best.one, best.other, best.T_one_other)
        if known not in T_rig_camera:
            known, new, T = best.other, best.one, inverse(best.T_one_other)
        T_rig_camera[new] = T_rig_camera[known] @ T
        edges_to[new].append(best)
        _refuse_reversed(new, known, best, len(set(poses[new]) & set(poses[known])))
    return RigStart(
        T_rig_camera,
        tuple((name, frame) for name, found in edges_to.items() for edge in found for frame in edge.reversed_frames),
    )


def first_state(views: BoardViews, alone: Mapping[str, CameraAlone], T_rig_camera: Mapping[str, Transform]) -> RigState:
    """The rig with each frame's board where it is met best in all cameras, of the poses that any of them found.

    Args:
        views: all of the cameras of `alone`.
        alone: each camera by itself, in the rig's order.
        T_rig_camera: from `rig_start`.

    Returns:
        A state with a flat board of the stated pitch, without range bias.
    """
    lenses = tuple(each.lens for each in alone.values())
    cameras = np.stack([T_rig_camera[name] for name in alone])
    blank = RigState(lenses, cameras, np.zeros((len(views.frames), 4, 4)), np.zeros(2), 1.0, np.zeros(0))
    # Readings of each frame's board in the rig's frame: as each camera found it, then mirrored.
    middle = views.board.points().mean(axis=0)
    readings: list[list[Transform]] = [[] for _ in views.frames]
    for name, camera in alone.items():
        for view in views.of_camera(name):
            T = camera.T_camera_board[view.frame]
            readings[views.frames.index(view.frame)] += [
                T_rig_camera[name] @ each for each in (T, mirrored_pose(T, middle))
            ]
    # Each round tries the next reading of every frame at once; a frame that has no more tries its last one again.
    board = (views.board.points(), warp_shape(views.board))
    data = [corner_data(n, views.of_camera(name), views.frames) for n, name in enumerate(alone)]
    best, least = blank, np.full(len(views.frames), np.inf)
    for turn in range(max(map(len, readings))):
        poses = np.stack([each[min(turn, len(each) - 1)] for each in readings])
        misses = _board_misses(data, replace(blank, T_rig_board=poses), board)
        better = misses < least
        best = replace(best, T_rig_board=np.where(better[:, None, None], poses, best.T_rig_board))
        least = np.where(better, misses, least)
    return best


def _board_misses(data: Sequence[CornerData], state: RigState, board: tuple[Floats, Floats]) -> Floats:
    """(F,) sum over all cameras of how far corners miss, in image widths, each at most 1.

    The bound keeps a single camera, whose lens bends far points without limit, from outvoting the others.
    """
    missed = np.zeros(len(state.T_rig_board))
    for each in data:
        width = state.lenses[each.camera].width
        off = np.linalg.norm(corner_misses(each, state, *board), axis=2) / width
        missed[each.frames] += np.minimum(np.nan_to_num(off, nan=1.0), 1.0).sum(axis=1)
    return missed


def chordal_mean(rotations: Floats) -> Floats:
    """(3, 3) rotation nearest to (N, 3, 3) ones: that of their sum."""
    U, _, Vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt)


def half_turn(board: Board) -> Transform:
    """`T_board_board` of a board whose points are named from the other end: half a turn about its middle."""
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    T[:2, 3] = board.points()[:, :2].max(axis=0)
    return T


def _edge(
    names: tuple[str, str], frames: Sequence[str], one: Floats, other: Floats, turn: Transform, weight: float
) -> _Edge:
    """Relative pose that most of F frames agree on, of (F, 2, 4, 4) readings of each camera."""
    ways = np.stack([np.eye(4), turn])
    # (F, way, reading of one, reading of the other): as they are stand before turned and mirrored.
    T = one[:, None, :, None] @ ways[:, None, None] @ np.linalg.inv(other)[:, None, None]
    count = len(frames)
    T = T.reshape(count * 8, 4, 4)
    distance = float(np.median(np.linalg.norm(np.concatenate([one[:, 0], other[:, 0]])[:, :3, 3], axis=1)))
    # (F * 8, F, 8): distance of each reading from all eight of every frame.
    apart = _pose_distances(T, distance).reshape(len(T), count, 8)
    # A board tilted about one spot fits mirrored and named from the other end as well: as it is, unless that is clear.
    doubts = np.minimum(apart.min(axis=2), AGREE_RAD).sum(axis=1) + TURNED_RAD * count * (np.arange(len(T)) % 8 >= 4)
    # The reading with the least doubt, then the mean of each frame's reading nearest to it, if that agrees.
    best = int(np.argmin(doubts.round(6)))
    nearest = apart[best].argmin(axis=1)
    agrees = apart[best].min(axis=1) < AGREE_RAD
    chosen = T[np.flatnonzero(agrees) * 8 + nearest[agrees]]
    mean = np.eye(4)
    mean[:3, :3], mean[:3, 3] = chordal_mean(chosen[:, :3, :3]), np.median(chosen[:, :3, 3], axis=0)
    # Readings 4 to 7 are those with half a turn.
    reversed_frames = tuple(frame for n, frame in enumerate(frames) if agrees[n] and nearest[n] >= 4)
    return _Edge(*names, mean, weight * max(float(agrees.mean()), 0.01), reversed_frames)


def _pose_distances(T: Floats, distance_m: float) -> Floats:
    """(N, N) rotation between each two transforms, radians, plus translation over a distance."""
    R, t = T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]
    cosine = (R @ R.T - 1) / 2
    shift = np.sqrt(np.sum((t[:, None] - t[None]) ** 2, axis=2))
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)) + shift / distance_m)


def _refuse_reversed(new: str, known: str, edge: _Edge, common: int) -> None:
    if 2 * len(edge.reversed_frames) > common:
        raise BadInputError(
            "reversed_order",
            f"{new} and {known} name the board's corners from opposite ends in {len(edge.reversed_frames)} of {common} "
            "frames: find the corners of one of them again with the other --polarity (a thermal camera that sees "
            "printed dark bright is reversed)",
        )
