"""Examination of a solution before it is trusted: all figures and warnings of the report and the command."""

from dataclasses import dataclass

from cairn_calib.diagnosis.cross_validation import Halves, cross_validate
from cairn_calib.diagnosis.frame_influence import Influence, influences
from cairn_calib.diagnosis.next_image import NextImage, next_images
from cairn_calib.diagnosis.probe_points import Probes, probes_of
from cairn_calib.diagnosis.range_warnings import range_warnings
from cairn_calib.diagnosis.solve_warnings import SolveWarning, refuse_undetermined, warnings_of
from cairn_calib.diagnosis.view_statistics import Coverage, coverage
from cairn_calib.diagnosis.weak_modes import WeakMode, weak_modes
from cairn_calib.rig.rig import Rig
from cairn_calib.solve.solution import Solution


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


def examine(solution: Solution, rig: Rig) -> Examination:
    """The examination of a solution and its rig.

    Raises:
        BadInputError: a focal length is not determined.
    """
    refuse_undetermined(solution)
    probes = probes_of(rig, solution.plan.gauge, solution.layout)
    covered = [coverage(solution, name) for name in solution.plan.cameras]
    moved = influences(solution, probes)
    halves = cross_validate(solution, probes)
    modes = weak_modes(solution, probes)
    return Examination(
        solution,
        rig,
        tuple(probes),
        tuple(covered),
        tuple(moved),
        halves,
        tuple(modes),
        tuple(next_images(solution, probes)),
        (*warnings_of(solution, covered, moved, halves, modes), *range_warnings(solution)),
    )
