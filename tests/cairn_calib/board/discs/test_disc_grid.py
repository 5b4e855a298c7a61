"""Grids of discs: found in order, centroids where the projected discs have theirs."""

import numpy as np
from tests.fixtures.calib.board_images import DISCS, THERMAL, TOF, disc_centroids, picture, pose

from cairn_calib.board.board import Board
from cairn_calib.board.discs.disc_grid import find_circles


def test_discs_are_found_in_order_with_the_errors_that_are_stated() -> None:
    errors = []
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        T = pose(rng, TOF, board=DISCS, tilt_deg=35)
        detection = find_circles(picture(TOF, T, rng, board=DISCS), DISCS)
        assert detection.corners is not None, [str(attempt) for attempt in detection.attempts]
        seen = detection.corners.seen
        error = (detection.corners.pixels - disc_centroids(TOF, T, DISCS))[seen]
        assert np.abs(error).max() < 0.4
        root = np.linalg.cholesky(detection.corners.covariance_px2[seen])
        errors.append(np.linalg.solve(root, error[..., None])[..., 0])
    assert 0.7 < np.concatenate(errors).std() < 1.2


def test_a_heated_board_is_found_far_off_and_beside_weak_strays() -> None:
    # 11: the board's corners look like faint discs. 35: discs nearer to each other than what they are compared with.
    for seed in (11, 35):
        rng = np.random.default_rng(seed)
        T = pose(rng, THERMAL, board=DISCS, tilt_deg=45)
        detection = find_circles(picture(THERMAL, T, rng, board=DISCS), DISCS, polarity="reversed")
        assert detection.corners is not None, [str(attempt) for attempt in detection.attempts]
        error = detection.corners.pixels - disc_centroids(THERMAL, T, DISCS)
        assert np.nanmax(np.abs(error)) < 1


def test_a_chessboard_is_no_grid_of_discs() -> None:
    rng = np.random.default_rng(1)
    detection = find_circles(picture(TOF, pose(rng, TOF), rng), DISCS)
    assert detection.corners is None
    assert all(attempt.reason for attempt in detection.attempts)


def test_discs_of_unequal_sides_are_named_from_the_left_at_any_roll() -> None:
    board = Board(pattern="circles", columns=6, rows=4, pitch_m=0.06)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        T = pose(rng, TOF, board=board, tilt_deg=25)
        at = disc_centroids(TOF, T, board)
        wanted = at if T[0, 0] > 0 else at[::-1]
        corners = find_circles(picture(TOF, T, rng, board=board), board, upright=True).corners
        assert corners is not None, seed
        assert np.nanmax(np.abs(corners.pixels - wanted)) < 0.4, seed
