"""Lenses with their derivatives: OpenCV as an independent reference, central differences, and where a lens ends."""

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.brown import Coefficients, distort, radius_limit, undistort
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera, angle_limit
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import (
    moved_points,
    rotation_from_vector,
    transform_from_vector,
    vector_from_transform,
)

Floats = npt.NDArray[np.float64]

SIZE = {"width": 1280, "height": 960, "focal_px": (700.0, 710.0), "centre_px": (650.0, 470.0)}
BROWN = Camera.model_validate(SIZE | {"distortion": (-0.3, 0.11, 1e-3, -2e-3, -0.01)})
RATIONAL = Camera.model_validate(SIZE | {"distortion": (0.4, 0.2, 1e-3, -5e-4, 0.05, 0.7, 0.15, 0.02)})
KB4 = FisheyeCamera.model_validate(SIZE | {"focal_px": (350.0, 352.0), "distortion": (0.02, -5e-3, 1e-3, -1e-4)})
LENSES = [BROWN, RATIONAL, KB4]
POSES = np.array([[0.3, -0.2, 0.1, 0.1, -0.2, 0.5], [0, 0, 0, 0, 0, 0.3], [2.0, 1.0, -2.0, -0.3, 0.1, 6.0]])


def points(seed: int = 3, count: int = 40) -> Floats:
    """Points of the source frame, in front of the camera of every one of `POSES`."""
    return np.random.default_rng(seed).uniform([-0.8, -0.6, 1.6], [0.8, 0.6, 4], (count, 3))


