"""Joint least squares: Levenberg and Marquardt's damping, robust loss, outliers, and the noise of each sensor.

    1. Huber's loss (k = 1.5 sigma), noise from the median         -> close, whatever is wrong with some corners
    2. least squares over points within 4 sigma; noise of each sensor by its share of the redundancy (variance
       components, Foerstner 1979); points that fit again are let in again; until nothing changes

Residuals are whitened by their corners' covariances, and by one scale for each sensor: pixels of a time-of-flight and a
colour camera cannot be compared otherwise.
"""

from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.solve.corner_residuals import CornerData, corner_block
from cairn_calib.solve.normal_equations import Block, Loss, NormalEquations, Uncertainty, sum_blocks, uncertainty
from cairn_calib.solve.range_residuals import RangeData, range_block
from cairn_calib.solve.rig_state import ParameterLayout, RigState, known_by_step, known_values, step_state, warp_shape
from cairn_calib.solve.solve_plan import KnownNumbers, NoisePlan, Prior
from cairn_map.arrays import Flags, Floats

STEPS_MAX = 100
"""Steps of one descent, at most."""
DAMPING, DAMPING_MIN, DAMPING_MAX = 1e-4, 1e-12, 1e10
"""Marquardt's damping at the start, and its bounds: shares of the normal equations' diagonal."""
WARM = 1e-8
"""Damping near a minimum, where more would only slow down weakly determined parameters."""
ROUNDING = 1e-12
"""Relative rise of the cost that counts as rounding, not as a rise."""
SETTLED = 1e-10
"""Expected fall of the cost, in squared sigmas, below which a step is not worth it: 1e-5 sigma."""
COARSE = 1e-2
"""Expected fall of the cost that ends a descent while outliers and noise are still open: a tenth of a sigma."""
SCALE_SETTLED = 1e-3
"""Relative change of a sensor's noise below which its estimate has settled."""
NOISE_MIN_PX, NOISE_MIN_M = 1e-4, 1e-6
"""Noise of corners and ranges, pixels and metres, at least: a hundredth of what the best detectors reach."""
MEDIAN_SQUARE = {1: 0.4549, 2: 1.3863}
"""Median of chi2 with 1 and 2 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """One source of residuals, with its estimated noise and its outliers."""

    data: CornerData | RangeData
    scale: float
    """Estimated noise over the stated one."""
    kept: Flags
    """(V, N) True for each point that counts: measured, and no outlier."""
    scatter: float = 1.0
    """Variance by which frames disagree, over that which `scale` explains; residuals weigh by both."""

    @property
    def there(self) -> Flags:
        """(V, N) True for each point that was measured."""
        return self.data.seen if isinstance(self.data, CornerData) else self.data.measured

    @property
    def whole_scale(self) -> float:
        """Noise and scatter of frames together, over the stated noise."""
        return self.scale * float(np.sqrt(self.scatter))

    @property
    def scale_min(self) -> float:
        """Least noise over the stated one: exact points leave rounding, by which nothing can be weighed."""
        return (
            NOISE_MIN_PX / self.data.sigma_px if isinstance(self.data, CornerData) else NOISE_MIN_M / self.data.sigma_m
        )

    @property
    def axes(self) -> int:
        """Number of residuals of one point."""
        return 2 if isinstance(self.data, CornerData) else 1


@dataclass(frozen=True, slots=True)
class AdjustmentProblem:
    """Residuals, priors and free parameters of one least-squares problem."""

    board: Board
    layout: ParameterLayout
    sensors: tuple[Sensor, ...]
    priors: tuple[Prior, ...]
    known: tuple[KnownNumbers, ...] = ()
    """Numbers that were known before."""

    def blocks(self, state: RigState, *, huber_sigmas: float = np.inf) -> list[Block]:
        """Blocks of the normal equations at a state, one for each sensor."""
        board = (self.board.points(), warp_shape(self.board))
        blocks = []
        for sensor in self.sensors:
            # Noise and the scatter of frames weigh alike.
            loss = Loss(sensor.whole_scale, sensor.kept, huber_sigmas)
            if isinstance(sensor.data, CornerData):
                blocks.append(corner_block(sensor.data, state, self.layout, board, loss))
            else:
                blocks.append(range_block(sensor.data, state, self.layout, self.board, loss))
        return blocks

    def normal(self, state: RigState, blocks: list[Block]) -> NormalEquations:
        """Normal equations at a state: the sum of all blocks and of the priors."""
        normal = sum_blocks(blocks, self.layout.size, len(state.T_rig_board))
        A, a, cost = normal.A.copy(), normal.a.copy(), normal.cost
        values, by_step = known_values(state, self.layout), known_by_step(state, self.layout)
        for prior in (*self.priors, *(prior for each in self.known for prior in each.priors())):
            # A prior is one more residual, (row . values - value) / sigma.
            row = self.prior_row(prior)
            miss = float(row @ values - prior.value) / prior.sigma
            row = row @ by_step
            A += np.outer(row, row) / prior.sigma**2
            a -= row * miss / prior.sigma
            cost += miss**2
        return replace(normal, A=A, a=a, cost=cost)

    def prior_row(self, prior: Prior) -> Floats:
        """(P,) coefficients of a prior; parameters that are held fall out."""
        row = np.zeros(self.layout.size)
        for owner, name, coefficient in prior.terms:
            at = self.layout.index(owner, name)
            if at is not None:
                row[at] += coefficient
        return row


@dataclass(frozen=True, slots=True)
class Adjustment:
    """End of an adjustment: the estimate, and the equations there."""

    problem: AdjustmentProblem
    state: RigState
    blocks: list[Block]
    normal: NormalEquations
    steps: int


def adjust(problem: AdjustmentProblem, state: RigState, noise: NoisePlan) -> Adjustment:
    """The minimum, with outliers left out and the noise of each sensor estimated as `noise` says.

    Raises:
        numpy.linalg.LinAlgError: the data do not determine all parameters.
    """
    if noise.rounds == 0:
        return descend(problem, state, huber_sigmas=noise.huber_sigmas)
    # 1. Robust: noise from the median at the start, Huber's loss, noise from the median at the minimum.
    result = descend(_rescale_by_median(problem, state), state, huber_sigmas=noise.huber_sigmas, settled=COARSE)
    result = replace(result, problem=_rescale_by_median(result.problem, result.state))
    # 2. Least squares over what is within the bound; outliers and noise by turns, until neither changes.
    for _ in range(noise.rounds):
        # Outliers by all residuals, then the minimum without them, then the noise there.
        before = result.problem.sensors
        blocks = result.problem.blocks(result.state)
        kept = tuple(_cull(sensor, each, noise.cull_sigmas) for sensor, each in zip(before, blocks, strict=True))
        result = descend(replace(result.problem, sensors=kept), result.state, settled=COARSE, damping=WARM)
        scaled = _rescale(result)
        result = replace(result, problem=replace(result.problem, sensors=scaled))
        if all(
            np.array_equal(a.kept, b.kept) and abs(a.scale / c.scale - 1) < SCALE_SETTLED
            for a, b, c in zip(before, kept, scaled, strict=True)
        ):
            break
    # Last, to full precision.
    return descend(result.problem, result.state, damping=WARM)


def resume(problem: AdjustmentProblem, state: RigState, noise: NoisePlan) -> Adjustment:
    """The minimum of a problem with more parameters, from the outliers, noise and state of one with fewer.

    Raises:
        numpy.linalg.LinAlgError: the data do not determine all parameters.
    """
    result = descend(problem, state, settled=COARSE, damping=WARM)
    if noise.rounds == 0:
        return descend(problem, result.state, damping=WARM)
    return descend(replace(problem, sensors=_rescale(result)), result.state, damping=WARM)


def descend(
    problem: AdjustmentProblem,
    state: RigState,
    *,
    huber_sigmas: float = np.inf,
    settled: float = SETTLED,
    damping: float = DAMPING,
) -> Adjustment:
    """The minimum for known noise and outliers, to a fall of the cost of `settled`.

    Raises:
        numpy.linalg.LinAlgError: the data do not determine all parameters.
    """
    # The cost at the start; NaN where a point has no image.
    blocks = problem.blocks(state, huber_sigmas=huber_sigmas)
    normal = problem.normal(state, blocks)
    if not np.isfinite(normal.cost):
        raise np.linalg.LinAlgError("the start puts corners where the lens sees nothing")
    # Invariant: `blocks` and `normal` are those of `state`, whose cost only falls.
    for step in range(STEPS_MAX):
        shared, boards, expected = normal.step(damping)
        if expected < settled:
            return Adjustment(problem, state, blocks, normal, step)
        trial = step_state(state, problem.layout, shared, boards)
        trial_blocks = problem.blocks(trial, huber_sigmas=huber_sigmas)
        trial_normal = problem.normal(trial, trial_blocks)
        # A step that helps is taken with less damping next; one that does not is tried again, shorter.
        if trial_normal.cost < normal.cost:
            state, blocks, normal = trial, trial_blocks, trial_normal
            damping = max(damping / 10, DAMPING_MIN)
        elif damping >= DAMPING_MAX or trial_normal.cost - normal.cost < ROUNDING * normal.cost:
            # Rounding is all that is left to gain.
            return Adjustment(problem, state, blocks, normal, step)
        else:
            damping *= 10
    return Adjustment(problem, state, blocks, normal, STEPS_MAX)


def redundancies(blocks: list[Block], known: Uncertainty, sensors: tuple[Sensor, ...]) -> list[float]:
    """Redundancy of each sensor: the number of its residuals that the estimated parameters leave free.

    Foerstner 1979: r = m - trace(J cov J^T), which is the expected sum of squares of whitened residuals.
    """
    return [
        float(sensor.kept.sum() * sensor.axes - np.sum(known.of_block(block.at, block.frames) * block.square))
        for block, sensor in zip(blocks, sensors, strict=True)
    ]


def _cull(sensor: Sensor, block: Block, sigmas: float) -> Sensor:
    """The sensor whose measured points count if they are within `sigmas`, whatever they did before."""
    squares = np.sum(block.residuals**2, axis=-1)
    # Out and in again: a point that fits later counts again.
    return replace(sensor, kept=sensor.there & (squares <= sigmas**2))


def _rescale(result: Adjustment) -> tuple[Sensor, ...]:
    """Sensors with the noise that their residuals show: variance is their sum of squares over their redundancy."""
    sensors = result.problem.sensors
    free = redundancies(result.blocks, uncertainty(result.normal), sensors)
    scaled = []
    for sensor, block, count in zip(sensors, result.blocks, free, strict=True):
        # Residuals are whitened by the old scale, so the new one is its multiple. Scatter of frames is not known yet.
        variance = float(np.sum(block.residuals[sensor.kept] ** 2)) / count if count > 1 else 1.0
        scaled.append(replace(sensor, scale=max(sensor.scale * float(np.sqrt(variance)), sensor.scale_min)))
    return tuple(scaled)


def _rescale_by_median(problem: AdjustmentProblem, state: RigState) -> AdjustmentProblem:
    """The problem with noise by the median of squared residuals, which half of the points may spoil."""
    scaled = []
    for sensor, block in zip(problem.sensors, problem.blocks(state), strict=True):
        squares = np.sum(block.residuals**2, axis=-1)[sensor.kept]
        # Squares of residuals of one sigma have the median of chi2; those of exact points are 0.
        factor = np.sqrt(np.median(squares) / MEDIAN_SQUARE[sensor.axes]) if squares.size else 1.0
        scaled.append(replace(sensor, scale=max(sensor.scale * float(factor), sensor.scale_min)))
    return replace(problem, sensors=tuple(scaled))
