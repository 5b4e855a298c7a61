"""Solving a rig: truth comes back, agrees with OpenCV, and does not depend on how the question is put."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import BOARD, SPECTRA, World, errors_of, ranges_of, views_of, world

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.poses import inverse
from cairn_calib.rig.range_terms import BIAS_NAMES
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.adjustment import adjust
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.rig_start import half_turn
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import STATED, CameraPlan, NoisePlan, SolvePlan, usual_plan
from cairn_calib.solve.solved_rig import solved_rig, statistics_of
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]

PAIR = ("tof", "left")
DATA = os.environ.get("CAIRN_TEST_DATA")


def pair_plan(gauge: str = "tof") -> SolvePlan:
    return usual_plan({name: SPECTRA[name] for name in PAIR}, gauge=gauge)


def classic(image: npt.NDArray[np.uint8]) -> Floats:
    """OpenCV's first detector, and its corners made finer."""
    found, corners = cv2.findChessboardCorners(image, (9, 6))
    assert found
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (cv2.TERM_CRITERIA_COUNT, 40, 1e-4)))


def sector_based(image: npt.NDArray[np.uint8]) -> Floats:
    """OpenCV's second detector; of right09.jpg, where it finds nothing, without normalising, and made finer."""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=flags | cv2.CALIB_CB_NORMALIZE_IMAGE)
    if found:
        return np.asarray(corners)
    found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=flags)
    assert found
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-3)
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), settled))


def opencv_views(detector: Callable[[npt.NDArray[np.uint8]], Floats] = classic) -> BoardViews:
    """The corners of OpenCV's stereo pairs by its own detectors, all equally certain."""
    if not DATA:
        pytest.skip("CAIRN_TEST_DATA is not set")
    board = Board(columns=9, rows=6, pitch_m=0.025)
    views = []
    for path in sorted((Path(DATA) / "opencv_stereo_chess").glob("*[0-9].jpg")):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        pixels = np.asarray(detector(image), np.float64).reshape(-1, 2)
        side, number = path.stem[:-2], path.stem[-2:]
        views.append(BoardView(side, number, path.name, Corners(board, pixels, np.tile(np.eye(2), (54, 1, 1)))))
    return BoardViews(board, {"left": (640, 480), "right": (640, 480)}, tuple(views))


def opencv_plan() -> SolvePlan:
    """Plan of what stereoCalibrate solves: a flat board of known size, no priors."""
    return SolvePlan(
        cameras={name: CameraPlan(spectrum=Spectrum.COLOUR) for name in ("left", "right")},
        gauge="left",
        pitch_sigma=0.0,
        warp=False,
        usual_priors=False,
        noise=STATED,
    )


def test_opencv_finds_the_same_rig_from_the_same_corners() -> None:
    views = opencv_views()
    ours = solve_rig(views, opencv_plan())
    left, right = ([view.corners.pixels.astype(np.float32) for view in views.of_camera(name)] for name in views.cameras)
    points = [views.board.points().astype(np.float32)] * len(left)
    assert len(left) == len(right) == 13
    settled = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    alone = [
        cv2.calibrateCamera(points, each, (640, 480), np.eye(3), np.zeros(5), criteria=settled)[1:3]
        for each in (left, right)
    ]
    rms, K_left, d_left, K_right, d_right, R, t, _, _ = cv2.stereoCalibrate(
        points, left, right, *alone[0], *alone[1], (640, 480), flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=settled
    )
    for lens, K, d in zip(ours.state.lenses, (K_left, K_right), (d_left, d_right), strict=True):
        reference = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        assert lens.intrinsics[:4] == pytest.approx(reference, abs=1e-3)
        rays = lens.unproject(image_grid(640, 480, 20, 15))
        theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.asarray(d))[0].reshape(-1, 2)
        assert np.abs(theirs - lens.project(rays)).max() < 0.01
    T_right_left = inverse(ours.state.T_rig_camera[1])
    assert T_right_left[:3, 3] == pytest.approx(np.asarray(t).ravel(), abs=1e-6)
    assert T_right_left[:3, :3] == pytest.approx(np.asarray(R), abs=1e-6)
    # Theirs is of two axes together, over both cameras.
    corners = sum(len(view.corners.pixels) for view in views.views)
    assert np.sqrt(ours.adjustment.normal.cost / corners) == pytest.approx(rms, rel=1e-5)


@pytest.mark.slow
def test_the_published_figures_of_opencvs_stereo_pairs_come_out() -> None:
    """As stereoCalibrate, mrcal 2.2 and a third solver gave them from these corners (OpenCV 5.0's detector)."""
    solution = solve_rig(opencv_views(sector_based), opencv_plan())
    values = solution.values()
    assert [values["left", "fx"], values["right", "fx"]] == pytest.approx([532.499, 535.165], abs=1e-3)
    T_right_left = inverse(solution.state.T_rig_camera[1])
    assert 1000 * T_right_left[:3, 3] == pytest.approx([-82.911, 0.918, -0.174], abs=1e-3)
    corners = sum(len(view.corners.pixels) for view in solution.views.views)
    assert np.sqrt(solution.adjustment.normal.cost / corners) == pytest.approx(0.2713, abs=1e-4)


