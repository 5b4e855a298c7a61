"""Warnings about numbers that the images do not determine, each with its threshold and measured value.

Residuals do not show this: two published solutions of one time-of-flight camera, both with 0.04 px, have focal
lengths of 250 and 179 px. Warnings leave the solution unchanged; a focal length that is not determined at all is
refused (`refuse_undetermined`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.cross_validation import Halves
from cairn_calib.diagnosis.frame_influence import Influence
from cairn_calib.diagnosis.view_statistics import Coverage
from cairn_calib.diagnosis.weak_modes import WeakMode
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.corner_residuals import CornerData
from cairn_calib.solve.priors import FEW_VIEWS
from cairn_calib.solve.rig_state import SCALE
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve_plan import SHARED
from cairn_map.errors import BadInputError

TILT_DEG = 30.0
"""Largest angle between two boards, degrees, at least."""
RANGE_RATIO = 1.3
"""Farthest board's distance over the nearest one's, at least."""
RADIUS_SHARE = 0.8
"""Outermost corner's distance from the image's middle, share of the half diagonal, at least."""
CELL_SHARE = 0.5
"""Share of the parts of the image with corners, at least."""
PRIOR_SHARE = 0.7
"""Sigma of a parameter over that of its prior, above which the prior decided it."""
NOISE_SCALE = 3.0
"""Estimated noise of corners over the stated one, at most."""
NOISE_PX = 0.1
"""Noise of corners, pixels, that is no error of a model: simulated images of exact boards have 0.05 px."""
OUTLIER_SHARE, IMAGE_OUTLIER_SHARE = 0.05, 0.2
"""Share of outliers among the corners of a camera, and of a single image, at most."""
HALVES_RATIO, HALVES_CHI2_SIGMAS = 3.0, 5.0
"""Difference of the halves: measured over predicted pixels, and standard deviations of chi2 a parameter, at most."""
INFLUENCE_SIGMAS = 3.0
"""Move of a probe point without one frame, in its standard deviations, at most."""
MODE_PX = 1.0
"""Standard deviation of the weakest mode at the probe points, pixels, at most."""
FOCAL_SHARE_MAX = 0.2
"""Relative standard deviation of a focal length above which it is not determined."""


@dataclass(frozen=True, slots=True)
class SolveWarning:
    """One number that the images do not determine, or on which they contradict each other."""

    kind: str
    camera: str
    """Camera that it is about; empty for the whole rig."""
    measured: float
    threshold: float
    unit: str
    text: str
    """Meaning and advice."""

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        where = f"{self.camera}: " if self.camera else ""
        return f"{where}{self.text} [{self.kind}: {self.measured:.3g}{unit}, threshold {self.threshold:g}{unit}]"


def refuse_undetermined(solution: Solution) -> None:
    """Check that every camera's focal length is determined.

    Raises:
        BadInputError: one is not.
    """
    values, sigmas = solution.values(), solution.sigmas()
    for name in solution.plan.cameras:
        share = max(sigmas[name, axis] / abs(values[name, axis]) for axis in ("fx", "fy"))
        if not share < FOCAL_SHARE_MAX:
            raise BadInputError(
                "not_observable",
                f"the images leave the focal length of {name} open: {values[name, 'fx']:.0f} px, give or take "
                f"{share:.0%} ({FOCAL_SHARE_MAX:.0%} is the most): tilt the board by 20 to 40 degrees, to all sides",
            )


def warnings_of(
    solution: Solution,
    covered: Sequence[Coverage],
    influences: Sequence[Influence],
    halves: Halves | None,
    modes: Sequence[WeakMode],
) -> list[SolveWarning]:
    """All warnings but those about ranges, cameras first."""
    found = [each for camera in covered for each in _of_coverage(camera, solution)]
    found += [*_of_priors(solution), *_of_coefficients(solution), *_of_noise(solution)]
    found += [*_of_discs(solution), *(each for mode in modes for each in _of_mode(mode))]
    found += [*_of_reversed(solution), *_of_influence(influences), *_of_halves(halves)]
    return found


def _of_coverage(seen: Coverage, solution: Solution) -> Iterator[SolveWarning]:
    name = seen.camera
    if seen.images < FEW_VIEWS:
        text = f"{seen.images} images: principal point and lens are held near what is usual; take ten or more"
        yield SolveWarning("few_images", name, seen.images, FEW_VIEWS, "", text)
    if seen.tilt_deg < TILT_DEG:
        text = "the boards are nearly parallel: focal length and distance are hard to tell apart; tilt to all sides"
        yield SolveWarning("tilt_range", name, seen.tilt_deg, TILT_DEG, "degrees", text)
    ratio = seen.farthest_m / seen.nearest_m
    if ratio < RANGE_RATIO:
        text = f"all boards are {seen.nearest_m:.2f} to {seen.farthest_m:.2f} m away: take some nearer and farther"
        yield SolveWarning("range_span", name, ratio, RANGE_RATIO, "", text)
    edge = "tof_edge" if solution.plan.cameras[name].spectrum is Spectrum.RANGE else "edge"
    if seen.radius_share < RADIUS_SHARE:
        text = "no corner lies near the image's corners, where the lens bends most: what is there is extrapolated"
        yield SolveWarning(edge, name, seen.radius_share, RADIUS_SHARE, "of the half diagonal", text)
    if seen.cell_share < CELL_SHARE:
        text = "the boards covered little of the image: move them through all of it"
        yield SolveWarning("coverage", name, seen.cell_share, CELL_SHARE, "of the parts of its image", text)


def _of_priors(solution: Solution) -> Iterator[SolveWarning]:
    sigmas = solution.sigmas()
    ruled: dict[str, list[tuple[float, str]]] = {}
    for prior in solution.adjustment.problem.priors:
        if len(prior.terms) != 1:
            continue
        owner, name, _ = prior.terms[0]
        after = sigmas.get((owner, name))
        # Many nodes of the pixels meet no board: their map shows that.
        if after is None or (owner, name) == (SHARED, SCALE) or name.startswith("node"):
            continue
        if after / prior.sigma > PRIOR_SHARE:
            ruled.setdefault(owner, []).append((after / prior.sigma, f"{name} ({prior.value:g} +- {prior.sigma:g})"))
    for owner, each in ruled.items():
        are = "is" if len(each) == 1 else "are"
        text = f"{', '.join(told for _, told in each)} {are} what was assumed before, not what was measured"
        yield SolveWarning("prior", owner, max(each)[0], PRIOR_SHARE, "of the assumed sigma is left", text)


def _of_coefficients(solution: Solution) -> Iterator[SolveWarning]:
    values, sigmas = solution.values(), solution.sigmas()
    assumed = {prior.terms[0][:2] for prior in solution.adjustment.problem.priors}
    for name, camera in solution.plan.cameras.items():
        # A good lens has a tangential part of 0; `_of_priors` warns about assumed coefficients.
        radial = [each for each in camera.coefficients if each.startswith("k") and (name, each) not in assumed]
        lost = {each: sigmas[name, each] / max(abs(values[name, each]), 1e-12) for each in radial}
        unknown = [each for each, share in lost.items() if share > 1]
        if unknown:
            told = ", ".join(f"{each} = {values[name, each]:.2g} +- {sigmas[name, each]:.2g}" for each in unknown)
            text = f"{told}: no different from 0; corners further out would tell, or hold it at 0 (--distortion)"
            yield SolveWarning("distortion", name, max(lost[each] for each in unknown), 1.0, "sigma over value", text)


def _of_noise(solution: Solution) -> Iterator[SolveWarning]:
    for sensor in solution.adjustment.problem.sensors:
        if not isinstance(sensor.data, CornerData):
            continue
        name = solution.views.cameras[sensor.data.camera]
        if sensor.scale > NOISE_SCALE and sensor.scale * sensor.data.sigma_px > NOISE_PX:
            text = "corners miss by far more than they may: a lens model that does not fit, a bent board, motion"
            yield SolveWarning("noise", name, sensor.scale, NOISE_SCALE, "times the stated noise", text)
        lost = (sensor.there & ~sensor.kept).sum(axis=1) / np.maximum(sensor.there.sum(axis=1), 1)
        share = 1 - sensor.kept.sum() / max(sensor.there.sum(), 1)
        if share > OUTLIER_SHARE:
            text = "many corners are outliers and were left out"
            yield SolveWarning("outliers", name, float(share), OUTLIER_SHARE, "of its corners", text)
        for n in np.flatnonzero(lost > IMAGE_OUTLIER_SHARE):
            image = solution.views.of_camera(name)[n].image
            text = f"{image} does not fit the others: look at its corners"
            yield SolveWarning(
                "image_outliers", name, float(lost[n]), IMAGE_OUTLIER_SHARE, "of its corners left out", text
            )


def _of_discs(solution: Solution) -> Iterator[SolveWarning]:
    board = solution.views.board
    if board.pattern != "chessboard" and board.disc_m is None:
        text = (
            "the diameter of the discs is unknown: a tilted disc's image has its centroid off its centre, which "
            "biases the focal length; find the discs again and say it (cairn calib corners --disc)"
        )
        yield SolveWarning("disc_diameter", "", 0, 1, "known diameters", text)


def _of_mode(mode: WeakMode) -> Iterator[SolveWarning]:
    if mode.sigma_px > MODE_PX:
        text = f"{mode.words} are open together: {mode.advice}"
        yield SolveWarning("weak_mode", mode.camera, mode.sigma_px, MODE_PX, "px where the gauge's pixels appear", text)


def _of_reversed(solution: Solution) -> Iterator[SolveWarning]:
    for name, frame in solution.reversed_views:
        text = f"frame {frame} names the corners from the other end and was left out: look at its polarity"
        yield SolveWarning("reversed_order", name, 1, 0, "images", text)


def _of_influence(influences: Sequence[Influence]) -> Iterator[SolveWarning]:
    for each in influences:
        if each.sigmas > INFLUENCE_SIGMAS:
            text = (
                f"without frame {each.frame} everything is open"
                if not np.isfinite(each.moves_px)
                else f"without frame {each.frame} points would move by {each.moves_px:.2f} px: much hangs on it alone"
            )
            yield SolveWarning("influence", each.camera, each.sigmas, INFLUENCE_SIGMAS, "sigma", text)


def _of_halves(halves: Halves | None) -> Iterator[SolveWarning]:
    if halves is None:
        text = "too few images for two halves to be compared: nothing shows whether the model is right"
        yield SolveWarning("halves", "", 0, 2, "halves", text)
        return
    for each in halves.cameras:
        if each.ratio > HALVES_RATIO:
            text = (
                f"two halves of the images differ by {each.difference_px:.2f} px where {each.predicted_px:.2f} px were "
                "expected: model error (lens model, moved board, images not of one moment)"
            )
            yield SolveWarning("model_error", each.camera, each.ratio, HALVES_RATIO, "times the expected", text)
    threshold = 1 + HALVES_CHI2_SIGMAS * float(np.sqrt(2 / halves.parameters))
    share = halves.chi2 / halves.parameters
    if share > threshold:
        text = (
            "two halves of the images differ by far more than their covariances allow: model error (lens model, moved "
            "board or camera, images not of one moment)"
        )
        yield SolveWarning("model_error", "", share, threshold, "chi2 a parameter", text)
