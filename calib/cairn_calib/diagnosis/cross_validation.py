"""Cross-validation: two solves, each of half of the frames, and their difference against the predicted one.

Where noise is all that is wrong, parameters differ by their joint covariance, and probe points by about their predicted
sigma. Where the model is wrong (a lens that Brown's model does not fit, a board that moved, images taken one after the
other), they differ by more. Small sigmas alone never show that.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cairn_calib.diagnosis.probe_points import Probes
from cairn_calib.rig.pose_vectors import vector_from_transform
from cairn_calib.solve.corner_residuals import CornerData
from cairn_calib.solve.rig_state import shared_values
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_from
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

FRAMES_MIN = 3
"""Frames of each camera in each half, at least."""


@dataclass(frozen=True, slots=True)
class CameraHalves:
    """Difference of one camera's probe points between the halves."""

    camera: str
    difference_px: float
    """Root mean square, one axis."""
    predicted_px: float
    """Root mean square that both covariances predict, one axis."""

    @property
    def ratio(self) -> float:
        """Measured over predicted."""
        return self.difference_px / max(self.predicted_px, 1e-12)


@dataclass(frozen=True, slots=True)
class Halves:
    """Comparison of the two halves."""

    cameras: tuple[CameraHalves, ...]
    chi2: float
    """chi2 of all parameters' differences, by their covariances; about `parameters` if the model is right."""
    parameters: int


def cross_validate(solution: Solution, probes: Sequence[Probes]) -> Halves | None:
    """Comparison of every second frame with the others; None where a half does not determine the rig."""
    frames = solution.views.frames
    try:
        one, other = (_half(solution, frames[start::2]) for start in (0, 1))
    except BadInputError:
        return None
    # Both halves are independent: their difference has the sum of their covariances.
    rows = _camera_parameters(solution)
    step = (_step(solution, one) - _step(solution, other))[rows]
    covariance = (one.covariance + other.covariance)[np.ix_(rows, rows)]
    cameras = []
    for each in probes:
        G = each.rows[..., rows]
        moved = G @ step
        predicted = np.einsum("rip,pq,riq->r", G, covariance, G, optimize=True) / 2
        cameras.append(CameraHalves(each.camera, float(np.sqrt(np.mean(moved**2))), float(np.sqrt(predicted.mean()))))
    return Halves(tuple(cameras), float(step @ np.linalg.solve(covariance, step)), len(rows))


def _half(solution: Solution, frames: Sequence[str]) -> Solution:
    views = solution.views.of_frames(frames)
    for camera in views.cameras:
        if len(views.of_camera(camera)) < FRAMES_MIN:
            raise BadInputError("not_observable", f"{camera} has too few frames for two halves")
    # From the whole solution's state and noise, with its shapes of the range bias: all have the same parameters.
    every = solution.views.frames
    rows = [every.index(frame) for frame in views.frames]
    state = replace(solution.state, T_rig_board=solution.state.T_rig_board[rows])
    scales = {
        solution.views.cameras[sensor.data.camera]: sensor.scale
        for sensor in solution.adjustment.problem.sensors
        if isinstance(sensor.data, CornerData)
    }
    terms = None if solution.ranges is None else solution.ranges.terms
    # Known numbers count as in the whole: enlarged where the images contradict them.
    known = solution.adjustment.problem.known
    return solve_from(views, replace(solution.plan, range_terms=terms, known=known), state, scales)


def _camera_parameters(solution: Solution) -> npt.NDArray[np.intp]:
    """Positions of the cameras' parameters: warp and scale are not compared, nor nodes, many of which no board met."""
    names = solution.layout.names
    cameras = solution.plan.cameras
    return np.array([n for n, (o, name) in enumerate(names) if o in cameras and not name.startswith("node")], np.intp)


def _step(solution: Solution, half: Solution) -> Floats:
    """(P,) from the solution to a half's: differences of parameters, errors of poses."""
    step = shared_values(half.state, half.layout) - shared_values(solution.state, solution.layout)
    for n, at in enumerate(solution.layout.pose_at):
        if len(at):
            T, T_half = solution.state.T_rig_camera[n], half.state.T_rig_camera[n]
            turn = np.eye(4)
            turn[:3, :3] = T_half[:3, :3] @ T[:3, :3].T
            step[at] = np.concatenate([vector_from_transform(turn)[:3], T_half[:3, 3] - T[:3, 3]])
    return step
