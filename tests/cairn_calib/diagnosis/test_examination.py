"""Examination of a solution against the truth: influence, next image, certainty of pixels, halves, warnings."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import SPECTRA, exact_pixels, views_of, world

from cairn_calib.board.corners import Corners
from cairn_calib.diagnosis.cross_validation import cross_validate
from cairn_calib.diagnosis.examination import Examination, examine
from cairn_calib.diagnosis.frame_influence import Influence
from cairn_calib.diagnosis.next_image import NextImage
from cairn_calib.diagnosis.probe_points import probes_of
from cairn_calib.diagnosis.solve_warnings import refuse_undetermined, warnings_of
from cairn_calib.diagnosis.verdict import Rank, SolveWarning, merged, ranked, verdict_of
from cairn_calib.diagnosis.view_statistics import coverage
from cairn_calib.diagnosis.world_uncertainty import pixel_covariance, world_covariance
from cairn_calib.rig.projection_uncertainty import project_certain, transfer_certain
from cairn_calib.solve.adjustment import Adjustment, Sensor
from cairn_calib.solve.board_views import BoardView
from cairn_calib.solve.rig_state import step_state
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_from, solve_rig
from cairn_calib.solve.solve_plan import STATED, usual_plan
from cairn_calib.solve.solved_rig import solved_rig
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
PAIR = ("tof", "left")
PLAN = replace(usual_plan({name: SPECTRA[name] for name in PAIR}), noise=STATED)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve_rig(views_of(world(8, seed=6, names=PAIR), seed=6), PLAN)


@pytest.fixture(scope="module")
def seen(solution: Solution) -> Examination:
    return examine(solution, solved_rig(solution, made_s=0.0))


def test_influence_foretells_what_a_solve_without_the_frame_finds(solution: Solution, seen: Examination) -> None:
    strongest = seen.influences[0]
    others = [frame for frame in solution.views.frames if frame != strongest.frame]
    without = solve_rig(solution.views.of_frames(others), PLAN)
    there = {each.camera: each for each in seen.probes}[strongest.camera]
    if strongest.camera == PLAN.gauge:
        pixels = without.state.lenses[0].project(solution.state.lenses[0].unproject(there.pixels))
    else:
        source = transfer_back(solution, there.pixels, there.range_m)
        before, pixels = (
            transfer_certain(each, "tof", strongest.camera, source, there.range_m).pixels
            for each in (seen.rig, solved_rig(without, made_s=0.0))
        )
        assert before == pytest.approx(there.pixels)
    moves = np.linalg.norm(pixels - there.pixels, axis=1)
    assert strongest.moves_px == pytest.approx(moves.max(), rel=0.25)
    assert [each.sigmas for each in seen.influences] == sorted((each.sigmas for each in seen.influences), reverse=True)


def transfer_back(solution: Solution, pixels: Floats, range_m: Floats) -> Floats:
    """Pixels of the gauge at which lie points that the other camera sees, that far from the gauge."""
    T = solution.state.T_rig_camera[1]
    rays = solution.state.lenses[1].unproject(pixels) @ T[:3, :3].T
    # |t + s ray| = range
    along = rays @ T[:3, 3]
    s = -along + np.sqrt(along**2 + range_m**2 - T[:3, 3] @ T[:3, 3])
    return solution.state.lenses[0].project(T[:3, 3] + s[:, None] * rays)


def test_the_next_image_sharpens_the_rig_as_foretold(solution: Solution, seen: Examination) -> None:
    place = seen.next_images[0]
    assert 0 < place.gain < 1
    truth = world(8, seed=6, names=PAIR)
    boards = np.concatenate([truth.boards, board_at(solution, place)[None]])
    views = views_of(replace(truth, boards=boards), seed=6)
    after = solve_rig(views, PLAN)
    variance = [variance_of(each, solution) for each in (solution, after)]
    assert 1 - variance[1] / variance[0] == pytest.approx(place.gain, abs=0.15)


def board_at(solution: Solution, place: NextImage) -> Floats:
    """T_rig_board of a proposal, from its words alone."""
    n = list(solution.plan.cameras).index(place.camera)
    turn = {"right": (0, -1), "left": (0, 1), "lower": (1, 0), "upper": (-1, 0)}[place.edge]
    axis, angle = np.array([*turn, 0.0]), np.radians(35)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    middle = solution.views.board.points().mean(axis=0)
    ray = solution.state.lenses[n].unproject(np.array(place.pixel))
    T[:3, 3] = place.range_m * ray - T[:3, :3] @ middle
    # The edge that is said to be further away is.
    points = solution.views.board.points()
    depth = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    far = points[depth.argmax(), :2] - middle[:2]
    assert {"right": far[0], "left": -far[0], "lower": far[1], "upper": -far[1]}[place.edge] > 0
    return np.asarray(solution.state.T_rig_camera[n] @ T)


def variance_of(solution: Solution, at: Solution) -> float:
    """Variance of the probe points, in units of each camera's noise."""
    noise = {"tof": 0.1, "left": 0.15}
    probes = probes_of(solved_rig(at, made_s=0.0), "tof", at.layout)
    return float(sum(np.mean(each.sigmas_px(solution.covariance) ** 2) / noise[each.camera] ** 2 for each in probes))


