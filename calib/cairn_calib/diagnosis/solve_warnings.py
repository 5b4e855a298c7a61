"""Warnings about numbers that the images do not determine, each with its threshold and measured value.

Residuals do not show this: two published solutions of one time-of-flight camera, both with 0.04 px, have focal
lengths of 250 and 179 px. Warnings leave the solution unchanged, and have a rank (`verdict.py`); a focal length that is
not determined at all, and a rig that hangs on a single frame, are refused (`refuse_undetermined`).
"""

from collections.abc import Iterator, Sequence

import numpy as np

from cairn_calib.diagnosis.cross_validation import Halves
from cairn_calib.diagnosis.frame_influence import Influence
from cairn_calib.diagnosis.held_numbers import HeldFit
from cairn_calib.diagnosis.probe_points import Probes
from cairn_calib.diagnosis.verdict import Rank, SolveWarning
from cairn_calib.diagnosis.view_statistics import Coverage
from cairn_calib.diagnosis.weak_modes import WeakMode
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.adjustment import Sensor
from cairn_calib.solve.corner_residuals import CornerData
from cairn_calib.solve.known_fit import CONTRADICTS_SIGMAS
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
CARE_PX, CARE_WIDTH = 0.4, 4e-4
"""Noise of corners, pixels or share of the image's width, from which on the model is in doubt."""
NOISE_MAX_PX, NOISE_MAX_WIDTH = 1.5, 1.5e-3
"""Noise of corners, likewise, with which no calibration is worth anything: corners that miss so far are others."""
OUTLIER_SHARE, IMAGE_OUTLIER_SHARE, OUTLIER_SHARE_MAX = 0.05, 0.2, 0.3
"""Share of outliers among the corners of a camera, of a single image, and with which it is worth nothing."""
SCATTER_CARE, SCATTER_MAX = 3.0, 10.0
"""Factor by which the scatter of frames enlarged standard deviations that is doubtful, and with which nothing holds."""
CERTAIN_WIDTH = 0.01
"""Median standard deviation of the probe points, share of the image's width, above which they are worth nothing."""
HALVES_RATIO, HALVES_CHI2_SIGMAS = 3.0, 5.0
"""Difference of the halves: measured over predicted pixels, and standard deviations of chi2 a parameter, at most."""
INFLUENCE_SIGMAS = 3.0
"""Move of a probe point without one frame, in its standard deviations, at most."""
MODE_PX = 1.0
"""Standard deviation of the weakest mode at the probe points, pixels, at most."""
FOCAL_SHARE_MAX = 0.2
"""Relative standard deviation of a focal length above which it is not determined."""


def refuse_undetermined(solution: Solution, influences: Sequence[Influence]) -> None:
    """Check that every camera's focal length is determined, and that no single frame carries everything.

    Raises:
        BadInputError: one is not, or does.
    """
    values, sigmas = solution.values(), solution.sigmas()
    for name in solution.plan.cameras:
        free = [axis for axis in ("fx", "fy") if (name, axis) in sigmas]
        share = max((sigmas[name, axis] / abs(values[name, axis]) for axis in free), default=0.0)
        if not share < FOCAL_SHARE_MAX:
            # Contradictions enlarge all standard deviations: then they are the cause.
            if wrong := [each for each in (*_of_noise(solution), *_of_scatter(solution)) if each.rank is Rank.DECISIVE]:
                raise BadInputError("not_usable", str(wrong[0]))
            raise BadInputError(
                "not_observable",
                f"the images leave the focal length of {name} open (its standard deviation is {share:.0%} of it, "
                f"{FOCAL_SHARE_MAX:.0%} is the most): tilt the board by 20 to 40 degrees, to all sides, or say what is "
                "known of the lens (--prior, --hold)",
            )
    for each in influences:
        if not np.isfinite(each.sigmas):
            raise BadInputError(
                "not_observable",
                f"without frame {each.frame} nothing determines the rig, so that nothing checks it either: take more "
                "images of boards that the cameras see together",
            )


