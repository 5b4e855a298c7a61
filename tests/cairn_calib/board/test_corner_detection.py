"""Boards are found in every spectrum with the errors that are stated, and what only looks like a board is refused."""

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.board_images import BOARD, COLOUR, THERMAL, TOF, Floats, Image, Spectrum, picture, pose, truth

from cairn_calib.board.board import Board
from cairn_calib.board.corner_detection import find_chessboard, fit_pointed_at
from cairn_calib.board.corner_gates import sound_corners
from cairn_calib.board.corner_refinement import fit_corners
from cairn_calib.board.corners import FOUND, Corners, Detection
from cairn_map.errors import BadInputError

SPECTRA = {"colour": (COLOUR, 1, "normal"), "thermal": (THERMAL, 2, "reversed"), "tof": (TOF, 5, "normal")}
RMS_MAX_PX = {"colour": 0.012, "thermal": 0.07, "tof": 0.035}


def found(detection: Detection) -> Corners:
    assert detection.corners is not None, [str(attempt) for attempt in detection.attempts]
    assert detection.attempts[-1].stage == FOUND
    return detection.corners


def normalised(error: Floats, covariance: Floats) -> Floats:
    return np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]


def seen(spectrum: Spectrum, seed: int) -> tuple[Image, Floats]:
    rng = np.random.default_rng(seed)
    T_camera_board = pose(rng, spectrum, tilt_deg=45)
    return picture(spectrum, T_camera_board, rng), truth(spectrum, T_camera_board)


@pytest.mark.parametrize("name", SPECTRA)
def test_corners_lie_where_they_are_and_their_covariance_says_how_well(name: str) -> None:
    spectrum, count, polarity = SPECTRA[name]
    errors, covariances = [], []
    for seed in range(count):
        image, at = seen(spectrum, seed)
        corners = found(find_chessboard(image, BOARD, polarity="reversed" if polarity == "reversed" else "normal"))
        assert corners.seen.all()
        errors.append(corners.pixels - at)
        covariances.append(corners.covariance_px2)
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    assert np.sqrt((error**2).sum(axis=1).mean()) < RMS_MAX_PX[name]
    assert 0.8 < normalised(error, covariance).std() < 1.25


def test_reversed_polarity_gives_the_same_corners_in_the_same_order() -> None:
    image, at = seen(TOF, 3)
    negative = (65535 - image.astype(np.int64)).astype(np.uint16)
    for picture_, polarity in ((image, "normal"), (negative, "reversed")):
        corners = found(find_chessboard(picture_, BOARD, polarity="reversed" if polarity == "reversed" else "normal"))
        assert np.abs(corners.pixels - at).max() < 0.3
    wrong = found(find_chessboard(negative, BOARD, polarity="normal"))
    assert np.abs(wrong.pixels[::-1] - at).max() < 0.3


def test_hidden_corners_are_left_out_and_the_others_keep_their_names() -> None:
    image, at = seen(TOF, 5)
    middle = at.reshape(6, 9, 2)[2, 4].round().astype(int)
    image[middle[1] - 6 : middle[1] + 6, middle[0] - 7 : middle[0] + 7] = 6500
    corners = found(find_chessboard(image, BOARD))
    assert 35 <= corners.seen.sum() < 54
    assert not corners.seen.reshape(6, 9)[2, 4]
    assert np.abs(corners.pixels - at)[corners.seen].max() < 0.3


def test_two_corners_of_an_outer_column_are_enough_to_name_it() -> None:
    image, at = seen(TOF, 5)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    across = [np.cos(np.radians(40)), np.sin(np.radians(40))]
    image[x * across[0] + y * across[1] > np.quantile(at @ across, 0.88) + 0.3] = 6500
    corners = found(find_chessboard(image, BOARD))
    assert corners.seen.reshape(6, 9)[:, -1].sum() == 2
    assert np.abs(corners.pixels - at)[corners.seen].max() < 0.3


