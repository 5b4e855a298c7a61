"""Pose uncertainty in a picture: Jacobians against true motions, covariances against Monte Carlo, and the blur."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.poses import inverse, look_at, transform_points
from cairn_map.errors import BadInputError
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.pose_spread import PoseSpread, motions, sigma_px, spread_ink, spread_picture, why_withheld
from cairn_map.render.spread_kernels import scatter_into

Floats = npt.NDArray[np.float64]
CAMERA = Camera(
    width=60, height=44, focal_px=(52.0, 50.0), centre_px=(28.0, 23.0), distortion=(-0.2, 0.05, 0.002, -0.001, 0.0)
)
SIGHT = CameraRays(CAMERA.rays())
MIXED = np.random.default_rng(7).standard_normal((6, 9)) * np.array([[0.004], [0.01], [0.02], [0.01], [0.03], [0.02]])
SPREAD = PoseSpread(MIXED @ MIXED.T / 9)


def ranges(seed: int = 0) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(0.6, 8, (44, 60)).astype(np.float32)


def moved_pixels(range_m: npt.NDArray[np.float32], motion: Floats) -> Floats:
    """(H, W, 2) where points appear if the camera is at T exp(motion)."""
    T_true = transform_from_vector(motion)
    points = CAMERA.rays() * range_m[..., None].astype(np.float64)
    return CAMERA.project(transform_points(inverse(T_true), points))


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_moves_every_pixel_as_its_jacobian_says(axis: int) -> None:
    range_m, motion = ranges(), np.zeros(6)
    motion[axis] = 1e-4
    moved = (moved_pixels(range_m, motion) - moved_pixels(range_m, -motion)) / 2e-4
    inside = slice(1, -1)
    found = motions(SIGHT, range_m)[..., axis]
    # Of the lens, what its neighbouring rays say: within 1 % of the largest.
    assert np.abs(found - moved)[inside, inside].max() < 0.01 * np.abs(moved).max() + 0.05
    assert np.abs(found - moved).max() < 0.04 * np.abs(moved).max() + 0.1  # at the border, from one side


def test_covariances_are_those_of_many_drawn_poses() -> None:
    range_m, rng = ranges(1), np.random.default_rng(2)
    root = np.linalg.cholesky(SPREAD.covariance)
    draws = 1500
    drawn = np.stack([moved_pixels(range_m, root @ rng.standard_normal(6)) for _ in range(draws)])[:, 2:-2:8, 2:-2:8]
    off = drawn - drawn.mean(axis=0)
    sampled = np.einsum("nyxi,nyxj->yxij", off, off) / (draws - 1)
    found = SPREAD.at(SIGHT, range_m)[2:-2:8, 2:-2:8].astype(np.float64)
    full = np.stack([found[..., [0, 1]], found[..., [1, 2]]], axis=-2)
    # What of the sample is left of the identity where it is whitened: 1500 draws have it to 4 %, and lenses bend.
    white = np.linalg.solve(full, sampled)
    assert np.abs(np.trace(white, axis1=-2, axis2=-1) / 2 - 1).max() < 0.2
    assert abs(np.mean(np.trace(white, axis1=-2, axis2=-1)) / 2 - 1) < 0.05
    assert np.median(np.abs(found[..., 1]) / np.sqrt(found[..., 0] * found[..., 2])) > 0.05  # not along the axes


def test_a_mounted_camera_has_the_spread_of_its_rig() -> None:
    T_rig_camera = look_at((0.3, -0.1, 0.2), (2.0, 1.0, 0.5))
    rng, root = np.random.default_rng(3), np.linalg.cholesky(SPREAD.covariance)
    small, found = 1e-3, np.zeros((6, 6))
    for motion in small * (root @ rng.standard_normal((6, 4000))).T:
        T = inverse(T_rig_camera) @ transform_from_vector(motion) @ T_rig_camera
        own = np.array([T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1], *(2 * T[:3, 3])]) / 2
        found += np.outer(own, own) / 4000 / small**2
    expected = SPREAD.seen_from(T_rig_camera).covariance
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(found - expected).max() < 0.1 * scale.max()
    assert (np.abs(found - expected) / scale).max() < 0.1
    np.testing.assert_allclose(SPREAD.seen_from(np.eye(4)).covariance, SPREAD.covariance)


def test_equal_sigmas_are_what_they_were() -> None:
    """In the middle of an ideal camera: (f sigma_rad)^2 + (f sigma_m / range)^2 along both axes."""
    ideal = Camera(width=61, height=45, focal_px=(50.0, 50.0), centre_px=(30.0, 22.0))
    found = PoseSpread.of_sigmas(0.02, 0.01).at(CameraRays(ideal.rays()), np.full((45, 61), 2, np.float32))[22, 30]
    np.testing.assert_allclose(found, [0.5**2 + 0.5**2, 0, 0.5**2 + 0.5**2], rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("sigmas_px", [(1.0, 1.0), (2.0, 5.0), (8.0, 3.0)])
def test_ink_is_spread_by_the_covariance_of_its_place(sigmas_px: tuple[float, float]) -> None:
    ink = np.zeros((161, 161, 4), np.uint8)
    ink[70:91, 70:91] = [200, 100, 50, 250]
    a, (s, t) = np.radians(25), sigmas_px
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    C = R @ np.diag([s * s, t * t]) @ R.T
    covariance = np.broadcast_to(np.array([C[0, 0], C[0, 1], C[1, 1]], np.float32), (161, 161, 3))
    spread = spread_ink(ink, covariance).astype(float)
    assert spread.sum() == pytest.approx(ink.sum(), rel=0.03)
    at = np.stack(np.meshgrid(np.arange(161.0), np.arange(161.0)), axis=-1).reshape(-1, 2) - 80
    parts = [each[..., 3].reshape(-1) / each[..., 3].sum() for each in (spread, ink.astype(float))]
    wide = [np.einsum("n,ni,nj->ij", part, at, at) for part in parts]
    np.testing.assert_allclose(wide[0] - wide[1], C, atol=0.06 * np.trace(C) + 0.2)
    assert np.array_equal(spread_ink(ink, 0.001 * covariance), ink)
    assert np.array_equal(spread_ink(ink, np.full_like(covariance, np.nan)), ink)


def test_an_even_picture_stays_as_it_is_however_uncertain() -> None:
    rgb = np.full((40, 50, 3), (40, 90, 200), np.uint8)
    covariance = np.random.default_rng(4).uniform(0, 60, (40, 50, 3)).astype(np.float32) * np.array([1, 0.1, 1], "f4")
    assert np.abs(spread_picture(rgb, covariance).astype(int) - rgb).max() <= 1


def test_scattering_agrees_with_its_slow_twin() -> None:
    rng = np.random.default_rng(5)
    ink = rng.integers(0, 256, (9, 11, 4)).astype(np.uint8)
    ink[2, 3, 3] = 0
    covariance = np.abs(rng.normal(2, 2, (9, 11, 3))).astype(np.float32)
    covariance[..., 1] *= 0.1
    covariance[4, 4], covariance[5, 5] = 0, np.nan
    points, counts = rng.normal(size=(2, 6, 2)).astype(np.float32), np.array([3, 6])
    total, expected = np.zeros((9, 11, 4), np.float32), np.zeros((9, 11, 4))
    scatter_into(total, ink, covariance, points, counts)
    for y, x in np.ndindex(9, 11):
        xx, xy, yy = covariance[y, x].astype(float)
        if not ink[y, x, 3]:
            continue
        if not xx + yy > 0:
            expected[y, x] += ink[y, x]
            continue
        l11, l21 = np.sqrt(xx), xy / np.sqrt(xx)
        l22 = np.sqrt(max(yy - l21**2, 0))
        size = 0 if 3 * (l11 + 1) * (l22 + abs(l21) + 1) <= 3 else 1
        for p, q in points[size, : counts[size]].astype(float):
            i, j = int(np.floor(x + l11 * p + 0.5)), int(np.floor(y + l21 * p + l22 * q + 0.5))
            if 0 <= i < 11 and 0 <= j < 9:
                expected[j, i] += ink[y, x] / counts[size]
    # A place that rounds the other way in single precision moves one share.
    assert np.mean(np.abs(total - expected) > 0.01) < 0.02


def test_what_is_too_uncertain_is_withheld_and_what_is_no_covariance_refused() -> None:
    wide = np.tile(np.array([400, 0, 100], np.float32), (10, 1))
    np.testing.assert_allclose(sigma_px(wide), 20)
    assert "20 px" in str(why_withheld(wide)) and why_withheld(wide / 4) is None and why_withheld(wide[:0]) is None
    lower = [SPREAD.covariance[i, j] for i in range(6) for j in range(i + 1)]
    np.testing.assert_allclose(PoseSpread.of_lower(tuple(lower)).covariance, SPREAD.covariance)
    for bad in (lower[:20], [-1.0, *lower[1:]], [np.nan, *lower[1:]], [*lower[:1], 9.0, *lower[2:]], [1e3, *lower[1:]]):
        with pytest.raises(BadInputError):
            PoseSpread.of_lower(tuple(bad))
    for sigmas in ((-1.0, 0.0), (0.0, np.inf)):
        with pytest.raises(BadInputError):
            PoseSpread.of_sigmas(*sigmas)
    lopsided = SPREAD.covariance.copy()
    lopsided[0, 1] += 1
    with pytest.raises(BadInputError, match="symmetric"):
        PoseSpread(lopsided)
