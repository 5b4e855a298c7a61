"""The surface of a range image: its joined pixels, the drawing in other cameras, and its kernels' slow twins."""

import numpy as np
import numpy.typing as npt
import pytest
from tests.naive import views as naive_views

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, mount_camera
from cairn_fusion.image_fusion.surface import drawn_surface, range_labels, surface_of
from cairn_fusion.image_fusion.surface_kernels import (
    borrowed_ranges,
    draw_labels_into,
    draw_squares_into,
    draw_triangles_into,
    joints,
    nearest_of_nine,
)
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label

Singles = npt.NDArray[np.float32]
TOF = Camera(width=44, height=36, focal_px=(40.0, 40.0), centre_px=(21.5, 17.5))
COLOUR = Camera(width=160, height=120, focal_px=(140.0, 140.0), centre_px=(79.5, 59.5))


def scan_of(range_m: Singles, amplitude: npt.NDArray[np.uint16] | None = None) -> Scan:
    return Scan(time_s=0.0, T_map_rig=np.eye(4), range_camera="tof", range_m=range_m, amplitude=amplitude)


def rig_of(x_m: float = 0.1, sensing: RangeSensing | None = None) -> Rig:
    tof = mount_camera(Spectrum.RANGE, TOF, np.eye(4)).model_copy(update={"sensing": sensing})
    colour = mount_camera(Spectrum.COLOUR, COLOUR, look_at((x_m, 0, 0), (x_m, 0, 1), up=(0, -1, 0)))
    return Rig(name="head", cameras={"tof": tof, "colour": colour})


