"""Equations 1 to 6 of the paper, and what a displaced camera does not see."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera, camera_from_field_of_view
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.transfer.transfer import CameraPair, Label, depth_steps, points_from_range, transfer_points
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]

TOF = Camera(width=44, height=36, focal_px=(40.0, 41.0), centre_px=(21.2, 17.9))
BENT = TOF.model_copy(update={"distortion": (-0.28, 0.09, 0.001, -0.002, 0.01)})
COLOUR = Camera(width=160, height=120, focal_px=(140.0, 140.0), centre_px=(79.5, 59.5))


def rig(src: Camera = TOF, dst: Camera = COLOUR, *, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rig:
    """A range camera at the rig's origin and a colour camera next to it."""
    T_rig_colour = np.eye(4)
    T_rig_colour[:3, 3] = shift_m
    cameras = {
        "tof": mount_camera(Spectrum.RANGE, src, np.eye(4)),
        "colour": mount_camera(Spectrum.COLOUR, dst, T_rig_colour),
    }
    return Rig(name="head", cameras=cameras)


def ranges_to_planes(camera: Camera, planes: list[tuple[Floats, float, float, float]]) -> Floats:
    """(H, W) distance along each beam to the nearest of some plane patches: normal . p = d for low <= x < high."""
    rays = camera.rays()
    ranges = np.full(rays.shape[:2], np.inf)
    for normal, d, low, high in planes:
        along = d / (rays @ normal)
        x = rays[..., 0] * along
        ranges = np.where((along > 0) & (x >= low) & (x < high), np.minimum(ranges, along), ranges)
    return np.where(np.isfinite(ranges), ranges, np.nan)


FRONTAL = np.array([0.0, 0.0, 1.0])
EVERYWHERE = (-1e9, 1e9)


def test_equations_1_to_4_hold_to_the_letter_without_distortion() -> None:
    rng = np.random.default_rng(0)
    camera = TOF.model_copy(update={"focal_px": (40.0, 40.0)})
    d = rng.uniform(0.2, 9.0, (36, 44))
    x, y = np.meshgrid(np.arange(44) - 21.2, np.arange(36) - 17.9)
    f = 40.0
    d0 = d * np.cos(np.arctan(y / np.sqrt(f**2 + x**2))) * np.cos(np.arctan(x / f))  # Eq. 2
    np.testing.assert_allclose(d0, d * f / np.sqrt(x**2 + y**2 + f**2), rtol=1e-12)  # Eq. 4
    expected = np.stack([d0 * x / f, d0 * y / f, d0], axis=-1)  # Eq. 1
    np.testing.assert_allclose(points_from_range(d, camera), expected, rtol=1e-12)


def test_with_distortion_a_point_lies_on_its_pixels_ray_at_its_range() -> None:
    d = np.random.default_rng(1).uniform(0.2, 9.0, (36, 44)).astype(np.float32)
    points = points_from_range(d, BENT)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), d, rtol=1e-6)
    x, y = np.meshgrid(np.arange(44.0), np.arange(36.0))
    np.testing.assert_allclose(BENT.project(points), np.stack([x, y], axis=-1), atol=1e-8)


def test_no_range_is_no_point() -> None:
    d = np.full((36, 44), 2.0)
    d[3, 4] = np.nan
    assert np.argwhere(np.isnan(points_from_range(d, TOF)).all(axis=-1)).tolist() == [[3, 4]]


def test_a_range_image_of_another_size_is_refused() -> None:
    with pytest.raises(BadInputError):
        points_from_range(np.zeros((44, 36)), TOF)


def test_equations_5_and_6_place_a_point_in_the_other_image() -> None:
    transfer = transfer_points(
        np.array([[0.3], [-0.2], [2.0]]), CameraPair.of(rig(shift_m=(0.1, 0.0, 0.0)), src="tof", dst="colour")
    )
    x, y = 140 * (0.3 - 0.1) / 2 + 79.5, 140 * -0.2 / 2 + 59.5
    assert transfer.pixels.tolist() == [[round(x)], [round(y)]]
    assert transfer.labels.tolist() == [Label.OK]


def test_every_point_has_a_label() -> None:
    points = np.array([[0, 0, 2.0], [0, 0, -2.0], [50, 0, 2.0], [np.nan] * 3])
    transfer = transfer_points(points.T, CameraPair.of(rig(), src="tof", dst="colour"))
    assert transfer.labels.tolist() == [Label.OK, Label.OUT_OF_VIEW, Label.OUT_OF_VIEW, Label.NO_RANGE]


def test_samples_are_the_nearest_pixels_of_the_points_that_are_seen() -> None:
    image = np.arange(120 * 160).reshape(120, 160)
    points = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.01, 0, 1.0]])
    transfer = transfer_points(points.T, CameraPair.of(rig(), src="tof", dst="colour"))
    x = [80, 81]  # 79.5 rounds to even; 79.5 + 1.4
    assert transfer.sample(image).tolist() == [image[60, x[0]], image[60, x[1]]]


def test_a_step_in_depth_is_that_of_the_surface_and_not_of_its_edge() -> None:
    z = np.array([[1.0, 1.1, 1.2, 3.0, 3.0, np.nan]])
    steps = depth_steps(np.stack([z, z, z], axis=-1))
    np.testing.assert_allclose(steps, [[0.1, 0.1, 0.1, 0.0, 0.0, 0.0]], atol=1e-12)


