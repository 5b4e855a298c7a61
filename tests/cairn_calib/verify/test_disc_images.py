"""Circle targets: found where they are in drawn images, refused where something else is; and how far they are."""

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.range_bias import RangeBias
from cairn_calib.rig.rig import MountedCamera, Spectrum, mount_camera
from cairn_calib.verify.disc_images import Disc, Method, brightness_of, find_discs
from cairn_calib.verify.verification import RELIEF_SIGMA_M, disc_range
from cairn_map.arrays import Singles
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]
SIZE = 120, 160
FINE = 8
"""Samples along a pixel's side."""
TOF = mount_camera(
    Spectrum.RANGE,
    Camera(
        width=160,
        height=120,
        focal_px=(120.0, 121.0),
        centre_px=(80.5, 58.0),
        distortion=(-0.25, 0.1, 1e-3, -1e-3, 0.0),
    ),
    np.eye(4),
)


def drawn(centre: Floats, axes: tuple[float, float], turn_rad: float = 0.3) -> Singles:
    """(H, W) share of each pixel that an ellipse covers."""
    height, width = SIZE
    x = (np.arange(width * FINE) + 0.5) / FINE - 0.5 - centre[0]
    y = (np.arange(height * FINE) + 0.5) / FINE - 0.5 - centre[1]
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    u, v = np.meshgrid(x, y)
    inside = ((c * u + s * v) / axes[0]) ** 2 + ((c * v - s * u) / axes[1]) ** 2 < 1
    return np.asarray(inside.reshape(height, FINE, width, FINE).mean(axis=(1, 3)), np.float32)


@pytest.mark.parametrize(("method", "limit"), [("paper", 0.2), ("grey", 0.03)])
@pytest.mark.parametrize("spectrum", [Spectrum.THERMAL, Spectrum.COLOUR])
def test_a_disc_is_found_where_it_is(method: Method, limit: float, spectrum: Spectrum) -> None:
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(12):
        centre = rng.uniform([30, 30], [130, 90])
        axes = (rng.uniform(8, 14), rng.uniform(6, 8))
        bright = 20 + 30 * drawn(centre, axes) + 0.2 * rng.standard_normal(SIZE).astype(np.float32)
        (disc,) = find_discs(bright, spectrum, method=method)
        errors.append(disc.centroid - centre)
        assert disc.radius_px == pytest.approx(np.sqrt(axes[0] * axes[1]), rel=0.05)
        assert (np.linalg.norm(disc.pixels - centre, axis=1) < axes[0]).all()
    assert np.abs(errors).max() < limit


def test_light_that_floods_one_side_of_a_ring_moves_the_grey_centroid_less() -> None:
    centre = np.array([80.3, 60.6])
    ring = drawn(centre, (10, 10)) - drawn(centre, (7, 7))
    bright = np.clip(40_000 * ring * 60, 0, 65_535)
    # Pixels next to the rim at the right are full, outside and inside.
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    away, angle = np.hypot(x - centre[0], y - centre[1]), np.arctan2(y - centre[1], x - centre[0])
    bright[(away > 5.5) & (away < 11.6) & (np.abs(angle) < 0.5)] = 65_535
    (grey,) = find_discs(bright.astype(np.float32), Spectrum.RANGE, method="grey")
    (paper,) = find_discs(bright.astype(np.float32), Spectrum.RANGE, method="paper")
    assert abs(paper.centroid[0] - centre[0]) > 0.2
    assert abs(grey.centroid[0] - centre[0]) < 0.5 * abs(paper.centroid[0] - centre[0])


def test_noise_bars_and_discs_that_the_border_cuts_are_no_targets() -> None:
    rng = np.random.default_rng(4)
    noise = 0.5 * rng.standard_normal(SIZE).astype(np.float32)
    bar = np.zeros(SIZE, np.float32)
    bar[50:58, 20:90] = 30
    bar[80:110, 100:104] = 30
    cross = np.zeros(SIZE, np.float32)
    cross[40:80, 58:62] = cross[58:62, 40:80] = 30
    cut = 30 * drawn(np.array([5.0, 60.0]), (10, 9))
    for image in (noise, noise + bar, noise + cross, noise + cut, np.zeros(SIZE, np.float32)):
        assert find_discs(image.astype(np.float32), Spectrum.THERMAL) == []