def warnings_of(
    solution: Solution,
    covered: Sequence[Coverage],
    influences: Sequence[Influence],
    halves: Halves | None,
    modes: Sequence[WeakMode],
    probes: Sequence[Probes],
    held: Sequence[HeldFit],
) -> list[SolveWarning]:
    """All warnings but those about ranges: causes before what follows from them."""
    # What contradicts: statements, views, corners, images, halves.
    found = [*_of_known(solution), *_of_held(held), *_of_reversed(solution), *_of_discs(solution)]
    found += [*_of_noise(solution), *_of_outliers(solution), *_of_scatter(solution), *_of_halves(solution, halves)]
    # What is open.
    found += [*_of_certainty(solution, probes), *(each for mode in modes for each in _of_mode(mode))]
    found += [each for camera in covered for each in _of_coverage(camera, solution)]
    return [*found, *_of_influence(influences), *_of_priors(solution), *_of_coefficients(solution)]


def _of_coverage(seen: Coverage, solution: Solution) -> Iterator[SolveWarning]:
    name, plan = seen.camera, solution.plan.cameras[seen.camera]
    if not any(owner == name and plan.is_free(each) for owner, each in solution.layout.names):
        return  # its lens is held
    if seen.images < FEW_VIEWS:
        text = f"{seen.images} images: what they leave open of the lens is taken for usual; take ten or more"
        yield SolveWarning("few_images", name, seen.images, FEW_VIEWS, "images", text)
    if seen.tilt_deg < TILT_DEG and not {"fx", "fy"} & set(plan.known):
        text = "the boards are nearly parallel: focal length and distance are hard to tell apart; tilt to all sides"
        yield SolveWarning("tilt_range", name, seen.tilt_deg, TILT_DEG, "degrees between boards", text)
    ratio = seen.farthest_m / seen.nearest_m
    if ratio < RANGE_RATIO:
        text = f"all boards are {seen.nearest_m:.2f} to {seen.farthest_m:.2f} m away: take some nearer and farther"
        yield SolveWarning("range_span", name, ratio, RANGE_RATIO, "", text, Rank.NOTE)
    edge = "tof_edge" if plan.spectrum is Spectrum.RANGE else "edge"
    if seen.radius_share < RADIUS_SHARE:
        text = "no corner lies near the image's corners, where the lens bends most: what is there is extrapolated"
        yield SolveWarning(edge, name, seen.radius_share, RADIUS_SHARE, "of the half diagonal", text, Rank.NOTE)
    if seen.cell_share < CELL_SHARE:
        text = "the boards covered little of the image: move them through all of it"
        yield SolveWarning("coverage", name, seen.cell_share, CELL_SHARE, "of the image", text, Rank.NOTE)


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
        share = max(each)[0]
        yield SolveWarning("prior", owner, share, PRIOR_SHARE, "of the assumed sigma is left", text, Rank.NOTE)


def _of_known(solution: Solution) -> Iterator[SolveWarning]:
    for fit in solution.known:
        if fit.contradicts:
            known, n = fit.known, int(np.argmax(fit.sigmas_off))
            name, sigma = known.names[n], float(np.sqrt(known.covariance[n, n]))
            text = (
                f"the images contradict {known.source} by {fit.sigmas:.1f} sigma, most of all its {name} = "
                f"{known.values[n]:.6g} +- {sigma:.2g}, where they say {fit.values[n]:.6g}: its standard deviations "
                f"count {fit.scale:.1f} times as large; is it of this camera, at this focus and resolution?"
            )
            yield SolveWarning("prior_contradicted", known.camera, fit.sigmas, CONTRADICTS_SIGMAS, "sigma", text)


def _of_held(held: Sequence[HeldFit]) -> Iterator[SolveWarning]:
    for fit in held:
        if fit.contradicts:
            n = int(np.argmax(fit.sigmas_off))
            text = (
                f"the images contradict what is held by {fit.together:.1f} sigma: they would change {fit.names[n]} = "
                f"{fit.values[n]:.6g} by {fit.changes[n]:+.2g} ({fit.sigmas_off[n]:.1f} sigma), and everything else "
                "bears what is wrong with it; say --prior instead of --hold, or leave it to the images"
            )
            yield SolveWarning("held_contradicted", fit.camera, fit.together, CONTRADICTS_SIGMAS, "sigma", text)


