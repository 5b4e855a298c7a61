"""The camera model: projection and its inverse, and OpenCV's as an independent reference."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_map.errors import BadInputError

law = settings(max_examples=50, deadline=None, database=None)
small = st.floats(-0.02, 0.02)
# As strong as it may be for every pixel to have a ray; stronger ones and the fold: test_brown.py.
cameras = st.builds(
    Camera,
    width=st.just(320),
    height=st.just(240),
    focal_px=st.tuples(st.floats(400, 700), st.floats(400, 700)),
    centre_px=st.tuples(st.floats(140, 180), st.floats(100, 140)),
    distortion=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.1, 0.1), small, small, small),
)
BARREL = Camera(
    width=320, height=240, focal_px=(260, 262), centre_px=(158, 121), distortion=(-0.3, 0.1, 1e-3, 2e-3, -0.01)
)


def matrix(camera: Camera) -> np.ndarray:  # type: ignore[type-arg]
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def grid(camera: Camera) -> np.ndarray:  # type: ignore[type-arg]
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 13))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@law
@given(cameras)
def test_project_undoes_unproject(camera: Camera) -> None:
    pixels = grid(camera)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(camera.project(rays * 3.7), pixels, rtol=0, atol=1e-9)


@law
@given(cameras, st.integers(0, 1000))
def test_projection_is_that_of_opencv(camera: Camera, seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix(camera), np.array(camera.distortion))
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-9)


def test_the_ray_of_each_pixel_is_the_one_through_it() -> None:
    rays = BARREL.rays()
    assert rays.shape == (240, 320, 3)
    np.testing.assert_allclose(BARREL.project(rays[7, 11]), [11, 7], atol=1e-8)


def test_rays_cannot_be_changed_behind_the_next_callers_back() -> None:
    with pytest.raises(ValueError, match="read-only"):
        BARREL.rays()[0, 0] = 0


@pytest.mark.parametrize("z", [0.0, -1.0, np.nan])
def test_what_is_not_in_front_has_no_pixel(z: float) -> None:
    assert np.isnan(BARREL.project(np.array([0.1, 0.1, z]))).all()


def test_a_pixel_that_no_ray_reaches_has_no_ray() -> None:
    # Strong barrel distortion folds back: r (1 - r^2 / 2) is never above 0.55.
    camera = Camera(width=100, height=100, focal_px=(50, 50), centre_px=(0, 0), distortion=(-0.5, 0, 0, 0, 0))
    assert np.isnan(camera.unproject(np.array([90.0, 0.0]))).all()
    assert not np.isnan(camera.unproject(np.array([10.0, 0.0]))).any()


def test_a_point_far_off_the_axis_is_not_folded_back_into_the_image() -> None:
    camera = Camera(width=100, height=100, focal_px=(50, 50), centre_px=(0, 0), distortion=(-0.5, 0, 0, 0, 0))
    assert np.isnan(camera.project(np.array([1.3, 0.0, 1.0]))).all()
    np.testing.assert_allclose(camera.project(np.array([0.8, 0.0, 1.0])), [50 * 0.8 * (1 - 0.32), 0])


def test_an_image_contains_its_pixels_to_their_outer_edges() -> None:
    pixels = np.array([[-0.5, 0], [-0.51, 0], [319.49, 239.49], [319.5, 0], [0, 239.5], [np.nan, 0]])
    assert BARREL.contains(pixels).tolist() == [True, False, True, False, False, False]


def test_the_field_of_view_is_that_of_the_outer_edges_of_the_pixels() -> None:
    camera = camera_from_field_of_view(200, 100, horizontal_deg=90)
    edges = camera.unproject(np.array([[-0.5, 49.5], [199.5, 49.5]]))
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(90)


def test_an_image_of_another_size_is_refused() -> None:
    BARREL.check_image(np.zeros((240, 320, 3)), name="image")
    for shape in [(320, 240), (240,)]:
        with pytest.raises(BadInputError):
            BARREL.check_image(np.zeros(shape), name="image")


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"height": 1 << 20},
        {"focal_px": (0, 1)},
        {"focal_px": (np.inf, 1)},
        {"centre_px": (np.nan, 0)},
        {"distortion": (np.nan, 0, 0, 0, 0)},
        {"distortion": (0, 0, 0, 0, 1e13)},
        {"skew": 1},
    ],
)
def test_a_camera_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Camera.model_validate(BARREL.model_dump() | wrong)