def test_two_discs_and_a_speck_are_two_discs() -> None:
    bright = 30 * (drawn(np.array([40.0, 50.0]), (8, 8)) + drawn(np.array([110.0, 70.0]), (12, 9)))
    bright[10, 10:12] = 30
    found = find_discs(bright, Spectrum.THERMAL)
    assert sorted(round(float(disc.centroid[0])) for disc in found) == [40, 110]


def test_red_is_bright_and_grey_is_not_and_missing_temperatures_are_ground() -> None:
    image = np.array([[[200, 20, 30], [200, 200, 200], [20, 200, 20]]], np.uint8)
    assert brightness_of(image, Spectrum.COLOUR).tolist() == [[170, 0, -180]]
    kelvin = np.array([[290.0, np.nan, 300.0, 290.0]], np.float32)
    assert brightness_of(kelvin, Spectrum.THERMAL).tolist() == [[290, 290, 300, 290]]
    with pytest.raises(BadInputError, match="red rim"):
        brightness_of(image[..., 0], Spectrum.COLOUR)


def plane_range(camera: MountedCamera, normal: Floats, distance_m: float) -> Floats:
    """(H, W) range along each beam to a plane."""
    return distance_m / (camera.camera.rays() @ normal)


def disc_at(centre: Floats, radius_px: float) -> Disc:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = np.hypot(x - centre[0], y - centre[1]) < radius_px
    return Disc(centre, radius_px, np.argwhere(inside)[:, ::-1])


NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])


def test_the_range_of_a_tilted_target_is_that_of_its_plane_whatever_a_few_pixels_say() -> None:
    rng = np.random.default_rng(6)
    centre = np.array([60.3, 70.7])
    range_m = plane_range(TOF, NORMAL, 2.5)
    true = float(2.5 / (TOF.camera.unproject(centre) @ NORMAL))
    found = disc_range(disc_at(centre, 8), range_m, TOF)
    assert found is not None and found[0] == pytest.approx(true, abs=2e-4)
    wrong = range_m.copy()
    pixels = disc_at(centre, 8).pixels
    for x, y in pixels[rng.choice(len(pixels), len(pixels) // 5, replace=False)]:
        wrong[y, x] = rng.choice([np.nan, 1.0, 6.0])
    found = disc_range(disc_at(centre, 8), wrong, TOF)
    assert found is not None and found[0] == pytest.approx(true, abs=3e-3)


@pytest.mark.parametrize("radius_px", [2.5, 8.0])
def test_the_range_is_as_certain_as_it_says(radius_px: float) -> None:
    rng = np.random.default_rng(6)
    centre = np.array([60.3, 70.7])
    true = float(2.5 / (TOF.camera.unproject(centre) @ NORMAL))
    range_m = plane_range(TOF, NORMAL, 2.5)
    sigma_m = TOF.range_sigma_m(range_m)
    found = [
        disc_range(disc_at(centre, radius_px), range_m + sigma_m * rng.standard_normal(SIZE), TOF) for _ in range(300)
    ]
    misses = np.array([each[0] - true for each in found if each is not None])
    stated = np.sqrt([each[1] ** 2 - RELIEF_SIGMA_M**2 for each in found if each is not None])
    # Tukey's weights cost 5 % of the data, and few pixels more.
    assert np.std(misses) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.25)
    assert abs(misses.mean()) < 4 * misses.std() / np.sqrt(len(misses)) + 5e-4


def test_a_target_without_range_has_none() -> None:
    assert disc_range(disc_at(np.array([60.0, 60.0]), 6), np.full(SIZE, np.nan), TOF) is None


def test_what_is_unknown_of_the_range_bias_does_not_fall_with_the_number_of_pixels() -> None:
    unsure = ((4e-4,), (0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    bias = RangeBias(offset_m=0.0, scale=0.0, radial_m=0.0, covariance_lower=unsure)
    range_m, disc = plane_range(TOF, NORMAL, 2.5), disc_at(np.array([60.3, 70.7]), 12.0)
    sure, open_ = (disc_range(disc, range_m, each) for each in (TOF, TOF.model_copy(update={"range_bias": bias})))
    assert sure is not None and open_ is not None
    assert np.sqrt(open_[1] ** 2 - sure[1] ** 2) == pytest.approx(0.02, rel=1e-3)