def test_a_simulated_rig_comes_back_within_its_uncertainty() -> None:
    pulls, excess = [], []
    for seed in range(4):
        truth = world(8, seed=seed, warp_m=(0.0006, -0.0004))
        solution = solve_rig(views_of(truth, seed=seed), replace(usual_plan(SPECTRA), noise=STATED))
        errors, sigmas = errors_of(solution, truth), solution.sigmas()
        pulls += [errors[each] / sigmas[each] for each in errors if each != ("", "scale")]
        fit = statistics_of(solution)
        excess.append((fit.chi2 - fit.degrees_of_freedom) / np.sqrt(2 * fit.degrees_of_freedom))
    assert np.mean(np.abs(pulls) < 3) >= 0.98
    assert 0.8 < np.std(pulls) < 1.25
    assert np.abs(excess).max() < 3


def test_noise_of_each_sensor_and_outliers_are_found() -> None:
    truth = world(8, seed=3, names=PAIR)
    views = views_of(truth, seed=3, noise=2.0)
    wrong = views.of_camera("left")[2]
    pixels = wrong.corners.pixels.copy()
    spoilt = np.flatnonzero(wrong.corners.seen)[:3]
    pixels[spoilt] += 9.0
    others = tuple(view for view in views.views if view is not wrong)
    views = replace(views, views=(*others, replace(wrong, corners=replace(wrong.corners, pixels=pixels))))
    solution = solve_rig(views, pair_plan())
    fit = statistics_of(solution)
    assert [sensor.scale for sensor in solution.adjustment.problem.sensors] == pytest.approx([2, 2], rel=0.15)
    assert fit.cameras["left"].outliers >= 3
    assert fit.cameras["left"].outliers + fit.cameras["tof"].outliers <= 6
    errors, sigmas = errors_of(solution, truth), solution.sigmas()
    assert max(abs(errors[each]) / sigmas[each] for each in errors) < 4


def test_points_that_fit_again_are_let_in_again() -> None:
    truth = world(8, seed=3, names=PAIR)
    views = views_of(truth, seed=3)
    solution = solve_rig(views, pair_plan())
    problem = solution.adjustment.problem
    # As if a bad start had thrown out every second corner.
    fewer = tuple(replace(sensor, kept=sensor.kept & (np.arange(42) % 2 == 0)) for sensor in problem.sensors)
    done = adjust(replace(problem, sensors=fewer), solution.state, NoisePlan())
    for found, right in zip(done.problem.sensors, problem.sensors, strict=True):
        np.testing.assert_array_equal(found.kept, right.kept)


def probe_pixels(solution: Solution) -> Mapping[str, Floats]:
    """Pixels in each camera of points before the first frame's board."""
    points = np.random.default_rng(0).uniform([0, 0, -0.3], [0.6, 0.5, 0.3], (50, 3))
    state = solution.state
    seen = {}
    for name, lens, T in zip(solution.plan.cameras, state.lenses, state.T_rig_camera, strict=True):
        T_camera_board = inverse(T) @ state.T_rig_board[0]
        seen[name] = lens.project(points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])
    return seen


def test_the_gauge_moves_no_projection() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    one, other = (probe_pixels(solve_rig(views, pair_plan(gauge))) for gauge in PAIR)
    for name in PAIR:
        assert np.nanmax(np.abs(one[name] - other[name])) < 1e-6


def test_ranges_show_their_bias() -> None:
    bias = (0.024, 0.003, 0.012, -0.015)
    truth = world(8, seed=4, names=PAIR, bias=bias)
    views = replace(views_of(truth, seed=4), ranges=ranges_of(truth, "tof", seed=4, sigma_m=0.006))
    solution = solve_rig(views, pair_plan())
    values, sigmas = solution.values(), solution.sigmas()
    found = [values["tof", name] for name in BIAS_NAMES]
    spread = [sigmas["tof", name] for name in BIAS_NAMES]
    assert np.abs((np.array(found) - bias) / spread).max() < 3
    assert spread[0] < 0.004
    ranged = solution.adjustment.problem.sensors[-1]
    assert 0.01 * ranged.scale == pytest.approx(0.006, rel=0.05)


def turned(view: BoardView) -> BoardView:
    """As if its corners had been named from the other end."""
    return replace(
        view,
        corners=Corners(view.corners.board, view.corners.pixels[::-1].copy(), view.corners.covariance_px2[::-1].copy()),
    )


