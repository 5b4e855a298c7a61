"""Solution of a rig: the estimate, the problem that it solves, and its covariance.

The pipeline that makes it is `solve.py`; diagnosis and report read it.
"""

from dataclasses import dataclass

import numpy as np

from cairn_calib.solve.adjustment import Adjustment
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.known_fit import KnownFit
from cairn_calib.solve.normal_equations import Uncertainty
from cairn_calib.solve.pixel_pattern import PixelPattern
from cairn_calib.solve.range_choice import RangeSpans
from cairn_calib.solve.range_residuals import RangeData
from cairn_calib.solve.rig_state import ParameterLayout, RigState, shared_values
from cairn_calib.solve.solve_plan import SolvePlan
from cairn_map.arrays import Floats


@dataclass(frozen=True, slots=True)
class Solution:
    """A rig, every other parameter that was estimated with it, and their covariance."""

    views: BoardViews
    """The views that were used."""
    plan: SolvePlan
    adjustment: Adjustment
    uncertainty: Uncertainty
    reversed_views: tuple[tuple[str, str], ...] = ()
    """(camera, frame) of each view that was left out because its corners were named from the wrong end."""
    spans: RangeSpans | None = None
    """Distances and amplitudes that the range images covered; None without range images."""
    pattern: PixelPattern | None = None
    """Range offset of each pixel of the range camera; None where it was not estimated."""
    scatter: float = 1.0
    """Variance by which frames disagree, over that which the noise of their corners explains; part of `uncertainty`."""
    known: tuple[KnownFit, ...] = ()
    """Fit of each of the plan's known numbers to the images."""

    @property
    def ranges(self) -> RangeData | None:
        """Ranges measured on the boards that were used; None without range images."""
        last = self.adjustment.problem.sensors[-1].data
        return last if isinstance(last, RangeData) else None

    @property
    def layout(self) -> ParameterLayout:
        """Position of each shared parameter in a step and in `covariance`."""
        return self.adjustment.problem.layout

    @property
    def state(self) -> RigState:
        """The estimate: lenses, poses, board and range bias."""
        return self.adjustment.state

    @property
    def covariance(self) -> Floats:
        """(P, P) covariance of the shared parameters, in the order of `layout.names`; board poses eliminated."""
        return self.uncertainty.shared

    def sigmas(self) -> dict[tuple[str, str], float]:
        """Standard deviation of each shared parameter, by owner and name; poses: of the error, rad and m."""
        return dict(zip(self.layout.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def values(self) -> dict[tuple[str, str], float]:
        """Value of each shared parameter, by owner and name; 0 for poses, whose parameters are errors."""
        return dict(zip(self.layout.names, shared_values(self.state, self.layout).tolist(), strict=True))