def test_certainty_of_a_pixel_is_the_spread_over_many_noises(solution: Solution) -> None:
    truth = world(8, seed=6, names=PAIR)
    rig = solved_rig(solution, made_s=0.0)
    pixels, range_m = np.array([[60.0, 50.0], [88.0, 71.0], [110.0, 90.0]]), np.array([1.5, 2.0, 2.5])
    stated = transfer_certain(rig, "tof", "left", pixels, range_m)
    found = []
    for seed in range(32):
        # The pitch is no noise: it is the same in all of them.
        again = solve_from(views_of(truth, seed=100 + seed), replace(PLAN, pitch_sigma=0.0), solution.state, {})
        found.append(transfer_certain(solved_rig(again, made_s=0.0), "tof", "left", pixels, range_m).pixels)
    spread = np.std(found, axis=0)
    sigmas = np.sqrt(np.einsum("rii->ri", stated.calibration_px2))
    assert np.median(spread / sigmas) == pytest.approx(1, abs=0.2)
    assert stated.covariance_px2 == pytest.approx(stated.calibration_px2)


def test_centroid_and_range_add_their_shares(solution: Solution) -> None:
    rig = solved_rig(solution, made_s=0.0)
    pixel, range_m = np.array([70.0, 60.0]), np.array(1.5)
    sure = transfer_certain(rig, "tof", "left", pixel, range_m, pixel_sigma_px=0.25, range_sigma_m=0.01)
    h = 1e-4
    by_range = transfer_certain(rig, "tof", "left", pixel, range_m + h).pixels - sure.pixels
    assert sure.range_px2 == pytest.approx(np.outer(by_range, by_range) / h**2 * 0.01**2, rel=1e-2)
    moves = np.stack(
        [transfer_certain(rig, "tof", "left", pixel + h * e, range_m).pixels - sure.pixels for e in np.eye(2)]
    )
    assert sure.centroid_px2 == pytest.approx(moves.T @ moves / h**2 * 0.25**2, rel=1e-2)
    near = project_certain(rig, "left", np.array([0.1, 0.1, 1.5]))
    assert np.all(np.linalg.eigvalsh(near.covariance_px2) > 0)
    with pytest.raises(BadInputError, match="does not say how certain"):
        project_certain(rig.model_copy(update={"calibration": None}), "left", np.array([0.1, 0.1, 1.5]))


def test_certainty_of_the_world_does_not_depend_on_the_gauge(solution: Solution) -> None:
    other = solve_rig(solution.views, replace(PLAN, gauge="left"))
    pixels = np.array([[20.0, 20.0], [88.0, 71.0], [150.0, 120.0]])
    covariances = [
        pixel_covariance(each, solved_rig(each, made_s=0.0), world_covariance(each), "tof", pixels, 2.0)
        for each in (solution, other)
    ]
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=1e-4)


