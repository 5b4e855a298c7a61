"""Weak modes: the combination of parameters in which a camera is least certain, in words.

    covariance = L L^T,  mode = L v       v: the direction in which the camera's probe points move most

Not the parameter with the largest sigma: many change together and leave every pixel where it is. A mode is named by the
parameters that go with it: those whose correlation with it is strong.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.probe_points import Probes
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve_plan import SHARED

STRONG = 0.5
"""Correlation with a mode, at least, of the parameters that name it."""
NAMED_MAX = 5
ADVICE = (
    (
        {"fx", "fy", "tz"},
        "a longer lens looks like a farther board: tilt the board more, take it nearer and farther",
    ),
    ({"cx", "ry"}, "a shifted image looks like a turned camera: tilt the board about the vertical, use both halves"),
    ({"cy", "rx"}, "a shifted image looks like a nodding camera: tilt the board about the horizontal, use both halves"),
    ({"k1", "k2", "k3"}, "the lens's bend shows at the image's edge: move the board out to its corners"),
    ({"tx", "ty"}, "the camera's place follows from near boards: take some as near as both cameras see them"),
)


@dataclass(frozen=True, slots=True)
class WeakMode:
    """Weakest mode of one camera."""

    camera: str
    sigma_px: float
    """Move of the camera's probe points by one standard deviation of it: root mean square, one axis."""
    share: float
    """Share in the variance of the probe points."""
    parameters: tuple[tuple[str, str, float], ...]
    """Camera, name and correlation with the mode, the strongest first."""

    @property
    def words(self) -> str:
        """`fx, fy of left and cx of tof`."""
        owners = dict.fromkeys(owner for owner, _, _ in self.parameters)
        parts = []
        for owner in owners:
            names = ", ".join(name for each, name, _ in self.parameters if each == owner)
            parts.append(f"{names} of {owner if owner != SHARED else 'the board'}")
        return " and ".join(parts)

    @property
    def advice(self) -> str:
        """Advice on what to shoot, by the parameters that go together most."""
        names = {name for _, name, _ in self.parameters}
        return max(ADVICE, key=lambda each: len(each[0] & names) / len(each[0]))[1]


def weak_modes(solution: Solution, probes: Sequence[Probes]) -> list[WeakMode]:
    """The weakest mode of every camera that has probe points."""
    covariance = solution.covariance
    sigmas = np.sqrt(np.diag(covariance))
    # Scaled to correlations, whose factor is good to rounding.
    values, vectors = np.linalg.eigh(covariance / sigmas[:, None] / sigmas)
    root = sigmas[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    modes = []
    for each in probes:
        if not each.rows.any():
            continue  # all of this camera is held
        # covariance = root root^T; the mode is the direction of largest G root, back in parameters.
        G = each.rows.reshape(-1, len(sigmas)) @ root
        strengths, directions = np.linalg.eigh(G.T @ G / len(G))
        mode = root @ directions[:, -1]
        correlations = mode / sigmas
        order = [n for n in np.argsort(-np.abs(correlations)) if abs(correlations[n]) >= STRONG][:NAMED_MAX]
        order = order or [int(np.argmax(np.abs(correlations)))]
        named = tuple((*solution.layout.names[n], float(correlations[n])) for n in order)
        modes.append(
            WeakMode(each.camera, float(np.sqrt(strengths[-1])), float(strengths[-1] / strengths.sum()), named)
        )
    return modes
