"""Held numbers that the images contradict: by how much each would change if the solve were free to.

A camera that is held takes no part in the estimate of itself; that it is another lens, or refocused, shows in its
residuals alone, where it looks like noise. One Newton step with its numbers free tells, without solving again.
"""

from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.solve.known_fit import CONTRADICTS_SIGMAS, normalised
from cairn_calib.solve.normal_equations import uncertainty
from cairn_calib.solve.rig_state import parameter_layout
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve_plan import FOCAL_AND_CENTRE, CameraPlan, KnownNumbers
from cairn_map.arrays import Floats

OPEN_SHARE = 0.2
"""Standard deviation of what a held focal length or principal point may be, share of the image's width: wide open."""
OPEN_COEFFICIENT = 1.0
"""And of a held coefficient."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldFit:
    """Held numbers of one camera, and by how much the images would change them."""

    camera: str
    names: tuple[str, ...]
    values: Floats
    """(K,) as they are held."""
    changes: Floats
    """(K,)"""
    sigmas_off: Floats
    """(K,) changes in their standard deviations."""
    together: float
    """All of them: a normal number as unlikely."""

    @property
    def contradicts(self) -> bool:
        """True if the images say that the held numbers are wrong."""
        return self.together > CONTRADICTS_SIGMAS


def held_fits(solution: Solution) -> list[HeldFit]:
    """Fit of the held numbers of every camera that has some."""
    return [_fit(solution, name) for name, camera in solution.plan.cameras.items() if camera.held]


def _fit(solution: Solution, name: str) -> HeldFit:
    camera, problem, state = solution.plan.cameras[name], solution.adjustment.problem, solution.state
    at = list(solution.plan.cameras).index(name)
    lens = state.lenses[at]
    stated = dict(zip(lens.intrinsic_names, lens.intrinsics.tolist(), strict=True))
    names = tuple(each for each in camera.held if each in stated)
    # The same problem with these numbers free, but for a prior so wide that it only keeps the equations solvable.
    plan = replace(solution.plan, cameras={**solution.plan.cameras, name: _freed(camera)})
    lenses = dict(zip(solution.plan.cameras, state.lenses, strict=True))
    bias = [solution.layout.names[n] for n in solution.layout.bias_at]
    sigmas = np.array([OPEN_SHARE * lens.width if each in FOCAL_AND_CENTRE else OPEN_COEFFICIENT for each in names])
    values = np.array([stated[each] for each in names])
    wide = KnownNumbers(name, "", names, values, np.diag(sigmas**2))
    freed = replace(problem, layout=parameter_layout(plan, lenses, bias), known=(*problem.known, wide))
    normal = freed.normal(state, freed.blocks(state))
    step, _, _ = normal.step(0.0)
    rows = [freed.layout.names.index((name, each)) for each in names]
    covariance = uncertainty(normal).shared[np.ix_(rows, rows)]
    return HeldFit(name, names, values, step[rows], *normalised(step[rows], covariance, covariance))


def _freed(camera: CameraPlan) -> CameraPlan:
    coefficients = tuple(name for name in camera.held if name not in FOCAL_AND_CENTRE)
    return replace(camera, held=(), free=(*camera.coefficients, *coefficients))