def test_halves_agree_when_the_model_is_right_and_not_when_a_board_moved(solution: Solution, seen: Examination) -> None:
    assert seen.halves is not None
    assert max(each.ratio for each in seen.halves.cameras) < 3
    assert seen.halves.chi2 < 3 * seen.halves.parameters
    # The head was knocked every other time: the colour camera then sees all 3 px aside.
    odd = set(solution.views.frames[1::2])
    knocked = {("left", frame) for frame in odd}
    views = tuple(shifted(view, 3.0) if (view.camera, view.frame) in knocked else view for view in solution.views.views)
    wrong = solve_rig(replace(solution.views, views=views), usual_plan({name: SPECTRA[name] for name in PAIR}))
    probes = probes_of(solved_rig(wrong, made_s=0.0), "tof", wrong.layout)
    halves = cross_validate(wrong, probes)
    assert halves is not None
    assert halves.chi2 > 5 * halves.parameters
    told = examine(wrong, solved_rig(wrong, made_s=0.0)).warnings
    assert "model_error" in {each.kind for each in told}


def shifted(view: BoardView, px: float) -> BoardView:
    corners = Corners(view.corners.board, view.corners.pixels + px, view.corners.covariance_px2)
    return replace(view, corners=corners)


def kinds(found: Sequence[SolveWarning]) -> set[tuple[str, str]]:
    return {(each.kind, each.camera) for each in found}


def test_warnings_name_what_the_images_lack() -> None:
    poor = world(3, seed=1, names=PAIR, tilt_deg=12.0)
    solution = solve_rig(views_of(poor, seed=1), PLAN)
    told = examine(solution, solved_rig(solution, made_s=0.0)).warnings
    assert {
        ("few_images", "tof"),
        ("tilt_range", "tof"),
        ("range_span", "tof"),
        ("coverage", "tof"),
        ("edge", "left"),
        ("tof_edge", "tof"),
        ("range_bias", "tof"),
        ("halves", ""),
    } <= kinds(told)
    assert all(np.isfinite(each.threshold) and each.text for each in told)
    tilt = next(each for each in told if each.kind == "tilt_range")
    assert tilt.measured < tilt.threshold == 30
    assert "prior" in {each.kind for each in told}
    weak = next(each for each in told if each.kind == "weak_mode" and each.camera == "tof")
    assert weak.measured > weak.threshold == 1
    assert re.match(r"points may be off by .* px .*, for .*fx.* of tof.* are open together: a longer lens", weak.text)
    few = world(4, seed=1, names=PAIR, tilt_deg=25.0)
    solution = solve_rig(views_of(few, seed=1), PLAN)
    told = examine(solution, solved_rig(solution, made_s=0.0)).warnings
    alone = next(each for each in told if each.kind == "influence")
    assert alone.measured > alone.threshold == 3 and "without frame 002 points would move by" in alone.text


def test_warnings_name_corners_that_do_not_fit(solution: Solution) -> None:
    assert not {"noise", "outliers", "image_outliers"} & {each.kind for each in told_of(solution)}
    spoilt = solution.adjustment.problem.sensors[1]
    kept = spoilt.kept.copy()
    kept[2] = False
    sensors = (solution.adjustment.problem.sensors[0], replace(spoilt, kept=kept, scale=40.0))
    problem = replace(solution.adjustment.problem, sensors=sensors)
    told = told_of(replace(solution, adjustment=replace(solution.adjustment, problem=problem)))
    assert {("noise", "left"), ("outliers", "left"), ("image_outliers", "left")} <= kinds(told)
    image = solution.views.of_camera("left")[2].image
    assert next(each for each in told if each.kind == "image_outliers").text.startswith(f"{image} does not fit")


def told_of(solution: Solution) -> Sequence[SolveWarning]:
    return warnings_of(solution, [], [], None, [], [], [])


def test_coverage_counts_corners_by_part_of_the_image(solution: Solution) -> None:
    found = coverage(solution, "tof")
    pixels = exact_pixels(world(8, seed=6, names=PAIR), "tof")
    assert found.counts.sum() == np.isfinite(pixels[..., 0]).sum()
    assert found.counts[:, :4].sum() == pytest.approx(np.sum(pixels[..., 0] < 87.5), abs=5)
    assert 1.2 < found.nearest_m < found.farthest_m < 3


