"""What is known of cameras, boards and range sensors before anything is measured, and said only where it is needed.

A prior that the data overrule does no harm; one that rules is told in the report (`solve_warnings.py`).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cairn_calib.board import Board
from cairn_calib.lens import Lens
from cairn_calib.range_bias import BIAS_NAMES, BIAS_SIGMAS
from cairn_calib.rig import Spectrum
from cairn_calib.rig_state import SCALE, WARP
from cairn_calib.solve_plan import SHARED, Prior, SolvePlan

FEW_VIEWS = 4
"""Each view says two things about fx, fy, cx and cy; with fewer than four the lens's bend has no say."""
CENTRE_SIGMA = 0.03
"""Of the image's width: how far from its middle makers put the axis."""
ASPECT_SIGMA = 0.01
"""Of fx / fy from 1."""
COEFFICIENT_SIGMAS = {"k1": 0.5, "k2": 0.5, "k3": 0.5, "k4": 0.5, "p1": 0.01, "p2": 0.01}
RANGE_K2_SIGMA = 0.3
WARP_SIGMA = 0.005
"""Of the board's longer side: 4 mm on 0.8 m."""


def usual_priors(
    plan: SolvePlan, lenses: Mapping[str, Lens], view_counts: Mapping[str, int], board: Board, *, ranges: str | None
) -> tuple[Prior, ...]:
    """The priors of a plan; `ranges` names the camera whose range bias is estimated."""
    priors: list[Prior] = []
    if plan.usual_priors:
        for name, camera in plan.cameras.items():
            if view_counts[name] < FEW_VIEWS:
                priors += _of_few_views(name, lenses[name], camera.coefficients)
            elif camera.spectrum is Spectrum.RANGE and camera.model == "pinhole" and "k2" in camera.coefficients:
                priors.append(one(name, "k2", 0.0, RANGE_K2_SIGMA))
        if plan.warp:
            side = float(np.ptp(board.points(), axis=0).max())
            priors += [one(SHARED, axis, 0.0, WARP_SIGMA * side) for axis in WARP]
    if plan.pitch_sigma > 0:
        priors.append(one(SHARED, SCALE, 1.0, plan.pitch_sigma))
    if ranges is not None:
        priors += [one(ranges, name, 0.0, sigma) for name, sigma in zip(BIAS_NAMES, BIAS_SIGMAS, strict=True)]
    return (*priors, *plan.priors)


def one(owner: str, name: str, value: float, sigma: float) -> Prior:
    """A prior of a single number."""
    return Prior(((owner, name, 1.0),), value, sigma)


def _of_few_views(name: str, lens: Lens, coefficients: Sequence[str]) -> list[Prior]:
    cx, cy = (lens.width - 1) / 2, (lens.height - 1) / 2
    sigma = CENTRE_SIGMA * lens.width
    aspect = Prior(((name, "fx", 1.0), (name, "fy", -1.0)), 0.0, ASPECT_SIGMA * lens.focal_px[0])
    priors = [one(name, "cx", cx, sigma), one(name, "cy", cy, sigma), aspect]
    return priors + [
        one(name, each, 0.0, COEFFICIENT_SIGMAS[each]) for each in coefficients if each in COEFFICIENT_SIGMAS
    ]