def by_opencv(camera: Lens, v: Floats, p: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels, and their derivatives by the pose and by the intrinsics in our order."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    K, D = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(camera.distortion)
    if isinstance(camera, FisheyeCamera):
        seen, J = cv2.fisheye.projectPoints(p[:, None], v[:3, None], v[3:, None], K, D)
        order = [*range(8, 14)], [*range(8)]
    else:
        seen, J = cv2.projectPoints(p, v[:3], v[3:], K, D)
        order = [*range(6)], [*range(6, 10 + len(D))]
    J = J.reshape(len(p), 2, -1)
    return seen.reshape(-1, 2), J[..., order[0]], J[..., order[1]]


@pytest.mark.parametrize("camera", LENSES, ids=["brown", "rational", "kb4"])
@pytest.mark.parametrize("v", POSES)
def test_pixels_and_derivatives_are_those_of_opencv(camera: Lens, v: Floats) -> None:
    p = points()
    there, by_pose = moved_points(v, p)
    seen = camera.projection(there)
    pixels, cv_by_pose, cv_by_intrinsics = by_opencv(camera, v, p)
    # In front, and nearer the axis than the lens's end: there OpenCV folds on, and we see nothing.
    known = np.isfinite(seen.pixels[:, 0])
    assert known.sum() > 15
    np.testing.assert_array_equal(seen.pixels, camera.project(there))
    np.testing.assert_allclose(seen.pixels[known], pixels[known], atol=1e-9)
    np.testing.assert_allclose((seen.by_point @ by_pose)[known], cv_by_pose[known], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(seen.by_intrinsics[known], cv_by_intrinsics[known], rtol=1e-9, atol=1e-9)
    assert seen.by_intrinsics.shape[-1] == len(camera.intrinsic_names) == len(camera.intrinsics)


@pytest.mark.parametrize("camera", LENSES, ids=["brown", "rational", "kb4"])
def test_derivatives_agree_with_central_differences(camera: Lens) -> None:
    p, h = points() * [1, 1, 0.5], 1e-6
    seen = camera.projection(p)
    known = np.isfinite(seen.pixels[:, 0])
    for axis in range(3):
        step = h * np.eye(3)[axis]
        numeric = (camera.project(p + step) - camera.project(p - step)) / (2 * h)
        np.testing.assert_allclose(seen.by_point[known, :, axis], numeric[known], rtol=1e-6, atol=1e-5)
    for n in range(len(camera.intrinsics)):
        step = h * np.eye(len(camera.intrinsics))[n]
        up, down = camera.with_intrinsics(camera.intrinsics + step), camera.with_intrinsics(camera.intrinsics - step)
        numeric = (up.project(p) - down.project(p)) / (2 * h)
        np.testing.assert_allclose(seen.by_intrinsics[known, :, n], numeric[known], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("camera", LENSES, ids=["brown", "rational", "kb4"])
def test_rays_and_their_derivatives_undo_the_projection(camera: Lens) -> None:
    x, y = np.meshgrid(np.linspace(60, 1200, 9), np.linspace(60, 900, 7))
    pixels, h = np.stack([x, y], axis=-1), 1e-4
    back = camera.unprojection(pixels)
    np.testing.assert_allclose(camera.project(3 * back.rays), pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(back.rays, axis=-1), 1, rtol=1e-12)
    for axis in range(2):
        step = h * np.eye(2)[axis]
        numeric = (camera.unproject(pixels + step) - camera.unproject(pixels - step)) / (2 * h)
        np.testing.assert_allclose(back.by_pixel[..., axis], numeric, atol=1e-9)
    for n, scale in enumerate(np.where(camera.intrinsics > 10, 1e-3, 1e-6)):
        step = scale * np.eye(len(camera.intrinsics))[n]
        up, down = camera.with_intrinsics(camera.intrinsics + step), camera.with_intrinsics(camera.intrinsics - step)
        numeric = (up.unproject(pixels) - down.unproject(pixels)) / (2 * scale)
        np.testing.assert_allclose(back.by_intrinsics[..., n], numeric, rtol=1e-5, atol=2e-7)


@pytest.mark.parametrize("camera", [RATIONAL, KB4], ids=["rational", "kb4"])
def test_every_pixel_of_the_image_comes_back(camera: Lens) -> None:
    x, y = np.meshgrid(np.arange(0, 1280, 3.0), np.arange(0, 960, 3.0))
    pixels = np.stack([x, y], axis=-1)
    np.testing.assert_allclose(camera.project(camera.unproject(pixels)), pixels, rtol=0, atol=1e-9)


def test_a_rational_lens_ends_where_it_turns_or_where_its_denominator_is_zero() -> None:
    turning: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)  # r / (1 + r^2) turns at 1, where it is 1/2
    pole: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0)  # r / (1 - r^2 / 4) has a pole at 2
    assert radius_limit(turning) == pytest.approx(1, rel=1e-9)
    assert radius_limit(pole) == pytest.approx(2, rel=1e-5)
    for lens, last in ((turning, 1.0), (pole, 2.0)):
        seen = ~np.isnan(distort(np.array([[0.99 * last, 0], [1.01 * last, 0], [3, 3]]), lens)[:, 0])
        assert seen.tolist() == [True, False, False]
    np.testing.assert_allclose(undistort(np.array([[0.0, 0.4]]), turning), [[0, 0.5]], atol=1e-12)
    assert np.isnan(undistort(np.array([[0.6, 0.0]]), turning)).all()


def test_a_fisheye_looks_back_over_its_shoulder_but_not_straight_back() -> None:
    ideal = KB4.model_copy(update={"distortion": (0.0, 0.0, 0.0, 0.0)})
    ray = np.array([np.sin(2.0), 0.0, np.cos(2.0)])
    np.testing.assert_allclose(ideal.project(5 * ray), [650 + 350 * 2.0, 470])
    np.testing.assert_allclose(ideal.unproject(ideal.project(5 * ray)), ray, atol=1e-12)
    np.testing.assert_array_equal(ideal.project(np.array([0.0, 0.0, 2.0])), [650, 470])
    np.testing.assert_allclose(ideal.pixel_gradients(np.array([0.0, 0.0, 2.0])), [[175, 0, 0], [0, 176, 0]])
    for nowhere in ([0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]):
        assert np.isnan(ideal.project(np.array(nowhere))).all()
    assert np.isnan(ideal.unproject(np.array([650 + 350 * 3.2, 470.0]))).all()


def test_a_fisheye_ends_where_it_folds() -> None:
    folding = KB4.model_copy(update={"distortion": (-1 / 3, 0.0, 0.0, 0.0)})  # theta - theta^3 / 3 turns at 1
    assert angle_limit(folding.distortion) == pytest.approx(1)
    for theta, seen in ((0.99, True), (1.01, False)):
        assert np.isnan(folding.project(np.array([np.sin(theta), 0, np.cos(theta)]))).any() != seen
    assert np.isnan(folding.unproject(np.array([650 + 350 * 0.67, 470.0]))).all()
    assert not np.isnan(folding.unproject(np.array([650 + 350 * 0.66, 470.0]))).any()


def test_coefficients_that_are_not_given_are_zero() -> None:
    assert Camera.model_validate(SIZE | {"distortion": (0.1, 0.2)}).distortion == (0.1, 0.2, 0, 0, 0)
    assert Camera.model_validate(SIZE | {"distortion": (1, 2, 3, 4, 5, 6)}).distortion == (1, 2, 3, 4, 5, 6, 0, 0)
    for wrong in [(0.1,), (0.0,) * 9]:
        with pytest.raises(ValueError, match="distortion"):
            Camera.model_validate(SIZE | {"distortion": wrong})


def test_pose_vectors_are_those_of_opencv_and_come_back() -> None:
    small = np.array([[1e-12, 0, 0], [0.0999, 0, 0.001], [0.1, 0.001, 0], [0, 0, 0]])
    for r in [*small, *np.random.default_rng(1).uniform(-1.7, 1.7, (20, 3))]:
        np.testing.assert_allclose(rotation_from_vector(r), cv2.Rodrigues(r)[0], atol=1e-12)
        v = np.array([*r, 1.0, 2.0, 3.0])
        np.testing.assert_allclose(vector_from_transform(transform_from_vector(v)), v, atol=1e-12)


def test_points_move_with_a_pose_as_central_differences_say() -> None:
    p, h = points(count=5), 1e-6
    by_pose = moved_points(POSES, p)[1]
    for n in range(6):
        step = h * np.eye(6)[n]
        numeric = (moved_points(POSES + step, p)[0] - moved_points(POSES - step, p)[0]) / (2 * h)
        np.testing.assert_allclose(by_pose[..., n], numeric, rtol=1e-6, atol=1e-8)