def test_a_focal_length_that_is_open_is_refused(solution: Solution) -> None:
    refuse_undetermined(solution, [])
    at = solution.layout.index("left", "fx")
    assert at is not None
    covariance = solution.covariance.copy()
    covariance[at, at] = (0.3 * 1330) ** 2
    open_ = replace(solution, uncertainty=replace(solution.uncertainty, shared=covariance))
    with pytest.raises(BadInputError, match=r"focal length of left open \(its standard deviation is 30% of it"):
        refuse_undetermined(open_, [])


def test_a_rig_that_hangs_on_one_frame_is_refused(solution: Solution) -> None:
    with pytest.raises(BadInputError, match="without frame 003 nothing determines the rig") as found:
        refuse_undetermined(solution, [Influence("003", np.inf, "tof", np.inf)])
    assert found.value.kind == "not_observable"


def test_the_weightiest_warning_comes_first_and_notes_of_one_kind_are_one() -> None:
    notes = [
        SolveWarning("edge", name, share, 0.8, "", "no corner", Rank.NOTE) for name, share in (("a", 0.7), ("b", 0.5))
    ]
    care = [SolveWarning("outliers", "a", share, 0.05, "", f"{share}") for share in (0.1, 0.2)]
    worst = SolveWarning("noise", "b", 9.0, 1.0, "px", "corners miss", Rank.DECISIVE)
    order = ranked([*notes, *care, worst])
    assert [(each.kind, each.camera) for each in order[1:]] == [*[("outliers", "a")] * 2, ("edge", "b"), ("edge", "a")]
    assert [each.text for each in merged(order)] == ["corners miss", "0.2", "0.1", "no corner (likewise a)"]
    assert str(verdict_of(order, "fine")) == "not usable: b: corners miss"
    assert not verdict_of(order, "fine").is_usable
    assert str(verdict_of(order[1:], "fine")) == "usable with care: a: 0.2"
    assert [str(verdict_of(each, "fine")) for each in (order[3:], [])] == ["usable: fine"] * 2


def test_what_makes_a_solution_useless_says_so(solution: Solution) -> None:
    corners = solution.adjustment.problem.sensors
    far = replace(corners[1], scale=40.0)
    told = told_of(replace(solution, adjustment=with_sensors(solution, (corners[0], far))))
    assert [each.kind for each in told if each.rank is Rank.DECISIVE] == ["noise"]
    kept = corners[1].kept.copy()
    kept[:4] = False
    told = told_of(replace(solution, adjustment=with_sensors(solution, (corners[0], replace(corners[1], kept=kept)))))
    assert [each.kind for each in told if each.rank is Rank.DECISIVE] == ["outliers"]
    assert "scatter" in {each.kind for each in told_of(replace(solution, scatter=120.0)) if each.rank is Rank.DECISIVE}
    assert "scatter" in {each.kind for each in told_of(replace(solution, scatter=2.0)) if each.rank is Rank.NOTE}


def with_sensors(solution: Solution, sensors: tuple[Sensor, ...]) -> Adjustment:
    return replace(solution.adjustment, problem=replace(solution.adjustment.problem, sensors=sensors))


def test_a_step_moves_the_state_by_it(solution: Solution) -> None:
    step = np.zeros(solution.layout.size)
    at = solution.layout.index("left", "ty")
    assert at is not None
    step[at] = 0.01
    there = step_state(solution.state, solution.layout, step, np.zeros((8, 6)))
    assert there.T_rig_camera[1, 1, 3] - solution.state.T_rig_camera[1, 1, 3] == pytest.approx(0.01)


def test_images_of_other_moments_are_called_that_and_not_an_open_lens() -> None:
    views = views_of(world(6, seed=3, names=PAIR), seed=3)
    frames = views.frames
    later = dict(zip(frames, [*frames[2:], *frames[:2]], strict=True))
    mixed = tuple(replace(view, frame=later[view.frame]) if view.camera == "left" else view for view in views.views)
    solution = solve_rig(replace(views, views=mixed), usual_plan({name: SPECTRA[name] for name in PAIR}))
    with pytest.raises(BadInputError, match=r"images not of one moment \(look at the pairing\)") as found:
        examine(solution, solved_rig(solution, made_s=0.0))
    assert found.value.kind == "not_usable"