def _of_coefficients(solution: Solution) -> Iterator[SolveWarning]:
    values, sigmas = solution.values(), solution.sigmas()
    assumed = {prior.terms[0][:2] for prior in solution.adjustment.problem.priors}
    for name, camera in solution.plan.cameras.items():
        # A good lens has a tangential part of 0; `_of_priors` warns about assumed coefficients.
        radial = [
            each
            for each in camera.coefficients
            if each.startswith("k") and (name, each) not in assumed and each not in camera.known
        ]
        lost = {each: sigmas[name, each] / max(abs(values[name, each]), 1e-12) for each in radial}
        unknown = [each for each, share in lost.items() if share > 1]
        if unknown:
            told = ", ".join(f"{each} = {values[name, each]:.2g} +- {sigmas[name, each]:.2g}" for each in unknown)
            text = f"{told}: no different from 0; corners further out would tell, or hold it at 0 (--distortion)"
            worst = max(lost[each] for each in unknown)
            yield SolveWarning("distortion", name, worst, 1.0, "sigma over value", text, Rank.NOTE)


def _of_noise(solution: Solution) -> Iterator[SolveWarning]:
    for sensor, name, sigma_px in _cameras(solution):
        noise_px, width = sensor.scale * sigma_px, solution.views.sizes_px[name][0]
        if sensor.scale <= NOISE_SCALE or noise_px <= NOISE_PX:
            continue
        text = (
            f"corners miss by {noise_px:.2g} px, {sensor.scale:.1f} times as far as the noise of their images explains "
            "(a detector that misplaced them, which its pictures show; a lens model that does not fit, a bent board, "
            "motion): all standard deviations count that"
        )
        rank = Rank.CARE if noise_px > max(CARE_PX, CARE_WIDTH * width) else Rank.NOTE
        most = max(NOISE_MAX_PX, NOISE_MAX_WIDTH * width)
        if noise_px > most:
            text = (
                "corners miss by so much that they cannot be what they were taken for: images not of one moment (look "
                "at the pairing), another board (--board, --square, --disc), a lens of another kind (--fisheye), or "
                "several zooms"
            )
            yield SolveWarning("noise", name, noise_px, most, "px", text, Rank.DECISIVE)
        else:
            yield SolveWarning("noise", name, sensor.scale, NOISE_SCALE, "times the stated noise", text, rank)


def _of_outliers(solution: Solution) -> Iterator[SolveWarning]:
    for sensor, name, _ in _cameras(solution):
        lost = (sensor.there & ~sensor.kept).sum(axis=1) / np.maximum(sensor.there.sum(axis=1), 1)
        share = 1 - float(sensor.kept.sum() / max(sensor.there.sum(), 1))
        if share > OUTLIER_SHARE_MAX:
            text = "so many corners contradict the others that no solution holds for all of them: look at the pictures"
            yield SolveWarning("outliers", name, share, OUTLIER_SHARE_MAX, "of its corners", text, Rank.DECISIVE)
        elif share > OUTLIER_SHARE:
            text = "many corners are outliers and were left out"
            yield SolveWarning("outliers", name, share, OUTLIER_SHARE, "of its corners", text)
        for n in np.flatnonzero(lost > IMAGE_OUTLIER_SHARE):
            image = solution.views.of_camera(name)[n].image
            text = f"{image} does not fit the others: look at its corners"
            worst = float(lost[n])
            yield SolveWarning("image_outliers", name, worst, IMAGE_OUTLIER_SHARE, "of its corners left out", text)


def _cameras(solution: Solution) -> Iterator[tuple[Sensor, str, float]]:
    """Sensors of corners, with the names of their cameras, and their stated noise, pixels."""
    for sensor in solution.adjustment.problem.sensors:
        if isinstance(sensor.data, CornerData):
            yield sensor, solution.views.cameras[sensor.data.camera], sensor.data.sigma_px