def ragged(seed: int) -> tuple[Singles, npt.NDArray[np.uint8]]:
    """Two slanted surfaces with noise, and labels with holes."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((9, 13))
    range_m = 2 + 0.1 * x + 0.02 * y + np.where(x + y > 11, 1.0, 0.0) + 0.01 * rng.standard_normal((9, 13))
    labels = rng.choice([0, 0, 0, 0, 0, 3, 5], size=(9, 13)).astype(np.uint8)
    return range_m.astype(np.float32), labels


def test_every_range_pixel_has_a_label() -> None:
    range_m = np.full((36, 44), 2.0, np.float32)
    range_m[:, 22:] = 4.0
    range_m[5, 3], range_m[6, 3], range_m[:, 22] = np.nan, 11.0, 3.0
    amplitude = np.full((36, 44), 1000, np.uint16)
    amplitude[9, 9], amplitude[10, 9] = 65535, 30000
    labels = range_labels(scan_of(range_m, amplitude), rig_of())
    assert labels[5, 3] == labels[6, 3] == Label.NO_RANGE
    assert (labels[:, 22] == Label.FLYING).all()
    assert labels[9, 9] == Label.SATURATED and labels[10, 9] == Label.OK
    stated = rig_of(sensing=RangeSensing(saturated_amplitude=30000))
    assert range_labels(scan_of(range_m, amplitude), stated)[10, 9] == Label.SATURATED


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("step", [(1, 0), (0, 1)])
def test_what_is_joined_agrees_with_its_slow_twin(seed: int, step: tuple[int, int]) -> None:
    range_m, labels = ragged(seed)
    noise_m = np.full(range_m.shape, 0.03, np.float32)
    found = joints(range_m, labels, noise_m, *step)
    np.testing.assert_array_equal(found, naive_views.joined(range_m, labels, noise_m, *step))
    assert 0.2 < found.mean() < 0.9


@pytest.mark.parametrize("seed", range(3))
def test_triangles_and_squares_agree_with_their_slow_twins(seed: int) -> None:
    range_m, labels = ragged(seed)
    rng, noise_m = np.random.default_rng(seed), np.full(range_m.shape, 0.03, np.float32)
    across, down = (joints(range_m, labels, noise_m, *step) for step in ((1, 0), (0, 1)))
    y, x = np.indices(range_m.shape)
    u, v = 1.9 * x + rng.uniform(-0.3, 0.3, x.shape) - 2, 1.7 * y + rng.uniform(-0.3, 0.3, x.shape) - 1
    u[2, 3], q = np.nan, 1 / range_m.astype(np.float64)
    nearness, touched = np.zeros((14, 22), np.float32), np.zeros(u.shape, bool)
    draw_triangles_into(nearness, touched, u, v, q, across, down)
    slow = naive_views.drawn((14, 22), naive_views.triangles(across, down), u, v, q)
    np.testing.assert_allclose(nearness, slow, rtol=1e-5)
    assert (nearness > 0).mean() > 0.2
    fast = nearness.copy()
    draw_squares_into(fast, labels == 0, u, v, q, 1.1)
    np.testing.assert_allclose(fast, naive_views.squares(nearness, labels == 0, u, v, q, 1.1), rtol=1e-5)


def test_labels_are_drawn_only_where_nothing_is_known() -> None:
    nearness, marks = np.zeros((5, 5), np.float32), np.full((5, 5), 3, np.uint8)
    nearness[2, 2] = 1
    labels, u, v = np.array([[0, 4, 5]], np.uint8), np.array([[0.0, 2.0, 2.0]]), np.array([[0.0, 2.0, 1.0]])
    draw_labels_into(marks, nearness, labels, u, v, 1.0)
    expected = np.full((5, 5), 3)
    expected[1:4, 1:4], expected[0:3, 1:4] = 4, 5
    expected[2, 2] = 3
    np.testing.assert_array_equal(marks, expected)


def test_a_pixel_without_a_range_borrows_the_nearest_one() -> None:
    range_m = np.array([[1, 2, np.nan, np.nan, np.nan, 9]], np.float32)
    labels = np.array([[0, 0, 3, 4, 3, 0]], np.uint8)
    np.testing.assert_array_equal(borrowed_ranges(range_m, labels, 6), [[1, 2, 2, 2, 9, 9]])
    np.testing.assert_array_equal(borrowed_ranges(range_m, labels, 1), [[1, 2, 2, np.nan, 9, 9]])


def test_nearest_of_nine_is_a_maximum_filter() -> None:
    values = np.random.default_rng(0).random((7, 9)).astype(np.float32)
    padded = np.pad(values, 1, constant_values=0)
    expected = np.max([padded[j : j + 7, i : i + 9] for j in range(3) for i in range(3)], axis=0)
    np.testing.assert_array_equal(nearest_of_nine(values), expected)


def test_a_plane_is_drawn_where_it_is() -> None:
    normal = np.array([0.3, 0.1, 1.0]) / np.linalg.norm([0.3, 0.1, 1.0])
    range_m = (2.0 / (TOF.rays() @ normal)).astype(np.float32)
    rig = rig_of()
    drawn = drawn_surface(surface_of(scan_of(range_m), rig), rig, "colour")
    y, x = np.indices(drawn.nearness.shape)
    pixels = np.stack([x, y], axis=-1) * drawn.step_px + (drawn.step_px - 1) / 2
    expected = (COLOUR.unproject(pixels) @ normal) / (2.0 - 0.1 * normal[0])
    known = drawn.nearness > 0
    assert known.mean() > 0.8
    # Straight between pixels 1.4 degrees apart: the plane to a ten-thousandth.
    np.testing.assert_allclose(drawn.nearness[known], expected[known], rtol=2e-4)


def test_nothing_is_drawn_across_a_step_and_a_thing_one_pixel_thin_is() -> None:
    range_m = np.full((36, 44), 3.0, np.float32)
    range_m[:, 20] = 1.0
    rig = rig_of(0.0)
    surface = surface_of(scan_of(range_m), rig)
    assert not surface.across[:, 19].any() and not surface.across[:, 20].any() and surface.across[:, 21].all()
    assert surface.fronts[:, 20].all() and not surface.fronts[:, [19, 21]].any()
    known = drawn_surface(surface, rig, "colour").nearness
    ranges = 1 / known[known > 0]
    assert ((np.abs(ranges - 1) < 0.1) | (np.abs(ranges - 3) < 0.2)).all()
    assert (ranges < 1.1).any()
