"""Covariance of a transferred pixel against differences and against noise, and what is left out."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import inverse, look_at, transform_points
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, mount_camera
from cairn_fusion.mapping.integrate import Integrator, Method, integrate_scan
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.pixel_covariance import PlaceBounds, pixel_covariance, spread_m, spread_px
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.transfer.transfer_kernels import OK, list_doubtful_into
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.grid import Geometry
from cairn_sim.robots.heads import full_head

HEAD = full_head(scale=0.25)
CAMERAS = ["colour_left", "colour_right", "thermal_left", "thermal_right"]
Floats = npt.NDArray[np.float64]


def points(count: int = 200) -> Floats:
    """Before the ToF camera, 0.6 to 8 m away."""
    rng = np.random.default_rng(1)
    rays = HEAD["tof"].camera.rays().reshape(-1, 3)
    return rays[rng.integers(len(rays), size=count)] * rng.uniform(0.6, 8.0, (count, 1))


@pytest.mark.parametrize("name", CAMERAS)
def test_pixel_gradients_agree_with_differences(name: str) -> None:
    camera = HEAD[name].camera
    assert isinstance(camera, Camera)
    own = transform_points(inverse(HEAD[name].transform), points())
    own = own[camera.contains(camera.project(own))]
    step_m = 1e-5
    for axis in range(3):
        ahead, behind = own.copy(), own.copy()
        ahead[:, axis] += step_m
        behind[:, axis] -= step_m
        differences = (camera.project(ahead) - camera.project(behind)) / (2 * step_m)
        np.testing.assert_allclose(camera.pixel_gradients(own)[..., axis], differences, rtol=1e-5, atol=1e-5)
    assert len(own) > 50 and np.isnan(camera.pixel_gradients(np.array([0.0, 0.0, -1.0]))).all()


@pytest.mark.parametrize("name", CAMERAS)
def test_the_covariance_is_that_of_points_with_noisy_ranges(name: str) -> None:
    camera, rng = HEAD[name].camera, np.random.default_rng(2)
    chosen = points(40)
    seen = camera.contains(camera.project(transform_points(inverse(HEAD[name].transform), chosen)))
    for point in chosen[seen][:6]:
        sigma_m = 0.002 * np.linalg.norm(point)
        noisy = point * (1 + 0.002 * rng.standard_normal((40_000, 1)))
        pixels = camera.project(transform_points(inverse(HEAD[name].transform), noisy))
        found = pixel_covariance(point[None], np.array([sigma_m]), HEAD, src="tof", dst=name)[0]
        np.testing.assert_allclose(found, np.cov(pixels.T), rtol=0.05, atol=1e-4 * np.trace(found))


def test_calibration_adds_to_both_axes_and_without_a_baseline_range_noise_does_nothing() -> None:
    tof = HEAD["tof"]
    beside = tof.model_copy(update={"spectrum": Spectrum.COLOUR, "calibration_sigma_px": 0.7})
    rig = Rig(name="one", cameras={"tof": tof, "colour": beside})
    covariance = pixel_covariance(points(), np.full(200, 0.5), rig, src="tof", dst="colour")
    np.testing.assert_allclose(covariance, np.broadcast_to(0.49 * np.eye(2), (200, 2, 2)), atol=1e-9)
    np.testing.assert_allclose(spread_px(covariance), 0.7)


def test_the_spread_is_the_longer_axis() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    covariance = turn @ np.diag([9.0, 1.0]) @ turn.T
    np.testing.assert_allclose(spread_px(covariance[None]), 3.0)


def test_beside_a_fisheye_a_point_is_as_uncertain_as_its_angle_and_range_say() -> None:
    fisheye = FisheyeCamera(width=640, height=480, focal_px=(200.0, 200.0), centre_px=(320.0, 240.0))
    ahead = np.eye(4)
    ahead[:3, 3] = (0.0, 0.0, 0.1)  # across a line of sight along x
    seen = mount_camera(Spectrum.COLOUR, fisheye, ahead)
    rig = Rig(name="two", cameras={"tof": mount_camera(Spectrum.RANGE, fisheye, np.eye(4)), "colour": seen})
    found = spread_m(np.array([[2.0, 0.0, 0.1]]), np.array([0.5]), rig, src="tof", dst="colour")
    # 0.5 m along a line that is 0.05 rad off the other camera's.
    np.testing.assert_allclose(found, 0.5 * 0.05, rtol=0.01)


def test_a_lidar_has_no_pixel_covariance() -> None:
    lidar = mount_camera(Spectrum.RANGE, SpinningLidar(width=8, height=1, elevations_deg=(0.0,)), np.eye(4))
    rig = Rig(name="two", cameras={"tof": HEAD["tof"], "lidar": lidar})
    with pytest.raises(BadInputError, match="must have a lens"):
        pixel_covariance(points(), np.ones(200), rig, src="tof", dst="lidar")


GEOMETRY = Geometry(voxel_edge_um=50_000, depth=4, channels=(TEMPERATURE,))


@pytest.mark.parametrize("method", list(Method))
def test_samples_whose_place_is_too_uncertain_are_left_out_and_hits_stay(method: Method) -> None:
    camera = Camera(width=40, height=30, focal_px=(40.0, 40.0), centre_px=(19.5, 14.5))
    tof = mount_camera(Spectrum.RANGE, camera, np.eye(4)).model_copy(
        update={"sensing": RangeSensing(sigma_m=((0.0, 0.5),))}
    )
    thermal = mount_camera(Spectrum.THERMAL, camera, look_at((0.2, 0, 0), (0.2, 0, 1), up=(0, -1, 0)))
    rig = Rig(name="head", cameras={"tof": tof, "ir": thermal})
    # A wall with its left half at 1 m and its right half at 4 m.
    z_m = np.where(np.arange(40) < 20, 1.0, 4.0)
    range_m = (z_m / camera.rays()[..., 2]).astype(np.float32)
    scan = Scan(
        time_s=0.0,
        T_map_rig=np.eye(4),
        range_camera="tof",
        range_m=range_m,
        thermal={"ir": np.full((30, 40), 300, np.float32)},
    )
    # Across the line of sight 0.5 m of range noise are 0.5 * 0.2 / z: 10 cm on the near half, 2.5 cm on the far one.
    near, far = (
        spread_m(np.array([[x, 0, z]]), np.array([0.5]), rig, src="tof", dst="ir")[0]
        for x, z in ((-0.1, 1.0), (0.5, 4.0))
    )
    assert 0.08 < near < 0.12 and 0.02 < far < 0.03
    limits = Integrator(method=method, flying_step_m=math.inf)
    depths = []
    for voxels in (math.inf, 1.0, 0.1):
        diff = integrate_scan(scan, rig, GEOMETRY, integrator=replace(limits, sample_spread_voxels=voxels))
        depths.append(sum(int((e.samples[:, -1] > 0).sum()) for e in diff.values()))
        assert sum(int((e.counts[:, 0] > 0).sum()) for e in diff.values()) > 500
        assert all((e.samples[:, -1] <= 1).all() for e in diff.values())
    assert depths[0] > depths[1] > depths[2] == 0


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("sigma_px", [None, 0.5, 8.0])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.05])
def test_what_is_taken_for_certain_is(name: str, sigma_px: float | None, noise: float) -> None:
    seen = HEAD[name].model_copy(update={"calibration_sigma_px": sigma_px})
    rig = HEAD.model_copy(update={"cameras": {**HEAD.cameras, name: seen}})
    chosen = points()
    range_m = np.linalg.norm(chosen, axis=1)
    sigma_m = noise * range_m
    spreads_m = spread_m(chosen, sigma_m, rig, src="tof", dst=name)
    worst_m = float(np.nanmax(spreads_m))
    bounds = PlaceBounds.of(rig, src="tof", dst=name)

    def is_certain(limit_m: float) -> npt.NDArray[np.bool_]:
        labels, doubtful = np.full(len(range_m), OK, np.uint8), np.empty(len(range_m), np.int32)
        voxel_of, spoken = np.arange(len(range_m), dtype=np.int32), np.zeros(len(range_m), np.bool_)
        spread = (bounds.baseline_m, bounds.calibration, limit_m)
        count = list_doubtful_into(labels, doubtful, voxel_of, spoken, range_m, sigma_m, *spread)
        return ~np.isin(voxel_of, doubtful[:count])

    for limit_m in np.quantile(spreads_m[np.isfinite(spreads_m)], [0.0, 0.5, 1.0]):
        certain = is_certain(0.999 * limit_m - 1e-12)
        assert not (certain & (spreads_m >= limit_m)).any()
    assert is_certain(200 * worst_m + 1e-12).all()


def test_points_that_are_hidden_or_need_no_sample_are_not_examined() -> None:
    labels = np.array([OK, OK, Label.OCCLUDED, OK, Label.OUT_OF_VIEW], np.uint8)
    doubtful, voxel_of = np.empty(5, np.int32), np.array([1, 0, 1, 1, 0], np.int32)
    spoken, range_m, sigma_m = np.array([True, False]), np.full(5, 2.0), np.array([0.1, 0.1, 0.1, 0.0, 0.1])
    assert list_doubtful_into(labels, doubtful, voxel_of, spoken, range_m, sigma_m, 0.1, 0.0, 0.01) == 1
    assert doubtful[0] == 0
    assert labels.tolist() == [Label.OK, Label.NO_READING, Label.OCCLUDED, Label.OK, Label.OUT_OF_VIEW]
