"""Scatter of frames: errors that all corners of an image share enlarge the covariance, noise does not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import BOARD, SPECTRA, World, errors_of, views_of, world

from cairn_calib.board.corners import Corners
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import STATED, usual_plan
from cairn_calib.solve.solved_rig import solved_rig

PAIR = ("tof", "left")
PLAN = usual_plan({name: SPECTRA[name] for name in PAIR})


def bent(views: BoardViews, *, seed: int, px: float) -> BoardViews:
    """Each image bent by curves of its own, that many pixels large."""
    rng = np.random.default_rng([seed, 9])
    x, y = (2 * BOARD.lattice() / BOARD.lattice().max(axis=0) - 1).T
    curves = np.stack([x**2 - 1 / 3, y**2 - 1 / 3, x * y, x**3, y**3], axis=1)

    def bend(view: BoardView) -> BoardView:
        pixels = view.corners.pixels + curves @ rng.normal(size=(5, 2)) * px
        return replace(view, corners=Corners(BOARD, pixels, view.corners.covariance_px2))

    return replace(views, views=tuple(map(bend, views.views)))


def squared_sigmas(solution: Solution, truth: World) -> float:
    """Errors of all parameters of the cameras in their covariance: chi2 a parameter, 1 if it holds."""
    errors = {parameter: error for parameter, error in errors_of(solution, truth).items() if parameter[0]}
    rows = [solution.layout.names.index(parameter) for parameter in errors]
    off = np.array(list(errors.values()))
    return float(off @ np.linalg.solve(solution.covariance[np.ix_(rows, rows)], off)) / len(off)


@pytest.mark.slow
def test_covariances_hold_for_images_that_are_off_as_a_whole() -> None:
    before, after = [], []
    for seed in range(8):
        truth = world(12, seed=seed, names=PAIR)
        solution = solve_rig(bent(views_of(truth, seed=seed), seed=seed, px=0.3), PLAN)
        after.append(squared_sigmas(solution, truth))
        before.append(solution.scatter * after[-1])
    assert np.median(before) > 4
    assert 0.4 < np.median(after) < 2


def test_noise_alone_leaves_the_covariance_as_it_is() -> None:
    for seed in range(3):
        solution = solve_rig(views_of(world(8, seed=seed, names=PAIR), seed=seed, noise=3.0), PLAN)
        assert solution.scatter == 1.0
        # Three times the stated noise is in the covariance by each camera's own estimate.
        assert [sensor.scale for sensor in solution.adjustment.problem.sensors] == pytest.approx([3.0, 3.0], rel=0.15)
        statistics = solved_rig(solution, made_s=0.0).calibration
        assert statistics is not None and statistics.statistics is not None and statistics.statistics.scatter is None


def test_the_rig_states_by_what_its_covariance_was_enlarged() -> None:
    views = bent(views_of(world(8, seed=1, names=PAIR), seed=1), seed=1, px=0.3)
    solution, plain = solve_rig(views, PLAN), solve_rig(views, replace(PLAN, noise=STATED))
    assert plain.scatter == 1.0 < solution.scatter
    calibration = solved_rig(solution, made_s=0.0).calibration
    assert calibration is not None and calibration.statistics is not None and calibration.covariance is not None
    assert calibration.statistics.scatter == solution.scatter
    assert np.diag(calibration.covariance.matrix)[0] == pytest.approx(solution.sigmas()["tof", "fx"] ** 2)
