"""Cameras and poses from homographies: exact where these are, and blind to what a homography does not fix."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.solve.zhang import first_camera_matrix, homography_of, mirrored_pose, pose_from_homography

Floats = npt.NDArray[np.float64]
law = settings(max_examples=40, deadline=None, database=None)
BOARD = Board(columns=7, rows=6, pitch_m=0.1)
MIDDLE = BOARD.points().mean(axis=0)
SIZE = (640, 480)
K = np.array([[520.0, 0, 330.0], [0, 505.0, 235.0], [0, 0, 1]])

tilts = st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.floats(-3, 3))
offsets = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(1.0, 3.0))


def pose(tilt: tuple[float, ...], offset: tuple[float, ...]) -> Floats:
    """T_camera_board with the board's middle at `offset`, metres, camera frame."""
    T = transform_from_vector([*tilt, 0, 0, 0])
    T[:3, 3] = np.array(offset) - T[:3, :3] @ MIDDLE
    return np.asarray(T)


poses = st.builds(pose, tilts, offsets)


def homography(T: Floats, matrix: Floats = K) -> Floats:
    return np.asarray(matrix @ T[:3, [0, 1, 3]])


def corners(T: Floats, matrix: Floats = K) -> Corners:
    """All points of the board as a camera without distortion sees them."""
    there = (BOARD.points() @ T[:3, :3].T + T[:3, 3]) @ matrix.T
    return Corners(BOARD, there[:, :2] / there[:, 2:], np.tile(np.eye(2), (len(there), 1, 1)))


def some_poses(count: int, *, seed: int = 5, tilt_rad: float = 0.5) -> list[Floats]:
    rng = np.random.default_rng(seed)
    return [
        pose(
            (*rng.uniform(-tilt_rad, tilt_rad, 2), rng.uniform(-1, 1)), (*rng.uniform(-0.3, 0.3, 2), rng.uniform(1, 2))
        )
        for _ in range(count)
    ]


@law
@given(poses, st.floats(1e-3, 1e3), st.sampled_from([1, -1]))
def test_a_pose_comes_back_from_its_homography_of_any_scale_and_sign(T: Floats, size: float, sign: int) -> None:
    np.testing.assert_allclose(pose_from_homography(sign * size * homography(T), K), T, atol=1e-9)


@law
@given(poses)
def test_a_homography_takes_the_board_to_the_pixels_it_was_fitted_to(T: Floats) -> None:
    seen = corners(T)
    H = homography_of(seen)
    assert H is not None
    there = np.column_stack([BOARD.points()[:, :2], np.ones(BOARD.count)]) @ H.T
    np.testing.assert_allclose(there[:, :2] / there[:, 2:], seen.pixels, atol=1e-6)
    np.testing.assert_allclose(pose_from_homography(H, K), T, atol=1e-6)


def test_corners_on_a_line_give_no_homography() -> None:
    seen = corners(some_poses(1)[0])
    pixels = np.where(np.arange(BOARD.count)[:, None] < BOARD.columns, seen.pixels, np.nan)
    assert homography_of(Corners(BOARD, pixels, seen.covariance_px2)) is None


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_camera_without_distortion_comes_back_from_three_views_on(count: int) -> None:
    views = [corners(T) for T in some_poses(count)]
    homographies = [H for each in views if (H := homography_of(each)) is not None]
    np.testing.assert_allclose(first_camera_matrix(views, homographies, SIZE), K, rtol=1e-6, atol=1e-4)
    # A homography has no scale of its own.
    rescaled = [(-2.0) ** n * H for n, H in enumerate(homographies)]
    np.testing.assert_allclose(first_camera_matrix(views, rescaled, SIZE), K, rtol=1e-6, atol=1e-4)
    # Nor has a set of views an order.
    turned = first_camera_matrix(views[::-1], homographies[::-1], SIZE)
    np.testing.assert_allclose(turned, K, rtol=1e-6, atol=1e-4)


def test_one_tilted_view_gives_the_focal_length_of_a_camera_that_looks_straight() -> None:
    centred = np.array([[520.0, 0, (SIZE[0] - 1) / 2], [0, 520.0, (SIZE[1] - 1) / 2], [0, 0, 1]])
    views = [corners(pose((0.5, -0.3, 0.2), (0.05, 0.1, 1.4)), centred)]
    homographies = [H for each in views if (H := homography_of(each)) is not None]
    np.testing.assert_allclose(first_camera_matrix(views, homographies, SIZE), centred, rtol=1e-6, atol=1e-4)


def test_views_that_all_face_the_camera_still_give_some_camera() -> None:
    views = [corners(pose((0, 0, turn), (0.1, 0.0, 1.5))) for turn in (0.0, 0.4, 0.9)]
    homographies = [H for each in views if (H := homography_of(each)) is not None]
    found = first_camera_matrix(views, homographies, SIZE)
    assert np.isfinite(found).all() and 0.2 < found[0, 0] / SIZE[0] < 20


@law
@given(poses)
def test_a_mirrored_pose_mirrored_again_is_the_pose(T: Floats) -> None:
    other = mirrored_pose(T, MIDDLE)
    np.testing.assert_allclose(other[:3, :3] @ other[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(mirrored_pose(other, MIDDLE), T, atol=1e-9)


@law
@given(poses)
def test_a_mirrored_pose_keeps_the_middle_and_the_angle_to_the_sight(T: Floats) -> None:
    other = mirrored_pose(T, MIDDLE)
    at = T[:3, :3] @ MIDDLE + T[:3, 3]
    np.testing.assert_allclose(other[:3, :3] @ MIDDLE + other[:3, 3], at, atol=1e-12)
    sight = at / np.linalg.norm(at)
    assert other[:3, 2] @ sight == pytest.approx(T[:3, 2] @ sight, abs=1e-12)
    # The normal, its mirror and the sight lie in one plane, the sight in the middle.
    np.testing.assert_allclose(T[:3, 2] + other[:3, 2], 2 * (T[:3, 2] @ sight) * sight, atol=1e-9)


def test_a_board_that_faces_the_camera_is_its_own_mirror() -> None:
    T = pose((0, 0, 0.3), (0.0, 0.0, 1.5))
    np.testing.assert_allclose(mirrored_pose(T, MIDDLE), T, atol=1e-12)