def test_a_board_of_which_a_side_is_hidden_is_refused_with_the_stage() -> None:
    image, at = seen(TOF, 5)
    grid = at.reshape(6, 9, 2)
    hull = cv2.convexHull(np.concatenate([grid[:, :2].reshape(-1, 2), 2 * grid[:, 0] - grid[:, 1]]).astype(np.float32))
    hidden = np.asarray(image, np.uint16)
    cv2.fillConvexPoly(hidden, hull.astype(np.int32), 6500)
    detection = find_chessboard(hidden, BOARD)
    assert detection.corners is None
    assert "corners" in detection.attempts[0].reason
    assert {attempt.stage for attempt in detection.attempts}.isdisjoint({FOUND})


@pytest.mark.parametrize("seed", [3, 5])
def test_a_near_board_whose_soft_edges_are_wider_than_a_corners_window_is_found(seed: int) -> None:
    image, at = seen(TOF, seed)
    large = cv2.resize(image, None, fx=10, fy=10, interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(large, (0, 0), 12)
    corners = found(find_chessboard(soft, BOARD))
    assert corners.seen.sum() >= 53
    assert np.nanmax(np.abs(corners.pixels - ((at + 0.5) * 10 - 0.5))) < 3


def test_a_board_at_the_border_of_a_cut_image_keeps_its_corners_unbiased() -> None:
    errors, covariances = [], []
    for seed in range(4):
        image, at = seen(TOF, seed)
        low, high = (at.min(axis=0) - 2.6).astype(int), (at.max(axis=0) + 3.6).astype(int)
        cut = np.asarray(image)[low[1] : high[1], low[0] : high[0]]
        corners = found(find_chessboard(cut, BOARD))
        errors.append((corners.pixels + low - at)[corners.seen])
        covariances.append(corners.covariance_px2[corners.seen])
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    assert len(error) > 200
    assert 0.8 < normalised(error, covariance).std() < 1.25


def test_boards_that_look_the_same_after_half_a_turn_need_to_stand_upright() -> None:
    board = Board(columns=7, rows=5, pitch_m=0.05)
    rng = np.random.default_rng(2)
    T = pose(rng, TOF, board=board)
    image, at = picture(TOF, T, rng, board=board), truth(TOF, T, board=board)
    with pytest.raises(BadInputError, match="odd and an even side"):
        find_chessboard(image, board)
    corners = found(find_chessboard(image, board, upright=True)).pixels
    assert min(np.abs(corners - at).max(), np.abs(corners[::-1] - at).max()) < 0.3
    assert corners.reshape(5, 7, 2)[:, -1, 0].mean() > corners.reshape(5, 7, 2)[:, 0, 0].mean()


def test_four_corners_pointed_at_by_hand_find_the_rest() -> None:
    image, at = seen(TOF, 5)
    rough = at[[0, 8, 53, 45]] + [[1, -1], [-1, 1], [1, 1], [-1, -1]]
    corners = found(fit_pointed_at(image, BOARD, rough))
    assert np.abs(corners.pixels - at)[corners.seen].max() < 0.3
    assert corners.seen.sum() > 50


def test_who_points_at_corners_has_the_last_word_where_some_are() -> None:
    image, at = seen(TOF, 5)
    # A whole side is hidden, so that a search cannot tell which rows these are.
    covered = image.copy()
    side = np.array([at[n] for n in (0, 8, 17, 9)]) + 0.3 * (at[[0, 8, 17, 9]] - at[26])
    cv2.fillConvexPoly(covered, cv2.convexHull(side.astype(np.float32)).astype(np.int32), float(np.median(image)))
    assert find_chessboard(covered, BOARD).corners is None
    detection = fit_pointed_at(covered, BOARD, at)
    corners = found(detection)
    assert corners.seen.sum() >= 30 and np.abs(corners.pixels - at)[corners.seen].max() < 0.3
    assert "not refused, since it is pointed at" in detection.attempts[-1].reason
    # But where there are none, or in the order of a mirrored board, nothing can be used.
    noise = np.random.default_rng(1).normal(1000, 30, image.shape)
    assert fit_pointed_at(noise, BOARD, at).corners is None
    mirrored = at.reshape(6, 9, 2)[:, ::-1].reshape(-1, 2)
    assert "mirrored" in fit_pointed_at(image, BOARD, mirrored).attempts[-1].reason


def test_windows_without_an_edge_are_no_corners_and_no_error() -> None:
    guesses, steps = np.array([[20.0, 20.0], [60.0, 20.0]]), np.tile(8 * np.eye(2), (2, 1, 1))
    for contrast in (0.0, 1e-6, 1.0):
        image = np.full((40, 80), 190, np.float32)
        image[:, 58:] -= contrast
        fitted = fit_corners(image, guesses, steps)
        assert not sound_corners(fitted, np.ones(2)).any()


def windows(rng: np.random.Generator) -> Floats:
    """Panes in a frame: 10 x 7 rectangles, each of its own brightness."""
    image = np.full((480, 640), 60.0)
    for row in range(7):
        for column in range(10):
            y, x = 40 + 58 * row, 30 + 58 * column
            image[y : y + 50, x : x + 50] = rng.uniform(120, 230)
    return image


def tiles(_: np.random.Generator) -> Floats:
    """A chequered floor, larger than the board."""
    y, x = np.mgrid[:480, :640]
    return np.where((x // 32 + y // 32) % 2 == 0, 60.0, 190.0)


def bricks(_: np.random.Generator) -> Floats:
    """Courses of bricks, each moved by half a brick."""
    y, x = np.mgrid[:480, :640]
    course = y // 30
    return np.where((y % 30 < 4) | ((x + 30 * (course % 2)) % 60 < 4), 200.0, 110.0)


def other_board(rng: np.random.Generator) -> Floats:
    """A chessboard with a row less."""
    board = Board(columns=9, rows=5, pitch_m=0.05)
    return picture(TOF, pose(rng, TOF, board=board), rng, board=board).astype(np.float64) / 60


def texture(rng: np.random.Generator) -> Floats:
    """Noise with structures of some pixels."""
    noise = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 2.5)
    return np.asarray(128 + 40 * noise / noise.std())


@pytest.mark.parametrize("false", [windows, tiles, bricks, other_board, texture])
def test_what_only_looks_like_a_board_is_refused(false: Callable[[np.random.Generator], Floats]) -> None:
    rng = np.random.default_rng(7)
    image = np.clip(cv2.GaussianBlur(false(rng), (0, 0), 0.8) + rng.normal(0, 2, false(rng).shape), 0, 255)
    detection = find_chessboard(image.astype(np.uint8), BOARD)
    assert detection.corners is None, str(detection.attempts[-1])
    assert all(attempt.reason for attempt in detection.attempts)


@pytest.mark.slow
@pytest.mark.recording
def test_real_boards_are_found_as_recorded_and_changed() -> None:
    folder = os.environ.get("CAIRN_TEST_DATA")
    if not folder:
        pytest.skip("CAIRN_TEST_DATA is not set")
    images = sorted((Path(folder) / "opencv_stereo_chess").glob("*.jpg"))
    assert len(images) == 26
    for path in images[::2]:
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        corners = found(find_chessboard(image, BOARD))
        assert corners.seen.sum() >= 53
        if path.stem in ("left03", "right08"):
            negative = found(find_chessboard(255 - image, BOARD, polarity="reversed"))
            assert np.nanmax(np.abs(negative.pixels - corners.pixels)) < 1e-6
            half = found(find_chessboard(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), BOARD))
            assert np.nanmax(np.abs(half.pixels * 2 + 0.5 - corners.pixels)) < 0.6
            blurred = found(find_chessboard(cv2.GaussianBlur(image, (0, 0), 1.5), BOARD))
            assert np.nanmax(np.abs(blurred.pixels - corners.pixels)) < 0.6
