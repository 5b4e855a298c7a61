"""Numbers that were known before: held ones, priors with a covariance, and those that the images contradict."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import LENSES, SPECTRA, errors_of, views_of, world

from cairn_calib.diagnosis.examination import examine
from cairn_calib.diagnosis.held_numbers import held_fits
from cairn_calib.rig.pose_vectors import transform_from_vector, vector_from_transform
from cairn_calib.solve.rig_state import known_by_step, known_values, step_state
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import CameraPlan, KnownNumbers, SolvePlan, usual_plan
from cairn_calib.solve.solved_rig import solved_rig

PAIR = ("tof", "left")
PLAN = usual_plan({name: SPECTRA[name] for name in PAIR})
TRUTH = world(8, seed=6, names=PAIR)
VIEWS = views_of(TRUTH, seed=6)


@pytest.fixture(scope="module")
def joint() -> Solution:
    return solve_rig(VIEWS, PLAN)


def lens_values(solution: Solution, camera: str) -> dict[str, float]:
    lens = solution.state.lenses[list(solution.plan.cameras).index(camera)]
    return dict(zip(lens.intrinsic_names, lens.intrinsics.tolist(), strict=True))


def holding(camera: str, values: dict[str, float], names: tuple[str, ...] | None = None) -> SolvePlan:
    held = replace(PLAN.cameras[camera], known=values, held=names or tuple(values))
    return replace(PLAN, cameras={**PLAN.cameras, camera: held})


def test_a_held_focal_length_reproduces_the_joint_solve(joint: Solution) -> None:
    known = lens_values(joint, "left")
    solution = solve_rig(VIEWS, holding("left", {name: known[name] for name in ("fx", "fy")}))
    assert ("left", "fx") not in solution.layout.names and ("left", "cx") in solution.layout.names
    sigmas, before, after = joint.sigmas(), joint.values(), solution.values()
    off = {each: abs(after[each] - before[each]) / sigmas[each] for each in after}
    assert max(off.values()) < 1e-3
    assert solution.state.T_rig_camera == pytest.approx(joint.state.T_rig_camera, abs=1e-6)
    # What is known makes the rest more certain.
    assert all(solution.sigmas()[each] < 1.001 * sigmas[each] for each in after)


def test_a_held_camera_is_not_moved_and_the_other_is_as_in_the_joint_solve(joint: Solution) -> None:
    known = lens_values(joint, "left")
    solution = solve_rig(VIEWS, holding("left", known))
    assert lens_values(solution, "left") == known
    sigmas, before, after = joint.sigmas(), joint.values(), solution.values()
    # To the noise, which is estimated with fewer unknowns.
    assert max(abs(after[each] - before[each]) / sigmas[each] for each in after) < 1e-2
    rig = solved_rig(solution, made_s=0.0)
    assert rig.calibration is not None and rig.calibration.covariance is not None
    left = {each.name for each in rig.calibration.covariance.parameters if each.camera == "left"}
    assert left == {"rx", "ry", "rz", "tx", "ty", "tz"}
    assert not held_fits(solution)[0].contradicts


def test_extrinsics_alone_need_no_tilted_boards() -> None:
    truth = world(3, seed=2, names=PAIR, tilt_deg=0.0)
    held = {
        name: CameraPlan(spectrum=SPECTRA[name], known=values, held=tuple(values))
        for name in PAIR
        for values in [dict(zip(LENSES[name].intrinsic_names, LENSES[name].intrinsics.tolist(), strict=True))]
    }
    solution = solve_rig(views_of(truth, seed=2), replace(PLAN, cameras=held))
    assert {name for owner, name in solution.layout.names if owner} == {"rx", "ry", "rz", "tx", "ty", "tz"}
    sigmas = solution.sigmas()
    off = [abs(error) / sigmas[each] for each, error in errors_of(solution, truth).items() if each in sigmas]
    assert max(off) < 4
    seen = examine(solution, solved_rig(solution, made_s=0.0))
    assert seen.verdict.is_usable
    assert not {"few_images", "tilt_range", "edge"} & {each.kind for each in seen.warnings if each.camera == "left"}


def test_a_prior_with_a_covariance_counts_as_a_measurement(joint: Solution) -> None:
    """The joint solve, used as a prior for its own images, is where it was, and sqrt(2) more certain of its lens."""
    names = tuple(
        name for owner, name in joint.layout.names if owner == "left" and name in LENSES["left"].intrinsic_names
    )
    rows = [joint.layout.names.index(("left", name)) for name in names]
    values = np.array([joint.values()["left", name] for name in names])
    known = KnownNumbers("left", "last year", names, values, joint.covariance[np.ix_(rows, rows)])
    solution = solve_rig(VIEWS, replace(PLAN, known=(known,)))
    assert solution.known[0].scale == 1.0 and not solution.known[0].contradicts
    after, before = solution.values(), joint.values()
    assert max(abs(after[each] - before[each]) / joint.sigmas()[each] for each in before) < 1e-2
    shares = [solution.sigmas()["left", name] / joint.sigmas()["left", name] for name in ("fx", "cx", "k1")]
    assert shares == pytest.approx([0.5**0.5] * 3, rel=0.02)


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_a_prior_that_contradicts_the_images_is_reported_in_sigmas_and_loses(joint: Solution, sigma: float) -> None:
    value, own = joint.values()["left", "fx"], joint.sigmas()["left", "fx"]
    wrong = KnownNumbers.single("left", "data sheet", "fx", value + 60.0, sigma)
    solution = solve_rig(VIEWS, replace(PLAN, known=(wrong,)))
    (fit,) = solution.known
    # Off by the difference, in the sigmas of both.
    assert fit.sigmas == pytest.approx(60.0 / np.hypot(sigma, own), rel=0.1)
    assert fit.scale * sigma == pytest.approx(60.0, rel=0.2)
    assert abs(solution.values()["left", "fx"] - value) < 0.5 * own
    seen = examine(solution, solved_rig(solution, made_s=0.0))
    told = next(each for each in seen.warnings if each.kind == "prior_contradicted")
    assert told.camera == "left" and f"contradict data sheet by {fit.sigmas:.1f} sigma, most of all its fx" in told.text
    assert str(seen.verdict).startswith("usable with care: left: the images contradict data sheet")


def test_a_prior_that_holds_is_left_as_it_is() -> None:
    off = []
    for seed in range(5):
        truth = world(6, seed=seed, names=PAIR)
        rng = np.random.default_rng(seed)
        fx = float(truth.lenses["left"].focal_px[0])
        known = KnownNumbers.single("left", "data sheet", "fx", fx + 2.0 * rng.normal(), 2.0)
        place = KnownNumbers.single("left", "drawing", "tx", float(truth.T_rig_camera("left")[0, 3]), 1e-4)
        solution = solve_rig(views_of(truth, seed=seed), replace(PLAN, known=(known, place)))
        assert [fit.scale for fit in solution.known] == [1.0, 1.0]
        assert solution.sigmas()["left", "tx"] <= 1.001e-4
        off.append(errors_of(solution, truth)["left", "tx"])
    assert np.abs(off).max() < 4e-4


def test_a_turn_by_a_drawing_is_kept_as_certain_as_it_is_stated() -> None:
    turn = vector_from_transform(TRUTH.T_rig_camera("left"))[:3]
    known = tuple(
        KnownNumbers.single("left", "drawing", name, float(value), 1e-5)
        for name, value in zip(("rx", "ry", "rz"), turn, strict=True)
    )
    solution = solve_rig(VIEWS, replace(PLAN, known=known))
    assert [fit.contradicts for fit in solution.known] == [False] * 3
    assert vector_from_transform(solution.state.T_rig_camera[1])[:3] == pytest.approx(turn, abs=4e-5)
    assert all(solution.sigmas()["left", name] < 1.001e-5 for name in ("rx", "ry", "rz"))
    off = KnownNumbers.single("left", "drawing", "ry", float(turn[1]) + 0.05, 1e-3)
    (fit,) = solve_rig(VIEWS, replace(PLAN, known=(off,))).known
    assert fit.sigmas > 10


def test_known_numbers_move_with_a_step_as_their_derivatives_say(joint: Solution) -> None:
    rng, layout, state = np.random.default_rng(2), joint.layout, joint.state
    T = state.T_rig_camera.copy()
    T[1] = transform_from_vector(np.array([0.7, -1.1, 0.4, 0.1, 0.2, 0.3]))
    state = replace(state, T_rig_camera=T)
    step = 1e-6 * rng.normal(size=layout.size)
    still = np.zeros((len(state.T_rig_board), 6))
    values = [known_values(step_state(state, layout, way * step, still), layout) for way in (1, -1)]
    assert (values[0] - values[1]) / 2 == pytest.approx(known_by_step(state, layout) @ step, abs=1e-9)


def test_a_held_lens_that_the_images_contradict_is_reported(joint: Solution) -> None:
    known = lens_values(joint, "left")
    solution = solve_rig(VIEWS, holding("left", {**known, "fx": known["fx"] + 40.0, "fy": known["fy"] + 40.0}))
    (fit,) = held_fits(solution)
    assert fit.contradicts and fit.names[int(np.argmax(fit.sigmas_off))] in ("fx", "fy")
    assert fit.changes[fit.names.index("fx")] == pytest.approx(-40.0, abs=15.0)
    seen = examine(solution, solved_rig(solution, made_s=0.0))
    assert seen.warnings[0].kind == "held_contradicted"


def test_a_covariance_and_its_priors_say_the_same() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4)) * np.array([1.0, 1e-3, 10.0, 1e-5])[:, None]
    known = KnownNumbers("left", "", ("fx", "k1", "cx", "k2"), rng.normal(size=4), root @ root.T)
    rows = np.array([[coefficient for _, _, coefficient in prior.terms] for prior in known.priors()])
    assert rows.T @ rows == pytest.approx(np.linalg.inv(root @ root.T), rel=1e-6)
    assert [prior.value for prior in known.priors()] == pytest.approx((rows @ known.values).tolist())
