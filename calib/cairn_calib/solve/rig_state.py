"""Unknowns of a calibration: a rig and the boards before it, and the small steps by which a solver changes them.

    step = [shared: each camera's free intrinsics and, except the gauge's, r and t; warp; scale; range bias]
           [6 a frame: r and t of the board]

A pose T steps to [exp(r) R | t + dt]: rotation about the axes of the rig, in radians, translation along them, metres.
That is also how `rig.json` states its covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import left_jacobian, rotation_from_vector, vector_from_transform
from cairn_calib.solve.solve_plan import SHARED, SolvePlan
from cairn_map.arrays import Floats

Indices = npt.NDArray[np.intp]

WARP = ("warp_x", "warp_y")
SCALE = "scale"


@dataclass(frozen=True, slots=True)
class RigState:
    """Lenses and poses of C cameras, poses of F boards, the board's shape and the range bias."""

    lenses: tuple[Lens, ...]
    T_rig_camera: Floats
    """(C, 4, 4)"""
    T_rig_board: Floats
    """(F, 4, 4)"""
    warp_m: Floats
    """(2,) metres: z of the board's middle before its edges' along x, and along y."""
    scale: float
    """True pitch over the stated one."""
    bias: Floats
    """(B,) bias of the range camera; empty where none is estimated (range_bias.py)."""


@dataclass(frozen=True, slots=True)
class ParameterLayout:
    """Position of each parameter in the shared part of a step."""

    names: tuple[tuple[str, str], ...]
    """Owner and name of each: a camera, or the board (SHARED)."""
    intrinsic_columns: tuple[Indices, ...]
    """Indices of each camera's free intrinsics among those of its lens."""
    intrinsic_at: tuple[Indices, ...]
    """Positions of these in the step, for each camera."""
    pose_at: tuple[Indices, ...]
    """(6,) positions of each camera's pose; empty for the gauge."""
    warp_at: Indices
    scale_at: Indices
    bias_at: Indices

    @property
    def size(self) -> int:
        """Number of shared parameters."""
        return len(self.names)

    def index(self, owner: str, name: str) -> int | None:
        """Position of a parameter; None if it is held."""
        wanted = (owner, name)
        return self.names.index(wanted) if wanted in self.names else None


def parameter_layout(
    plan: SolvePlan, lenses: Mapping[str, Lens], bias_names: Sequence[tuple[str, str]]
) -> ParameterLayout:
    """Positions of all free parameters; `bias_names` are owner and name of those of the range bias."""
    names: list[tuple[str, str]] = []

    def claim(owner: str, added: Sequence[str]) -> Indices:
        names.extend((owner, name) for name in added)
        return np.arange(len(names) - len(added), len(names))

    # Each camera's free intrinsics and pose, then the board, then the bias: the order of `names`.
    columns, intrinsic_at, pose_at = [], [], []
    for name, camera in plan.cameras.items():
        every = lenses[name].intrinsic_names
        free = [each for each in every if camera.is_free(each)]
        columns.append(np.array([every.index(each) for each in free], np.intp))
        intrinsic_at.append(claim(name, free))
        pose_at.append(claim(name, [] if name == plan.gauge else list(POSE_UNITS)))
    warp_at = claim(SHARED, WARP if plan.warp else ())
    scale_at = claim(SHARED, (SCALE,) if plan.pitch_sigma > 0 else ())
    start = len(names)
    names.extend(bias_names)
    return ParameterLayout(
        tuple(names),
        tuple(columns),
        tuple(intrinsic_at),
        tuple(pose_at),
        warp_at,
        scale_at,
        np.arange(start, len(names)),
    )


def shared_values(state: RigState, layout: ParameterLayout) -> Floats:
    """(P,) values of the shared parameters; 0 for poses, whose parameters are errors."""
    # As in `parameter_layout`: intrinsics, warp, scale, bias.
    values = np.zeros(layout.size)
    for lens, columns, at in zip(state.lenses, layout.intrinsic_columns, layout.intrinsic_at, strict=True):
        values[at] = lens.intrinsics[columns]
    values[layout.warp_at] = state.warp_m[: len(layout.warp_at)]
    values[layout.scale_at] = state.scale
    values[layout.bias_at] = state.bias
    return values


def known_values(state: RigState, layout: ParameterLayout) -> Floats:
    """`shared_values` with each camera's place in the rig, rotation vector (radians) and metres, for its errors 0."""
    values = shared_values(state, layout)
    for T, at in zip(state.T_rig_camera, layout.pose_at, strict=True):
        if len(at):
            values[at] = vector_from_transform(T)
    return values


def known_by_step(state: RigState, layout: ParameterLayout) -> Floats:
    """(P, P) derivatives of `known_values` by the shared part of a step."""
    derivatives = np.eye(layout.size)
    for T, at in zip(state.T_rig_camera, layout.pose_at, strict=True):
        if len(at):
            # exp(r) R = exp(v + dv) turns by r = J_l(v) dv.
            turn = np.ix_(at[:3], at[:3])
            derivatives[turn] = np.linalg.inv(left_jacobian(vector_from_transform(T)[:3]))
    return derivatives


def step_state(state: RigState, layout: ParameterLayout, shared: Floats, boards: Floats) -> RigState:
    """The state after a step: (P,) shared and (F, 6) of the boards."""
    # Values step by addition, poses by rotation and translation; the gauge has no pose in the step.
    lenses, poses = [], state.T_rig_camera.copy()
    for n, lens in enumerate(state.lenses):
        intrinsics = lens.intrinsics
        intrinsics[layout.intrinsic_columns[n]] += shared[layout.intrinsic_at[n]]
        lenses.append(lens.with_intrinsics(intrinsics))
        if len(layout.pose_at[n]):
            poses[n] = step_poses(poses[n], shared[layout.pose_at[n]])
    warp, bias = state.warp_m.copy(), state.bias + shared[layout.bias_at]
    warp[: len(layout.warp_at)] += shared[layout.warp_at]
    return replace(
        state,
        lenses=tuple(lenses),
        T_rig_camera=poses,
        T_rig_board=step_poses(state.T_rig_board, boards),
        warp_m=warp,
        scale=state.scale + float(shared[layout.scale_at].sum()),
        bias=bias,
    )


def step_poses(T: Floats, step: Floats) -> Floats:
    """(..., 4, 4) transforms after (..., 6) steps: [exp(r) R | t + dt]."""
    # About the axes of the rig, the frame that is mapped to: multiplied from the left.
    result = T.copy()
    result[..., :3, :3] = rotation_from_vector(step[..., :3]) @ T[..., :3, :3]
    result[..., :3, 3] += step[..., 3:]
    return result


def warp_shape(board: Board) -> Floats:
    """(N, 2) z of each point of a board with `warp_m` (1, 0), and (0, 1): parabolas, 1 in the middle, 0 at the edges.

    The two numbers are mrcal's, with x and y from -1 at the first point to 1 at the last.
    """
    return warp_at_places(board, board.points()[:, :2])


def warp_at_places(board: Board, places_m: Floats) -> Floats:
    """(..., 2) `warp_shape` at (..., 2) places of the board's plane, metres."""
    # From -1 at the first point to 1 at the last, along either axis.
    last = board.points()[:, :2].max(axis=0)
    return np.asarray(1 - (2 * places_m / last - 1) ** 2)
