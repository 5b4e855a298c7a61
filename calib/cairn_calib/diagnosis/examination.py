"""Examination of a solution before it is trusted: all figures and warnings of the report and the command."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cairn_calib.diagnosis.cross_validation import Halves, cross_validate
from cairn_calib.diagnosis.frame_influence import Influence, influences
from cairn_calib.diagnosis.held_numbers import held_fits
from cairn_calib.diagnosis.next_image import NextImage, next_images
from cairn_calib.diagnosis.probe_points import Probes, probes_of
from cairn_calib.diagnosis.range_warnings import range_warnings
from cairn_calib.diagnosis.solve_warnings import refuse_undetermined, warnings_of
from cairn_calib.diagnosis.verdict import SolveWarning, Verdict, ranked, verdict_of
from cairn_calib.diagnosis.view_statistics import Coverage, coverage
from cairn_calib.diagnosis.weak_modes import WeakMode, weak_modes
from cairn_calib.rig.rig import Rig
from cairn_calib.solve.solution import Solution
from cairn_map.errors import BadInputError


@dataclass(frozen=True, slots=True)
class Examination:
    """Figures and warnings of one solution."""

    solution: Solution
    rig: Rig
    probes: tuple[Probes, ...]
    coverage: tuple[Coverage, ...]
    influences: tuple[Influence, ...]
    """Influence of each frame, the strongest first."""
    halves: Halves | None
    """Comparison of two halves of the frames; None with too few images."""
    modes: tuple[WeakMode, ...]
    next_images: tuple[NextImage, ...]
    """Images to shoot next, the best first."""
    warnings: tuple[SolveWarning, ...]
    """By rank, the most severe first."""
    verdict: Verdict


def examine(solution: Solution, rig: Rig) -> Examination:
    """The examination of a solution and its rig.

    Raises:
        BadInputError: a lens is not determined, or everything hangs on one frame.
    """
    probes = probes_of(rig, solution.plan.gauge, solution.layout)
    if not probes:
        raise BadInputError(
            "not_usable",
            f"the lens of {solution.plan.gauge} came out as one that sees nothing: a lens of another kind (--fisheye), "
            "corners of another board, or too few images",
        )
    covered = [coverage(solution, name) for name in solution.plan.cameras]
    moved = influences(solution, probes)
    refuse_undetermined(solution, moved)
    halves = cross_validate(solution, probes)
    modes = weak_modes(solution, probes)
    found = warnings_of(solution, covered, moved, halves, modes, probes, held_fits(solution))
    warnings = ranked([*found, *range_warnings(solution)])
    return Examination(
        solution,
        rig,
        tuple(probes),
        tuple(covered),
        tuple(moved),
        halves,
        tuple(modes),
        tuple(next_images(solution, probes)),
        tuple(warnings),
        verdict_of(warnings, _certainty(solution, probes)),
    )


def _certainty(solution: Solution, probes: Sequence[Probes]) -> str:
    """Certainty of pixels, in words: of the camera that is least certain for its size."""
    gauge = solution.plan.gauge
    sigmas = {each.camera: float(np.median(each.sigmas_px(solution.covariance))) for each in probes}
    others = [name for name in sigmas if name != gauge] or list(sigmas)
    if not others:
        return f"no camera sees what {gauge} sees at 1, 2 or 5 m"
    worst = max(others, key=lambda name: sigmas[name] / solution.views.sizes_px[name][0])
    if worst == gauge:
        return f"a pixel of {gauge} is known to {sigmas[worst]:.2g} px (sigma, median over its image)"
    least = "" if len(others) == 1 else ", the least certain camera"
    return f"where a pixel of {gauge} appears in {worst}{least} is known to {sigmas[worst]:.2g} px (sigma, median)"
