"""Covariance of transferred pixels by a rig's own: differences, chi2 against truth, and the grid."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.calibration import Calibration, covariance_from_matrix
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.pose_vectors import rotation_from_vector
from cairn_calib.rig.poses import inverse, transform_points
from cairn_calib.rig.rig import MountedCamera, Rig, Spectrum, mount_camera
from cairn_fusion.transfer.calibration_covariance import place_gradients
from cairn_fusion.transfer.covariance_grid import CovarianceGrid, calibration_bound_px
from cairn_fusion.transfer.pixel_covariance import PlaceBounds, pixel_covariance
from cairn_map.errors import BadInputError
from cairn_sim.robots.heads import full_head

Floats = npt.NDArray[np.float64]
NAMES = ("tof", "colour_left", "thermal_left")
PAIRS = [("tof", "colour_left"), ("tof", "thermal_left"), ("colour_left", "thermal_left")]
SIGMAS = {"fx": 0.8, "fy": 0.8, "cx": 0.5, "cy": 0.5, "k1": 2e-3, "k2": 4e-3, "rx": 1e-3, "ry": 1e-3, "rz": 1e-3}
SIGMAS |= {"tx": 1e-3, "ty": 1e-3, "tz": 2e-3}


def calibrated() -> Rig:
    """A head whose file says how certain its numbers are, with correlations."""
    head = full_head()
    names = [
        (camera, name)
        for camera in NAMES
        for name in SIGMAS
        if camera != "tof" or name not in ("rx", "ry", "rz", "tx", "ty", "tz")
    ]
    sigmas = np.array([SIGMAS[name] for _, name in names])
    mixed = np.random.default_rng(0).standard_normal((len(names), 2 * len(names)))
    correlation = np.corrcoef(mixed)
    covariance = covariance_from_matrix(names, correlation * np.outer(sigmas, sigmas))
    calibration = Calibration(software="test", made_s=0.0, gauge="tof", covariance=covariance)
    return Rig(name="head", cameras={name: head[name] for name in NAMES}, calibration=calibration)


RIG = calibrated()


def moved(rig: Rig, shifts: dict[tuple[str, str], float]) -> Rig:
    """The rig whose true numbers differ from the stated ones, as `cairn_calib.rig.calibration` defines them."""
    cameras = {}
    for name, each in rig.cameras.items():
        mine = {parameter: value for (camera, parameter), value in shifts.items() if camera == name}
        lens, T = each.camera, each.transform.copy()
        assert isinstance(lens, Lens)
        values = lens.intrinsics + [mine.get(parameter, 0.0) for parameter in lens.intrinsic_names]
        T[:3, :3] = rotation_from_vector(np.array([mine.get(axis, 0.0) for axis in ("rx", "ry", "rz")])) @ T[:3, :3]
        T[:3, 3] += [mine.get(axis, 0.0) for axis in ("tx", "ty", "tz")]
        cameras[name] = mount_camera(each.spectrum, lens.with_intrinsics(values), T)
    return Rig(name="true", cameras=cameras)


def carried(rig: Rig, pixels: Floats, range_m: Floats, *, src: str, dst: str) -> Floats:
    """(N, 2) where pixels of one camera appear in another."""
    points = rig[src].camera.unproject(pixels) * range_m[:, None]
    return rig[dst].camera.project(transform_points(inverse(rig[dst].transform) @ rig[src].transform, points))


def some_pixels(src: str, dst: str, count: int, seed: int) -> tuple[Floats, Floats]:
    """Pixels and ranges that the other camera sees."""
    rng, camera = np.random.default_rng(seed), RIG[src].camera
    pixels = rng.uniform((2, 2), (camera.width - 3, camera.height - 3), (20 * count, 2))
    range_m = rng.uniform(0.7, 8, 20 * count)
    seen = RIG[dst].camera.contains(carried(RIG, pixels, range_m, src=src, dst=dst))
    return pixels[seen][:count], range_m[seen][:count]


@pytest.mark.parametrize(("src", "dst"), PAIRS)
def test_gradients_by_every_parameter_agree_with_differences(src: str, dst: str) -> None:
    pixels, range_m = some_pixels(src, dst, 20, 1)
    points = RIG[src].camera.unproject(pixels) * range_m[:, None]
    gradients = place_gradients(points, RIG, src=src, dst=dst)
    for key, gradient in gradients.items():
        step = 1e-4 if key[1] in ("fx", "fy", "cx", "cy") else 1e-6
        ahead, behind = (carried(moved(RIG, {key: s}), pixels, range_m, src=src, dst=dst) for s in (step, -step))
        np.testing.assert_allclose(gradient, (ahead - behind) / (2 * step), rtol=1e-4, atol=2e-3)
    assert {name for _, name in gradients} >= set(SIGMAS)
    assert place_gradients(points, RIG, src=src, dst=src) == {}


@pytest.mark.parametrize(("src", "dst"), PAIRS)
def test_fused_positions_are_off_by_what_their_covariance_says(src: str, dst: str) -> None:
    """Mahalanobis distances of true against stated positions are chi2 with two degrees of freedom."""
    rng, assert_rig = np.random.default_rng(2), RIG.calibration
    assert assert_rig is not None and assert_rig.covariance is not None
    covariance = assert_rig.covariance
    root, keys = np.linalg.cholesky(covariance.matrix), [(each.camera, each.name) for each in covariance.parameters]
    pixels, range_m = some_pixels(src, dst, 12, 3)
    sigma_m, pixel_sigma_px, distances = 0.01 * np.ones(12), 0.2, []
    points = RIG[src].camera.unproject(pixels) * range_m[:, None]
    S = pixel_covariance(points, sigma_m, RIG, src=src, dst=dst, pixel_sigma_px=pixel_sigma_px)
    grid = CovarianceGrid.of(RIG, src=src, dst=dst).at(pixels, range_m, sigma_m, pixel_sigma_px=pixel_sigma_px)
    stated = carried(RIG, pixels, range_m, src=src, dst=dst)
    for _ in range(300):
        truth = moved(RIG, dict(zip(keys, (root @ rng.standard_normal(len(keys))).tolist(), strict=True)))
        true_pixels = pixels + pixel_sigma_px * rng.standard_normal(pixels.shape)
        true_m = range_m + sigma_m * rng.standard_normal(12)
        off = carried(truth, true_pixels, true_m, src=src, dst=dst) - stated
        distances.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(S), off))
    mean = np.mean(distances)
    # Of a draw all points share the rig, so that 300 draws count and not 3600 points: sigma of the mean about 0.1.
    assert 1.6 < mean < 2.4
    assert 0.9 < np.mean(np.array(distances) < 5.991) < 0.985
    full = np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]], axis=1)
    trace = S[:, 0, 0] + S[:, 1, 1]
    assert (np.abs(grid - full) < 0.08 * trace[:, None]).all()


def test_without_a_covariance_the_rigs_one_number_counts() -> None:
    seen: MountedCamera = RIG["colour_left"].model_copy(update={"calibration_sigma_px": 0.7})
    rig = Rig(name="one", cameras={"tof": RIG["tof"], "colour_left": seen})
    at = CovarianceGrid.of(rig, src="tof", dst="colour_left").at(
        np.array([[80.0, 70.0], [3.0, 4.0]]), np.array([2, np.nan], np.float32), np.zeros(2, np.float32)
    )
    np.testing.assert_allclose(at[0], [0.49, 0.0, 0.49], atol=1e-6)
    assert np.isnan(at[1]).all()
    assert calibration_bound_px(rig, src="tof", dst="colour_left") == 0.7
    assert calibration_bound_px(RIG, src="tof", dst="colour_left") > 1.0


def test_a_lidar_has_no_lens_to_look_from() -> None:
    lidar = mount_camera(Spectrum.RANGE, SpinningLidar(width=8, height=1, elevations_deg=(0.0,)), np.eye(4))
    with pytest.raises(BadInputError, match="lens"):
        CovarianceGrid.of(Rig(name="r", cameras={"lidar": lidar, "tof": RIG["tof"]}), src="lidar", dst="tof")


def test_a_range_pixel_covers_half_of_itself_to_each_side_and_what_is_uncertain() -> None:
    def reach_px(rig: Rig, range_m: float, sigma_m: float) -> float:
        bounds = PlaceBounds.of(rig, src="tof", dst="thermal_left")
        return bounds.fixed_px + bounds.moved_px * sigma_m / range_m**2

    plain = Rig(name="r", cameras={name: full_head()[name] for name in NAMES})
    assert int(reach_px(plain, 5.0, 0.01)) == 1  # 3.6 / 2, and 0.02 from noise
    assert int(reach_px(plain, 0.5, 0.05)) == int(1.82 + 465 * 0.085 * 0.05 / 0.25)
    # A thermal camera with larger pixels than the range camera's: less than one of them.
    coarse = plain.model_copy(
        update={"cameras": {**plain.cameras, "thermal_left": full_head(scale=0.2)["thermal_left"]}}
    )
    assert 0 < reach_px(coarse, 5.0, 0.01) < 1
    assert reach_px(RIG, 5.0, 0.01) > 3
