"""Usual priors: knowledge of cameras, boards and range sensors before any measurement, added only where needed.

A prior that the data overrule does no harm; one that decides is named in the report (`solve_warnings.py`).
"""

from collections.abc import Mapping

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.range_terms import RangeTerms
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.rig_state import SCALE, WARP
from cairn_calib.solve.solve_plan import SHARED, CameraPlan, Prior, SolvePlan

FEW_VIEWS = 4
"""Views below which more is assumed: each gives two equations for fx, fy, cx and cy, none are left for distortion."""
CENTRE_SIGMA = 0.03
"""Standard deviation of the principal point from the image's middle, as lenses are mounted; share of the width."""
ASPECT_SIGMA = 0.01
"""Standard deviation of fx / fy from 1."""
USUAL_SIGMAS = {"p1": 0.002, "p2": 0.002, "k3": 0.1}
"""Standard deviations of every pinhole's coefficients from 0: lenses are centred within some hundredths of a
millimetre, and bend little more than k1 and k2 describe. Images that reach the corners overrule them; others must not
invent them."""
FEW_SIGMAS = {"k1": 0.5, "k2": 0.5, "k3": 0.5, "k4": 0.5, "p1": 0.01, "p2": 0.01}
"""Standard deviations of the coefficients from 0 with few views, unless others apply."""
RANGE_K2_SIGMA = 0.3
"""Standard deviation of k2 from 0 for range cameras, whose coarse images show little of it."""
RATIONAL = {"k4", "k5", "k6"}
"""Coefficients of the rational model: with a denominator k3 is no small correction, and has no prior."""
WARP_SIGMA = 0.005
"""Standard deviation of the warp, share of the board's longer side: 4 mm on 0.8 m."""


def usual_priors(
    plan: SolvePlan,
    lenses: Mapping[str, Lens],
    view_counts: Mapping[str, int],
    board: Board,
    *,
    ranges: tuple[str, RangeTerms] | None,
) -> tuple[Prior, ...]:
    """The priors of a plan; `ranges` names the camera whose range bias is estimated, and its shapes."""
    priors: list[Prior] = []
    if plan.usual_priors:
        for name, camera in plan.cameras.items():
            # With few views all coefficients and the principal point are held near usual values, and fx near fy.
            usual = _usual_sigmas(camera)
            if view_counts[name] < FEW_VIEWS:
                priors += _few_view_priors(name, lenses[name], camera)
                usual = {each: usual.get(each, FEW_SIGMAS.get(each)) for each in camera.coefficients}
            # What is known of this very camera counts instead of what is usual.
            priors += [
                single_prior(name, each, 0.0, sigma)
                for each, sigma in usual.items()
                if sigma is not None and each not in camera.known
            ]
        if plan.warp:
            # The board: warp near 0, pitch near the stated one.
            side = float(np.ptp(board.points(), axis=0).max())
            priors += [single_prior(SHARED, axis, 0.0, WARP_SIGMA * side) for axis in WARP]
    if plan.pitch_sigma > 0:
        priors.append(single_prior(SHARED, SCALE, 1.0, plan.pitch_sigma))
    if ranges is not None:
        # The range bias: each shape near 0.
        owner, terms = ranges
        priors += [single_prior(owner, name, 0.0, sigma) for name, sigma in zip(terms.names, terms.sigmas, strict=True)]
    return tuple(priors)


def single_prior(owner: str, name: str, value: float, sigma: float) -> Prior:
    """A prior of a single number."""
    return Prior(((owner, name, 1.0),), value, sigma)


def _usual_sigmas(camera: CameraPlan) -> dict[str, float | None]:
    """Standard deviations of a lens's free coefficients from 0, as far as they are usual."""
    free = camera.coefficients
    if camera.model != "pinhole":
        return {}
    left_out = {"k3"} if RATIONAL & {*free} else set()
    known: dict[str, float | None] = {
        name: sigma for name, sigma in USUAL_SIGMAS.items() if name in free and name not in left_out
    }
    return known | ({"k2": RANGE_K2_SIGMA} if camera.spectrum is Spectrum.RANGE and "k2" in free else {})


def _few_view_priors(name: str, lens: Lens, camera: CameraPlan) -> list[Prior]:
    middle = {"cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    sigma = CENTRE_SIGMA * lens.width
    priors = [single_prior(name, each, value, sigma) for each, value in middle.items() if each not in camera.known]
    if not {"fx", "fy"} & set(camera.known):
        priors.append(Prior(((name, "fx", 1.0), (name, "fy", -1.0)), 0.0, ASPECT_SIGMA * lens.focal_px[0]))
    return priors