def test_a_camera_that_names_corners_from_the_other_end_is_refused() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    wrong = replace(views, views=tuple(turned(view) if view.camera == "left" else view for view in views.views))
    with pytest.raises(BadInputError, match=r"opposite ends in 6 of 6 frames.*--polarity"):
        solve_rig(wrong, pair_plan())


def test_one_image_named_from_the_other_end_is_left_out_and_told() -> None:
    views = views_of(world(8, seed=2, names=PAIR), seed=2)
    odd = views.of_camera("left")[3]
    wrong = replace(views, views=tuple(turned(view) if view is odd else view for view in views.views))
    solution = solve_rig(wrong, pair_plan())
    assert solution.reversed_views == (("left", odd.frame),)
    right = solve_rig(views.without([("left", odd.frame)]), pair_plan())
    assert solution.state.T_rig_camera == pytest.approx(right.state.T_rig_camera, abs=1e-7)


def test_half_a_turn_names_points_from_the_other_end() -> None:
    board = Board(columns=9, rows=6, pitch_m=0.05)
    T = half_turn(board)
    assert board.points() @ T[:3, :3].T + T[:3, 3] == pytest.approx(board.points()[::-1])


def test_what_cannot_be_observed_is_refused_in_words() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    once = views.without([("left", frame) for frame in views.frames[1:]])
    with pytest.raises(BadInputError, match="left saw the board in 1 image, and needs 2") as found:
        solve_rig(once, pair_plan())
    assert found.value.kind == "not_observable"
    parallel = views_of(world(6, seed=2, names=PAIR, tilt_deg=0.0), seed=2)
    with pytest.raises(BadInputError, match=r"parallel|focal length"):
        solve_rig(parallel, pair_plan())
    apart = views.without(
        [("tof", frame) for frame in views.frames[:3]] + [("left", frame) for frame in views.frames[3:]]
    )
    with pytest.raises(BadInputError, match="no board was seen by left together with tof"):
        solve_rig(apart, pair_plan())


def test_the_rig_says_how_certain_it_is() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    solution = solve_rig(views, pair_plan())
    rig = solved_rig(solution, made_s=0.0)
    assert rig.calibration is not None
    assert rig.calibration.covariance is not None
    parameters = [(each.camera, each.name) for each in rig.calibration.covariance.parameters]
    assert parameters == [each for each in solution.layout.names if each[0]]
    sigmas = solution.sigmas()
    assert rig.calibration.covariance.sigmas == pytest.approx([sigmas[each] for each in parameters], rel=1e-6)
    assert rig.calibration.statistics is not None
    assert rig.calibration.statistics.cameras["tof"].images == 6


@pytest.mark.parametrize("seed", range(4))
def test_a_board_that_is_tilted_about_one_spot_is_not_called_reversed(seed: int) -> None:
    middle = np.append(BOARD.points()[:, :2].mean(axis=0), 0.0)
    boards = np.stack([np.eye(4)] * 9)
    for T, about in zip(boards, np.radians(np.arange(0, 360, 40)), strict=True):
        lean = np.radians(20) * np.array([np.cos(about), np.sin(about)])
        T[:3, :3] = transform_from_vector([*lean, 0, 0, 0, 0])[:3, :3]
        T[:3, 3] = [0.0, 0.0, 1.9] - T[:3, :3] @ middle
    truth = World(("tof", "left", "right"), boards)
    solution = solve_rig(views_of(truth, seed=seed), usual_plan({name: SPECTRA[name] for name in truth.names}))
    left = solution.state.T_rig_camera[list(truth.names).index("left")]
    assert np.abs(left - truth.T_rig_camera("left"))[:3, 3].max() < 0.05


def test_corners_without_any_noise_are_solved() -> None:
    truth = world(6, seed=2, names=PAIR)
    solution = solve_rig(views_of(truth, seed=2, noise=0.0), pair_plan())
    assert solution.state.T_rig_camera[1] == pytest.approx(truth.T_rig_camera("left"), abs=1e-3)
    assert all(0 < sensor.scale < 2e-3 for sensor in solution.adjustment.problem.sensors)


def test_a_view_whose_corners_lie_on_a_line_is_left_out() -> None:
    views = views_of(world(6, seed=2, names=PAIR), seed=2)
    first = next(view for view in views.views if view.camera == "left")
    pixels = np.where((np.arange(BOARD.count) < BOARD.columns)[:, None], first.corners.pixels, np.nan)
    row = replace(first, corners=Corners(BOARD, pixels, first.corners.covariance_px2))
    solution = solve_rig(
        replace(views, views=tuple(row if view is first else view for view in views.views)), pair_plan()
    )
    assert ("left", first.frame) not in {(view.camera, view.frame) for view in solution.views.views}
