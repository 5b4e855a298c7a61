"""Fit of numbers that were known before to what the images say, and what becomes of those that contradict them.

A number x0 +- C that is part of the solve is off its estimate x by r = x - x0. If both it and the images hold, r has
the covariance C - C_x, with C_x that of the estimate: the more certain the images, the further they may pull it. Where
r is more than 3 sigma, the statement does not hold for this camera as it is (refocused, knocked, another
resolution, another unit of the same make). Its standard deviations are then enlarged until its residuals are as large
as they say (variance components, Foerstner 1979, as the noise of corners), so that the images decide, and the
estimate's covariance holds. `solve_warnings.py` reports it.
"""

from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.solve.adjustment import WARM, Adjustment, descend
from cairn_calib.solve.normal_equations import uncertainty
from cairn_calib.solve.rig_state import known_by_step, known_values
from cairn_calib.solve.solve_plan import KnownNumbers
from cairn_map.arrays import Floats

CONTRADICTS_SIGMAS = 3.0
"""Standard deviations between a number and the images from which on it is not believed."""
OPEN_SHARE = 1e-4
"""Share of its variance by which the images must sharpen a number at the least, to say anything about it."""
ROUNDS = 30
SETTLED = 1.01
"""Factor of standard deviations below which they have settled."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownFit:
    """Numbers known of one camera, and their distance from what the images say."""

    known: KnownNumbers
    """As it was stated."""
    values: Floats
    """(K,) as the images and the statement together say."""
    sigmas_off: Floats
    """(K,) standard deviations between each number and the images."""
    together: float
    """Standard deviations by which all numbers together are off: a normal number as unlikely as their chi2."""
    scale: float
    """Factor by which their standard deviations were enlarged."""

    def __str__(self) -> str:
        enlarged = f", its standard deviations enlarged {self.scale:.1f} times" if self.scale > 1 else ""
        names = ", ".join(self.known.names)
        return f"{names} of {self.known.camera} ({self.known.source}), {max(self.sigmas, 0):.1f} sigma off{enlarged}"

    @property
    def sigmas(self) -> float:
        """Standard deviations by which the statement is off."""
        return max(self.together, float(self.sigmas_off.max()) if len(self.sigmas_off) == 1 else 0.0)

    @property
    def contradicts(self) -> bool:
        """True if the images say that the statement is wrong."""
        return self.sigmas > CONTRADICTS_SIGMAS


def fit_known(done: Adjustment) -> tuple[Adjustment, tuple[KnownFit, ...]]:
    """The adjustment with known numbers enlarged as far as the images contradict them, and the fit of each.

    Raises:
        numpy.linalg.LinAlgError: something is not determined.
    """
    wrong = [n for n, known in enumerate(done.problem.known) if known.scale > 1 or _fit(done, known).contradicts]
    for _ in range(ROUNDS if wrong else 0):
        # All that contradict at once; then the minimum with what they are worth.
        factors = {n: _factor(done, done.problem.known[n]) for n in wrong}
        if max(factors.values()) < SETTLED:
            break
        known = tuple(
            replace(each, scale=each.scale * factors.get(n, 1.0)) for n, each in enumerate(done.problem.known)
        )
        done = descend(replace(done.problem, known=known), done.state, damping=WARM)
    return done, tuple(_fit(done, known) for known in done.problem.known)


def _fit(done: Adjustment, known: KnownNumbers) -> KnownFit:
    """Fit of a statement; of one that was enlarged, with the images' own estimate, in which it hardly counts."""
    off, enlarged, after = _residual(done, known)
    before = known.covariance
    covariance = enlarged - after if known.scale == 1 else before + after
    return KnownFit(replace(known, scale=1.0), known.values + off, *normalised(off, covariance, before), known.scale)


def normalised(off: Floats, covariance: Floats, scale: Floats) -> tuple[Floats, float]:
    """(K,) numbers in their standard deviations, and all together as a normal number that is as unlikely.

    Args:
        off: (K,)
        covariance: (K, K), maybe 0 along some directions, of which nothing is said then.
        scale: (K, K) covariance that is not, to compare with.
    """
    # In units in which `scale` is the identity, directions of hardly any variance show.
    root = np.linalg.cholesky(scale)
    half = np.linalg.solve(root, covariance)
    strengths, axes = np.linalg.eigh(np.linalg.solve(root, half.T))
    shown = strengths > OPEN_SHARE
    if not shown.any():
        return np.zeros(len(off)), 0.0
    chi2 = float(np.sum((axes.T @ np.linalg.solve(root, off))[shown] ** 2 / strengths[shown]))
    # Wilson and Hilferty 1931: the cube root of chi2 is nearly normal.
    count = int(shown.sum())
    together = ((chi2 / count) ** (1 / 3) - 1 + 2 / (9 * count)) / float(np.sqrt(2 / (9 * count)))
    variances, least = np.diag(covariance), OPEN_SHARE * np.diag(scale)
    return np.where(variances > least, np.abs(off) / np.sqrt(np.maximum(variances, least)), 0.0), together


def _factor(done: Adjustment, known: KnownNumbers) -> float:
    """Factor, 1 at the least, of standard deviations whose residuals are as large as they say."""
    off, before, after = _residual(done, known)
    # Sum of squares over redundancy: r^T C^-1 r / (K - trace(C^-1 C_x)).
    sigmas = np.sqrt(np.diag(before))
    weights = np.linalg.pinv(before / sigmas[:, None] / sigmas, hermitian=True)
    whole = float((off / sigmas) @ weights @ (off / sigmas))
    redundancy = len(off) - float(np.sum(weights * (after / sigmas[:, None] / sigmas)))
    return max(1.0, float(np.sqrt(whole / max(redundancy, OPEN_SHARE))))


def _residual(done: Adjustment, known: KnownNumbers) -> tuple[Floats, Floats, Floats]:
    """(K,) estimate minus statement, (K, K) covariance as enlarged so far, and that of the estimate."""
    layout = done.problem.layout
    rows = [layout.names.index((known.camera, name)) for name in known.names]
    values = known_values(done.state, layout)[rows]
    by_step = known_by_step(done.state, layout)[rows]
    covariance = by_step @ uncertainty(done.normal).shared @ by_step.T
    return values - known.values, known.scale**2 * known.covariance, covariance