def _of_scatter(solution: Solution) -> Iterator[SolveWarning]:
    factor = float(np.sqrt(solution.scatter))
    if factor > SCATTER_MAX:
        text = (
            "images contradict each other far beyond all noise, so that no standard deviation holds: images not of one "
            "moment (look at the pairing), a camera or zoom that moved, another board"
        )
        yield SolveWarning("scatter", "", factor, SCATTER_MAX, "times the noise", text, Rank.DECISIVE)
    elif factor > 1:
        text = (
            "images disagree by more than the noise of their corners explains (a bent or moving board, a lens that the "
            f"model does not fit): all standard deviations were enlarged {factor:.1f} times"
        )
        rank = Rank.CARE if factor > SCATTER_CARE else Rank.NOTE
        yield SolveWarning("scatter", "", factor, 1.0, "times the noise", text, rank)


def _of_discs(solution: Solution) -> Iterator[SolveWarning]:
    board = solution.views.board
    if board.pattern in ("circles", "asymmetric-circles") and board.disc_m is None:
        text = (
            "the diameter of the discs is unknown: a tilted disc's image has its centroid off its centre, which "
            "biases the focal length; find the discs again and say it (cairn calib corners --disc)"
        )
        yield SolveWarning("disc_diameter", "", 0, 1, "known diameters", text)


def _of_mode(mode: WeakMode) -> Iterator[SolveWarning]:
    if mode.sigma_px > MODE_PX:
        text = (
            f"points may be off by {mode.sigma_px:.2g} px (root mean square over the image), for {mode.words} are open "
            f"together: {mode.advice}"
        )
        yield SolveWarning("weak_mode", mode.camera, mode.sigma_px, MODE_PX, "px where the gauge's pixels appear", text)


def _of_certainty(solution: Solution, probes: Sequence[Probes]) -> Iterator[SolveWarning]:
    for each in probes:
        most = CERTAIN_WIDTH * solution.views.sizes_px[each.camera][0]
        sigma = float(np.median(each.sigmas_px(solution.covariance)))
        if sigma > most:
            text = "the images leave open where things appear in it: take the images that the notes ask for"
            yield SolveWarning("uncertain", each.camera, sigma, most, "px, median sigma", text, Rank.DECISIVE)


def _of_reversed(solution: Solution) -> Iterator[SolveWarning]:
    for name, frame in solution.reversed_views:
        text = f"frame {frame} names the corners from the other end and was left out: look at its polarity"
        yield SolveWarning("reversed_order", name, 1, 0, "images", text)


def _of_influence(influences: Sequence[Influence]) -> Iterator[SolveWarning]:
    """One warning about the strongest frame, which names the others."""
    strong = [each for each in influences if each.sigmas > INFLUENCE_SIGMAS]
    if strong:
        first, *others = strong
        more = f" (likewise {', '.join(each.frame for each in others)})" if others else ""
        text = (
            f"without frame {first.frame} points would move by {first.moves_px:.2f} px: much hangs on it alone{more}; "
            "take more images like it"
        )
        yield SolveWarning("influence", first.camera, first.sigmas, INFLUENCE_SIGMAS, "sigma", text)


def _of_halves(solution: Solution, halves: Halves | None) -> Iterator[SolveWarning]:
    if halves is None:
        text = "too few images for two halves to be compared, which would show whether the model is right"
        yield SolveWarning("halves", "", 0, 2, "halves", text, Rank.NOTE)
        return
    # Where standard deviations were enlarged by as much, they hold, and `scatter` says so.
    scatter = solution.scatter
    for each in halves.cameras:
        if each.ratio > HALVES_RATIO * np.sqrt(scatter):
            text = (
                f"two halves of the images differ by {each.difference_px:.2f} px where {each.predicted_px:.2f} px were "
                "expected: model error (lens model, moved board, images not of one moment)"
            )
            yield SolveWarning("model_error", each.camera, each.ratio, HALVES_RATIO, "times the expected", text)
    threshold = 1 + HALVES_CHI2_SIGMAS * float(np.sqrt(2 / halves.parameters))
    share = halves.chi2 / halves.parameters
    if share > threshold * scatter:
        text = (
            "two halves of the images differ by far more than the noise of their corners explains: model error (lens "
            "model, moved board or camera, images not of one moment)"
        )
        yield SolveWarning("model_error", "", share, threshold * scatter, "chi2 a parameter", text)
