"""Influence of each frame on a solution: the move of everything without it, and the gain of one more.

    (S - S_f) da = -a_f          S: the reduced normal equations of all; S_f, a_f: the frame's share of them

One Newton step from the solution, without solving again. The same shares of frames that are not taken yet show by how
much they would sharpen the rig (`next_image.py`).
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.probe_points import Probes
from cairn_calib.solve.normal_equations import frame_shares, solve_scaled
from cairn_calib.solve.solution import Solution


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
        # Where all is held nothing moves, and nothing is uncertain.
        strongest = max(
            float((move / np.maximum(sigma, 1e-12)).max()) for move, sigma in zip(moves, sigmas, strict=True)
        )
        result.append(Influence(frame, float(moves[most].max()), probes[most].camera, strongest))
    return sorted(result, key=lambda each: -each.sigmas)
