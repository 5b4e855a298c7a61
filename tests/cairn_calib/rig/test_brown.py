"""Brown's distortion and its inverse: laws, the fold, and OpenCV's as an independent reference."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.brown import RADIUS_MAX, Coefficients, distort, jacobian, radius_limit, undistort
from cairn_calib.rig.camera import Camera

law = settings(max_examples=100, deadline=None, database=None)
lenses = st.tuples(
    st.floats(-0.6, 0.6), st.floats(-0.3, 0.3), st.floats(-5e-3, 5e-3), st.floats(-5e-3, 5e-3), st.floats(-0.1, 0.1)
)

BARREL: Coefficients = (-0.35, 0.12, 1e-3, 1e-3, 0.0)
PINCUSHION: Coefficients = (0.3, 0.1, -1e-3, 2e-3, 0.05)
MUSTACHE: Coefficients = (-0.25, 0.3, 1e-3, -1e-3, 0.02)  # barrel inside, pincushion outside
WHOLE = [BARREL, PINCUSHION, MUSTACHE]
FOLDING: Coefficients = (-0.5, 0.0, 0.0, 0.0, 0.0)  # r (1 - r^2 / 2) turns at sqrt(2/3), where it is 0.5443
BACK_AGAIN: Coefficients = (-0.5, 0.1, 0.0, 0.0, 0.0)  # turns at 1, where it is 0.6, and rises again from sqrt(2)


def wide_camera(distortion: Coefficients) -> Camera:
    return Camera(width=1280, height=960, focal_px=(1300, 1310), centre_px=(650, 470), distortion=distortion)


def grid(side: float) -> np.ndarray:  # type: ignore[type-arg]
    """(101, 101, 2) places of the plane."""
    return np.stack(np.meshgrid(np.linspace(-side, side, 101), np.linspace(-side, side, 101)), axis=-1)


@pytest.mark.parametrize("distortion", WHOLE)
def test_project_undoes_unproject_at_every_pixel(distortion: Coefficients) -> None:
    camera = wide_camera(distortion)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    np.testing.assert_allclose(camera.project(camera.rays()), np.stack([x, y], axis=-1), rtol=0, atol=1e-9)


@law
@given(lenses)
def test_project_undoes_unproject_wherever_there_is_a_ray(distortion: Coefficients) -> None:
    plane = undistort(grid(1.5), distortion)
    again = distort(plane, distortion)
    seen = ~np.isnan(plane[..., 0])
    assert seen[50, 50]
    np.testing.assert_array_equal(seen, ~np.isnan(again[..., 0]))
    np.testing.assert_allclose(again[seen], grid(1.5)[seen], rtol=0, atol=1e-12)


@law
@given(lenses)
def test_unproject_undoes_project_before_the_fold(distortion: Coefficients) -> None:
    # Near the turn the tangential part decides where the fold is: take as much as is well before it.
    sides = (side for side in np.linspace(1.5, 0.1, 15) if side < 0.6 * radius_limit(distortion))
    plane = next(grid(s) for s in sides if jacobian(*np.moveaxis(grid(s), -1, 0), distortion)[3].min() > 0.02)
    np.testing.assert_allclose(undistort(distort(plane, distortion), distortion), plane, atol=1e-9)


@pytest.mark.parametrize("distortion", WHOLE)
def test_rays_are_those_of_opencv(distortion: Coefficients) -> None:
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 959, 25)), axis=-1).reshape(-1, 2)
    camera = wide_camera(distortion)
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    # Its fixed point converges for these lenses.
    ideal = cv2.undistortImagePoints(pixels.reshape(-1, 1, 2), matrix, np.array(distortion), None, criteria)
    plane = (ideal.reshape(-1, 2) - camera.centre_px) / camera.focal_px
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-11)
    again, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(distortion))
    np.testing.assert_allclose(again.reshape(-1, 2), pixels, atol=1e-9)


@law
@given(lenses, st.floats(-1, 1), st.floats(-1, 1))
def test_the_jacobian_agrees_with_differences(distortion: Coefficients, x: float, y: float) -> None:
    # With a tiny first coefficient the shortcut for no distortion at all is not taken.
    lens = (distortion[0] or 1e-9, *distortion[1:])
    limit = radius_limit(lens)
    at, h = np.array([x, y]) * min(0.5 * limit, 1.0), 1e-6
    steps = np.array([[h, 0], [-h, 0], [0, h], [0, -h]])
    right, left, down, up = distort(at + steps, lens)
    xx, xy, yy, det = jacobian(at[:1], at[1:], lens)
    np.testing.assert_allclose((right - left) / (2 * h), [xx[0], xy[0]], atol=1e-8)
    np.testing.assert_allclose((down - up) / (2 * h), [xy[0], yy[0]], atol=1e-8)
    assert det[0] == pytest.approx(xx[0] * yy[0] - xy[0] ** 2)


@pytest.mark.parametrize(
    ("distortion", "radius"),
    [
        (FOLDING, np.sqrt(2 / 3)),
        (BACK_AGAIN, 1.0),
        ((0.0, 0.0, 0.0, 0.0, -1 / 7), 1.0),
        ((0.0, 0.0, 1e-3, 1e-3, 0.0), RADIUS_MAX),
        ((-1e-9, 0.0, 0.0, 0.0, 0.0), RADIUS_MAX),
        (BARREL, RADIUS_MAX),
        (PINCUSHION, RADIUS_MAX),
    ],
)
def test_the_limit_is_the_first_turn(distortion: Coefficients, radius: float) -> None:
    assert radius_limit(distortion) == pytest.approx(radius, rel=1e-12)


@pytest.mark.parametrize(("distortion", "turn", "reach"), [(FOLDING, np.sqrt(2 / 3), 0.54433), (BACK_AGAIN, 1.0, 0.6)])
def test_what_lies_behind_the_fold_is_neither_seen_nor_found(
    distortion: Coefficients, turn: float, reach: float
) -> None:
    radii = np.array([0.99 * turn, 1.01 * turn, 2 * turn, 1e9, np.inf])
    seen = ~np.isnan(distort(np.stack([radii, 0 * radii[:1].repeat(5)], axis=-1), distortion))
    assert seen.all(axis=-1).tolist() == [True, False, False, False, False]
    places = np.array([[0, 0.999 * reach], [0, 1.001 * reach], [0.8, 0.8], [1e9, 0]])
    found = undistort(places, distortion)
    assert np.isnan(found).all(axis=-1).tolist() == [False, True, True, True]
    assert 0.9 * turn < found[0, 1] < turn


@law
@given(lenses)
def test_no_ray_comes_from_behind_the_fold(distortion: Coefficients) -> None:
    plane = undistort(grid(3.0), distortion)
    radius = np.hypot(plane[..., 0], plane[..., 1])
    assert np.nanmax(radius) < radius_limit(distortion) or not any(distortion)


def test_up_to_the_fold_every_place_is_found() -> None:
    radii = np.linspace(0, np.sqrt(2 / 3), 2000, endpoint=False)
    plane = np.stack([radii * 0.6, radii * 0.8], axis=-1)
    np.testing.assert_allclose(undistort(distort(plane, FOLDING), FOLDING), plane, atol=1e-7)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, *WHOLE, FOLDING])
@pytest.mark.parametrize("place", [(np.nan, np.nan), (np.nan, 0.1), (0.1, np.nan)])
def test_none_stays_none(distortion: Coefficients, place: tuple[float, float]) -> None:
    camera = wide_camera(distortion)
    assert np.isnan(camera.unproject(np.array(place))).all()
    assert np.isnan(camera.project(np.array([*place, 1.0]))).any()


@pytest.mark.parametrize("shape", [(2,), (0, 2), (5, 0, 2), (3, 4, 5, 2)])
def test_any_shape_of_points_keeps_its_shape(shape: tuple[int, ...]) -> None:
    assert undistort(np.full(shape, 0.1), BARREL).shape == distort(np.full(shape, 0.1), BARREL).shape == shape


def test_the_given_plane_is_not_changed() -> None:
    plane = grid(2.0)
    undistort(plane, FOLDING)
    distort(plane, FOLDING)
    np.testing.assert_array_equal(plane, grid(2.0))


@pytest.mark.parametrize("extreme", [(1e12,) * 5, (-1e12,) * 5, (1e-300, 0, 0, 0, 0), (0, 0, 0, 0, -1e-300)])
def test_extreme_coefficients_overflow_nothing(extreme: Coefficients) -> None:
    places = np.array([[0, 0], [1e-9, 1], [1e300, 1], [-np.inf, 0], [np.inf, np.nan]])
    found = undistort(places, extreme)
    assert found[0].tolist() == [0, 0]
    assert np.isnan(found[2:]).all()
    assert np.isnan(distort(places, extreme)[2:]).all()