def naive_steps(z: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """`depth_steps`, an axis at a time."""
    total = np.zeros(z.shape)
    for axis in (0, 1):
        step = np.abs(np.diff(z, axis=axis, prepend=np.nan, append=np.nan))
        before, after = np.split(step, [-1], axis=axis)[0], np.split(step, [1], axis=axis)[1]
        total += np.nan_to_num(np.fmin(before, after))
    return total


@pytest.mark.parametrize("seed", range(4))
def test_depth_steps_agree_with_their_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 9.0, (11, 17))
    z[rng.random(z.shape) < 0.3] = np.nan
    np.testing.assert_array_equal(depth_steps(np.stack([z, z, z], axis=-1)), naive_steps(z))


def test_cameras_with_one_centre_hide_nothing_from_each_other() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0], [0.02, 0.0, 4.0]])
    turned = look_at((0, 0, 0), (0.1, 0.05, 1.0), up=(0, -1, 0))
    cameras = {
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "thermal": mount_camera(Spectrum.THERMAL, COLOUR, turned),
    }
    transfer = transfer_points(points.T, CameraPair.of(Rig(name="head", cameras=cameras), src="tof", dst="thermal"))
    assert transfer.ok.all()


@pytest.mark.parametrize("shift_m", [0.15, -0.15, 0.3])
@pytest.mark.parametrize("dst", [COLOUR, camera_from_field_of_view(80, 60, horizontal_deg=60)])
def test_a_displaced_camera_does_not_see_what_the_front_plane_hides(shift_m: float, dst: Camera) -> None:
    near_m, far_m, edge_m = 1.0, 3.0, 0.2
    head = rig(dst=dst, shift_m=(shift_m, 0.0, 0.0))
    ranges = ranges_to_planes(TOF, [(FRONTAL, near_m, -edge_m, edge_m), (FRONTAL, far_m, *EVERYWHERE)])
    image_points = points_from_range(ranges, TOF)
    points, steps_m = image_points.reshape(-1, 3), depth_steps(image_points).ravel()
    transfer = transfer_points(points.T, CameraPair.of(head, src="tof", dst="colour"), steps_m=steps_m)
    # Where the line from the colour camera to a far point crosses the near plane.
    crossing = shift_m + (points[:, 0] - shift_m) * near_m / points[:, 2]
    far = points[:, 2] > 2
    in_view = transfer.labels != Label.OUT_OF_VIEW
    # The z-buffer cannot know the front plane's edge better than its samples, which are 1.5 bins apart.
    blur_m = 2.5 * near_m / 40
    hidden = far & in_view & (np.abs(crossing) < edge_m - blur_m)
    visible = in_view & (~far | (np.abs(crossing) > edge_m + blur_m))
    assert hidden.sum() > 10
    assert (transfer.labels[hidden] == Label.OCCLUDED).all()
    assert (transfer.labels[visible] == Label.OK).all()


@pytest.mark.parametrize("tilt_deg", [0, 30, 60, -60])
@pytest.mark.parametrize("camera", [TOF, BENT])
def test_a_slanted_plane_hides_nothing_of_itself(tilt_deg: float, camera: Camera) -> None:
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    ranges = ranges_to_planes(camera, [(normal, 1.5, *EVERYWHERE)])
    points = points_from_range(np.where(ranges < 6, ranges, np.nan), camera)
    head = rig(camera, shift_m=(0.1, 0.05, 0.0))
    transfer = transfer_points(
        points.reshape(-1, 3).T, CameraPair.of(head, src="tof", dst="colour"), steps_m=depth_steps(points).ravel()
    )
    assert not (transfer.labels == Label.OCCLUDED).any()
    assert transfer.ok.sum() > 300


SIZE = {"width": 64, "height": 48, "focal_px": (50.0, 52.0), "centre_px": (31.0, 24.5)}
LENSES: list[Lens] = [
    *(
        Camera.model_validate(SIZE | {"distortion": distortion})
        for distortion in (
            (0.0,) * 5,
            (-0.3, 0.1, 0.002, -0.003, -0.02),
            (-0.6, 0.0, 0.0, 0.0, 0.0),
            (0.4, 0.2, 1e-3, -5e-4, 0.05, 0.7, 0.15, 0.02),
        )
    ),
    FisheyeCamera.model_validate(SIZE | {"focal_px": (16.0, 16.0), "distortion": (0.02, -5e-3, 1e-3, -1e-4)}),
]


@pytest.mark.parametrize("camera", LENSES)
def test_points_appear_where_the_camera_says(camera: Lens) -> None:
    beside = np.eye(4)
    beside[0, 3] = 0.1
    tof = Camera(width=8, height=6, focal_px=(6.0, 6.0), centre_px=(3.5, 2.5))
    cameras = {
        "tof": mount_camera(Spectrum.RANGE, tof, np.eye(4)),
        "seen": mount_camera(Spectrum.COLOUR, camera, beside),
    }
    rig = Rig(name="two", cameras=cameras)
    points = np.random.default_rng(4).uniform(-3, 3, (4000, 3))
    points[:50] = np.nan
    transfer = transfer_points(points.T, CameraPair.of(rig, src="tof", dst="seen"))
    exact = camera.project(points - beside[:3, 3])
    inside = camera.contains(exact)
    in_view = np.isin(transfer.labels, [Label.OK, Label.OCCLUDED])
    assert 50 < inside.sum() < 3000
    np.testing.assert_array_equal(in_view, inside)
    np.testing.assert_array_equal(transfer.pixels.T[inside], np.rint(exact[inside]).astype(np.int64))
    assert (transfer.labels[:50] == Label.NO_RANGE).all()
