"""Derivatives agree with differences, and the Schur complement with the whole system solved at once."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import SPECTRA, ranges_of, views_of, world

from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.solve.adjustment import AdjustmentProblem, Sensor
from cairn_calib.solve.corner_residuals import CornerData
from cairn_calib.solve.normal_equations import Loss, NormalEquations, solve_scaled, sum_blocks, uncertainty
from cairn_calib.solve.rig_state import RigState, step_state
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan

Floats = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def solution() -> Solution:
    """Three cameras, the gauge not the range camera, so that every kind of column is there."""
    names = ("left", "tof", "thermal-left")
    truth = world(5, seed=8, names=names, warp_m=(0.001, 0.0), bias=(0.02, 0.004, 0.01, -0.02))
    views = replace(views_of(truth, seed=8), ranges=ranges_of(truth, "tof", seed=8, sigma_m=0.006))
    return solve_rig(views, usual_plan({name: SPECTRA[name] for name in names}, gauge="left"))


def dense(normal: NormalEquations) -> tuple[Floats, Floats]:
    """The whole matrix and right side, boards and all: the slow twin of the Schur complement."""
    size, frames = len(normal.A), len(normal.C)
    H, g = np.zeros((size + 6 * frames,) * 2), np.concatenate([normal.a, normal.b.ravel()])
    H[:size, :size] = normal.A
    for frame in range(frames):
        at = slice(size + 6 * frame, size + 6 * frame + 6)
        H[:size, at], H[at, :size], H[at, at] = normal.B[frame], normal.B[frame].T, normal.C[frame]
    return H, g


def residuals(sensor: Sensor, problem: AdjustmentProblem, state: RigState) -> Floats:
    alone = replace(problem, sensors=(sensor,))
    return alone.blocks(state)[0].residuals


def test_the_schur_complement_solves_the_whole_system(solution: Solution) -> None:
    problem = solution.adjustment.problem
    away = step_state(solution.state, solution.layout, 1e-4 * np.ones(solution.layout.size), np.full((5, 6), 1e-4))
    normal = problem.normal(away, problem.blocks(away))
    H, g = dense(normal)
    scale = 1 / np.sqrt(np.diag(H))
    for damping in (0.0, 1e-3):
        whole = H + damping * np.diag(np.diag(H))
        step = scale * np.linalg.solve(whole * scale[:, None] * scale, scale * g)
        shared, boards, expected = normal.step(damping)
        np.testing.assert_allclose(np.concatenate([shared, boards.ravel()]), step, rtol=1e-5, atol=1e-12)
        assert expected == pytest.approx(2 * g @ step - step @ H @ step, rel=1e-6)


def test_covariances_are_those_of_the_whole_system(solution: Solution) -> None:
    H, _ = dense(solution.adjustment.normal)
    scale = 1 / np.sqrt(np.diag(H))
    whole = np.linalg.inv(H * scale[:, None] * scale) * scale[:, None] * scale
    size = solution.layout.size
    known = uncertainty(solution.adjustment.normal)
    sigmas = np.sqrt(np.diag(whole))
    pairs = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(known.shared / pairs[:size, :size], whole[:size, :size] / pairs[:size, :size], atol=1e-6)
    at = np.array([0, 3, size - 1])
    joint = known.of_block(at, np.array([1, 4]))
    for n, frame in enumerate((1, 4)):
        rows = np.concatenate([at, size + 6 * frame + np.arange(6)])
        there = np.ix_(rows, rows)
        np.testing.assert_allclose(joint[n] / pairs[there], whole[there] / pairs[there], atol=1e-6)
        np.testing.assert_allclose(known.of_board(frame), joint[n][3:, 3:], rtol=1e-9)


def test_every_derivative_agrees_with_differences(solution: Solution) -> None:
    problem, layout = solution.adjustment.problem, solution.layout
    state, frames = solution.state, len(solution.state.T_rig_board)
    sigmas = np.sqrt(np.diag(solution.covariance))
    for sensor in problem.sensors:
        # A loss that never bends, and steps of a tenth of a sigma.
        everything = replace(sensor, kept=sensor.there)
        block = replace(problem, sensors=(everything,)).blocks(state)[0]
        k = len(block.at)
        for column in range(k + 6):
            shared, boards = np.zeros(layout.size), np.zeros((frames, 6))
            h = 0.1 * sigmas[block.at[column]] if column < k else 1e-5
            if column < k:
                shared[block.at[column]] = h
            else:
                boards[:, column - k] = h
            ahead = residuals(everything, problem, step_state(state, layout, shared, boards))
            behind = residuals(everything, problem, step_state(state, layout, -shared, -boards))
            numeric = ((ahead - behind) / (2 * h)).reshape(len(block.frames), -1)
            square = np.sum(numeric**2, axis=1)
            np.testing.assert_allclose(block.square[:, column, column], square, rtol=2e-4, atol=1e-6 * square.max())
            at_rest = residuals(everything, problem, state).reshape(len(block.frames), -1)
            pull = -np.sum(numeric * at_rest, axis=1)
            bound = np.sqrt(square.max() * np.sum(at_rest**2, axis=1).max())
            np.testing.assert_allclose(block.pull[:, column], pull, atol=1e-5 * bound)


def test_a_minimum_has_no_slope(solution: Solution) -> None:
    normal = solution.adjustment.normal
    assert np.abs(normal.a / np.sqrt(np.diag(normal.A))).max() < 1e-4
    assert np.abs(normal.b).max() / np.sqrt(np.einsum("fkk->fk", normal.C)).max() < 1e-4


def test_hubers_loss_grows_linearly_and_weights_are_its_slope() -> None:
    squares = np.array([1.0, 4.0, 100.0])
    weights, cost = Loss(1.0, np.ones(3, bool), 1.5)(squares)
    np.testing.assert_allclose(weights, [1.0, 0.75, 0.15])
    assert cost == pytest.approx(1 + (2 * 1.5 * 2 - 1.5**2) + (2 * 1.5 * 10 - 1.5**2))
    loss, h = Loss(1.0, np.ones(1, bool), 1.5), 1e-6
    slopes = [(loss(np.array([s + h]))[1] - loss(np.array([s - h]))[1]) / (2 * h) for s in squares]
    np.testing.assert_allclose(slopes, weights, rtol=1e-6)
    assert Loss(1.0, np.array([True, True]), 1.5)(np.array([1.0, np.nan]))[1] == np.inf
    assert Loss(1.0, np.array([True, False]), 1.5)(np.array([1.0, np.nan]))[1] == 1


def test_corners_weigh_by_their_covariance(solution: Solution) -> None:
    data = solution.adjustment.problem.sensors[0].data
    assert isinstance(data, CornerData)
    view = solution.views.of_camera("left")[0]
    n = int(np.flatnonzero(view.corners.seen)[0])
    W = data.whitening[0, n]
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(view.corners.covariance_px2[n]), rtol=1e-9)


def test_moving_rig_and_boards_together_moves_no_residual(solution: Solution) -> None:
    G = transform_from_vector([0.3, -0.5, 1.1, 2.0, -1.0, 0.4])
    state = solution.state
    moved = replace(state, T_rig_camera=G @ state.T_rig_camera, T_rig_board=G @ state.T_rig_board)
    for sensor in solution.adjustment.problem.sensors:
        here, there = (residuals(sensor, solution.adjustment.problem, each) for each in (state, moved))
        np.testing.assert_allclose(there, here, atol=1e-6)
        assert np.abs(here).max() > 0.1


def test_the_order_of_blocks_is_no_matter_and_equations_add_up(solution: Solution) -> None:
    problem = solution.adjustment.problem
    blocks = problem.blocks(solution.state)
    sizes = (solution.layout.size, len(solution.state.T_rig_board))
    forward, backward = sum_blocks(blocks, *sizes), sum_blocks(blocks[::-1], *sizes)
    parts = [sum_blocks([block], *sizes) for block in blocks]
    for name in ("A", "B", "C", "a", "b"):
        whole = getattr(forward, name)
        # At a minimum blocks pull against each other: what is left of them is rounding's.
        scale = sum(np.abs(getattr(part, name)) for part in parts).max()
        np.testing.assert_allclose(getattr(backward, name), whole, rtol=1e-12, atol=1e-12 * scale)
        np.testing.assert_allclose(sum(getattr(part, name) for part in parts), whole, rtol=1e-12, atol=1e-12 * scale)
    assert forward.cost == pytest.approx(sum(part.cost for part in parts))


def test_other_units_of_the_parameters_scale_the_solution_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    J, right = rng.normal(size=(20, 6)), rng.normal(size=6)
    units = 10.0 ** np.array([-6, -3, 0, 3, 6, 9])
    S = J.T @ J
    solved = solve_scaled(S, right)
    np.testing.assert_allclose(S @ solved, right, atol=1e-10)
    np.testing.assert_allclose(solve_scaled(units[:, None] * S * units, units * right) * units, solved, rtol=1e-9)
    np.testing.assert_allclose(solve_scaled(S, np.eye(6)) @ S, np.eye(6), atol=1e-9)


def test_what_has_no_effect_or_two_signs_is_refused() -> None:
    for S in (np.diag([1.0, 0.0]), np.array([[1.0, 2.0], [2.0, 1.0]])):
        with pytest.raises(np.linalg.LinAlgError):
            solve_scaled(S, np.ones(2))
