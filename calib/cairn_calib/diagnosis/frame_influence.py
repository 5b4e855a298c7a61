"""Influence of each frame on a solution: the move of everything without it, and the gain of one more.

    (S - S_f) da = -a_f          S: the reduced normal equations of all; S_f, a_f: the frame's share of them

One Newton step from the solution, without solving again. The same shares of frames that are not taken yet show by how
much they would sharpen the rig (`next_image.py`).
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.probe_points import Probes
from cairn_calib.solve.normal_equations import Block, solve_scaled
from cairn_calib.solve.solution import Solution
from cairn_map.arrays import Floats


@dataclass(frozen=True, slots=True)
class Influence:
    """Influence of one frame."""

    frame: str
    moves_px: float
    """Largest move of any camera's probe points without the frame."""
    camera: str
    """Camera of that point."""
    sigmas: float
    """The most moved point in its own standard deviations, of any camera."""


def frame_shares(blocks: list[Block], size: int, frame_count: int, *, floor: float = 0.0) -> tuple[Floats, Floats]:
    """(F, P, P) and (F, P): each frame's part of the reduced normal equations, its board eliminated.

    `floor` is added to the diagonal of each board's own block, so that a board that no camera sees has no effect.
    """
    A, a = np.zeros((frame_count, size, size)), np.zeros((frame_count, size))
    B, C, b = np.zeros((frame_count, size, 6)), np.zeros((frame_count, 6, 6)), np.zeros((frame_count, 6))
    for block in blocks:
        k = len(block.at)
        A[np.ix_(block.frames, block.at, block.at)] += block.square[:, :k, :k]
        a[np.ix_(block.frames, block.at)] += block.pull[:, :k]
        B[np.ix_(block.frames, block.at)] += block.square[:, :k, k:]
        C[block.frames] += block.square[:, k:, k:]
        b[block.frames] += block.pull[:, k:]
    # Schur complement of each board's own block, as in `normal_equations.py`, but frame by frame.
    solved = np.linalg.solve(C + floor * np.eye(6), np.concatenate([np.swapaxes(B, 1, 2), b[..., None]], axis=2))
    return A - B @ solved[..., :-1], a - (B @ solved[..., -1:])[..., 0]


def influences(solution: Solution, probes: list[Probes]) -> list[Influence]:
    """Influence of every frame, the strongest first; infinite for frames without which nothing is determined."""
    done = solution.adjustment
    S, _, _, _ = done.normal.reduce()
    shares, pulls = frame_shares(done.blocks, solution.layout.size, len(solution.views.frames))
    sigmas = [each.sigmas_px(solution.covariance) for each in probes]
    result = []
    for frame, share, pull in zip(solution.views.frames, shares, pulls, strict=True):
        try:
            # One Newton step of what is left without the frame, whose gradient is minus the frame's.
            step = solve_scaled(S - share, -pull)
        except np.linalg.LinAlgError:
            result.append(Influence(frame, np.inf, probes[0].camera, np.inf))
            continue
        moves = [np.linalg.norm(each.rows @ step, axis=1) for each in probes]
        most = max(range(len(probes)), key=lambda n: float(moves[n].max()))
        strongest = max(float((move / sigma).max()) for move, sigma in zip(moves, sigmas, strict=True))
        result.append(Influence(frame, float(moves[most].max()), probes[most].camera, strongest))
    return sorted(result, key=lambda each: -each.sigmas)
