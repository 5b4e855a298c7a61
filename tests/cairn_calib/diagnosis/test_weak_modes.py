"""The weakest mode is the worst direction there is, whatever the units of the parameters."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import SPECTRA, views_of, world

from cairn_calib.diagnosis.probe_points import Probes, probes_of
from cairn_calib.diagnosis.weak_modes import ADVICE, NAMED_MAX, STRONG, WeakMode, weak_modes
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import STATED, usual_plan
from cairn_calib.solve.solved_rig import solved_rig

Floats = npt.NDArray[np.float64]
PAIR = ("tof", "left")
PLAN = replace(usual_plan({name: SPECTRA[name] for name in PAIR}), noise=STATED)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve_rig(views_of(world(6, seed=4, names=PAIR), seed=4), PLAN)


@pytest.fixture(scope="module")
def probes(solution: Solution) -> list[Probes]:
    return probes_of(solved_rig(solution, made_s=0.0), PLAN.gauge, solution.layout)


def rms_px(each: Probes, change: Floats) -> float:
    """Root mean square motion of a camera's probe points by a change of the parameters, pixels, one axis."""
    return float(np.sqrt(np.mean((each.rows @ change) ** 2)))


def test_no_change_that_is_as_likely_moves_the_probe_points_farther(solution: Solution, probes: list[Probes]) -> None:
    sigmas = np.sqrt(np.diag(solution.covariance))
    root = sigmas[:, None] * np.linalg.cholesky(solution.covariance / sigmas[:, None] / sigmas)
    rng = np.random.default_rng(7)
    for each, mode in zip(probes, weak_modes(solution, probes), strict=True):
        assert mode.camera == each.camera
        directions = rng.normal(size=(500, len(root)))
        likely = (directions / np.linalg.norm(directions, axis=1)[:, None]) @ root.T
        moves = [rms_px(each, change) for change in likely]
        assert max(moves) <= mode.sigma_px * (1 + 1e-9)
        # Power iteration from any of them finds the mode itself.
        G = each.rows.reshape(-1, len(root)) @ root
        v = directions[0]
        for _ in range(300):
            v = G.T @ (G @ v)
            v /= np.linalg.norm(v)
        assert rms_px(each, root @ v) == pytest.approx(mode.sigma_px, rel=1e-6)
        correlations = (root @ v) / sigmas
        owner, name, strongest = mode.parameters[0]
        at = solution.layout.index(owner, name)
        assert at == int(np.argmax(np.abs(correlations)))
        assert abs(strongest) == pytest.approx(np.abs(correlations).max(), rel=1e-3)


def test_its_share_is_of_all_variance_of_the_probe_points(solution: Solution, probes: list[Probes]) -> None:
    for each, mode in zip(probes, weak_modes(solution, probes), strict=True):
        total = float(np.mean(each.sigmas_px(solution.covariance) ** 2))
        assert mode.share == pytest.approx(mode.sigma_px**2 / total, rel=1e-6)
        assert 0 < mode.share <= 1


def test_named_parameters_go_with_it_the_strongest_first(solution: Solution, probes: list[Probes]) -> None:
    for mode in weak_modes(solution, probes):
        strengths = [abs(correlation) for _, _, correlation in mode.parameters]
        assert 1 <= len(strengths) <= NAMED_MAX
        assert strengths == sorted(strengths, reverse=True)
        assert max(strengths) <= 1 + 1e-9
        assert all(strength >= STRONG for strength in strengths[1:])
        assert all(owner in mode.words or owner == "board" for owner, _, _ in mode.parameters)


@pytest.mark.parametrize(("names", "advice"), ADVICE)
def test_each_group_of_names_has_its_advice(names: set[str], advice: str) -> None:
    mode = WeakMode("left", 0.1, 0.9, tuple(("left", name, 0.9) for name in sorted(names)))
    assert mode.advice == advice
    assert mode.words == f"{', '.join(sorted(names))} of left"
