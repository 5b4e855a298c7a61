"""The standard noise, by its statistics: sigmas, means and what repeats, each against the parameter that states it.

Tolerances are about four standard errors of the sample at hand; seeds are fixed. What this does not show: that real
cameras are like this.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.poses import Transform, transform_points
from cairn_calib.rig.rig import Rig, Spectrum
from cairn_fusion.recording.scan import Scan
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import COUNT_MAX, ColourSensor, Noise, RangeSensor, Sensor, ThermalSensor
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, tof_head
from cairn_sim.robots.kinematics import T_FORWARD_CAMERA
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Surface

Floats = npt.NDArray[np.float64]

GREY = Material((128, 128, 128), 300.0, emissivity=1.0, reflectivity_nir=0.5)
AHEAD: Transform = T_FORWARD_CAMERA
"""A head at the origin that looks along x."""
BACK: Transform = placed((0, 0, 0), (0, 0, math.pi)) @ T_FORWARD_CAMERA
"""A head at the origin that looks along -x, at walls that the light falls on."""
ROUNDING = 12**-0.5
"""Sigma that rounding to whole numbers adds."""
QUIET_COLOUR = ColourSensor(read_sigma=0, shot_per_value=0)
QUIET_THERMAL = ThermalSensor(netd_k=0, fixed_pattern_k=0)
QUIET_RANGE = RangeSensor(amplitude_sigma=0, sigma_min_m=0, sigma_m=0, blooming=0)


def wall_at(distance_m: float, surface: Surface | Material = GREY, *, roll_rad: float = 0.0) -> Scene:
    """One wall of 200 m ahead, and one behind."""
    shown = surface if isinstance(surface, Surface) else Surface(surface)
    shape = Box((1, 200, 200))
    return scene_of(
        [
            Solid("ahead", shape, shown, placed((distance_m + 0.5, 0, 0), (roll_rad, 0, 0))),
            Solid("behind", shape, shown, placed((-distance_m - 0.5, 0, 0), (roll_rad, 0, 0))),
        ]
    )


def render(
    scene: Scene,
    rig: Rig,
    noise: Noise | None,
    number: int = 0,
    *,
    sensors: Mapping[str, Sensor] | None = None,
    T_map_rig: Transform = AHEAD,
    threads: int = 1,
) -> Scan:
    return render_scan(
        scene,
        rig,
        T_map_rig=T_map_rig,
        range_camera=RANGE_CAMERA,
        time_s=0.0,
        noise=noise,
        number=number,
        sensors=sensors,
        threads=threads,
    )


def amplitude_of(scan: Scan) -> Floats:
    assert scan.amplitude is not None
    return scan.amplitude.astype(np.float64)


def image_of(scan: Scan, name: str) -> npt.NDArray[Any]:
    if name in scan.colour:
        return scan.colour[name]
    return scan.thermal.get(name, scan.range_m)


def only(name: str, *, scale: float = 1.0) -> Rig:
    """The ToF camera and one other."""
    cameras = full_head(scale=scale).cameras
    return Rig(name="pair", cameras={RANGE_CAMERA: cameras[RANGE_CAMERA], name: cameras[name]})


# --- range ------------------------------------------------------------------------------------------------------


def test_range_sigma_is_one_centimetre_for_grey_seen_head_on_at_three_metres() -> None:
    middle = np.s_[62:82, 78:98]
    exact = render(wall_at(3.0), tof_head(), None).range_m[middle]
    errors = np.stack([render(wall_at(3.0), tof_head(), Noise(1), n).range_m[middle] - exact for n in range(20)])
    assert errors.std() == pytest.approx(0.01, rel=4 / math.sqrt(2 * errors.size) + 0.01)
    assert abs(errors.mean()) < 4 * 0.01 / math.sqrt(errors.size)


@pytest.mark.parametrize(
    ("distance_m", "reflectivity"), [(0.8, 0.9), (1.5, 0.5), (3.0, 0.5), (3.0, 0.2), (4.5, 0.5), (6.0, 0.6)]
)
def test_range_sigma_falls_with_the_amplitude_between_its_bounds_and_the_mean_is_right(
    distance_m: float, reflectivity: float
) -> None:
    scene = wall_at(distance_m, replace(GREY, reflectivity_nir=reflectivity))
    exact = render(scene, tof_head(), None)
    amplitude = amplitude_of(exact)
    # By hand: grey at 3 m returns 20 000 x 0.5 / 9, and has 1 cm; s0 is the least.
    s1 = math.sqrt(0.01**2 - 0.005**2) * (20_000 * 0.5 / 9)
    sigma = np.minimum(np.sqrt(0.005**2 + (s1 / np.maximum(amplitude, 1)) ** 2), 0.03)
    strong = amplitude > 200
    errors = [((render(scene, tof_head(), Noise(2), n).range_m - exact.range_m) / sigma)[strong] for n in range(4)]
    z = np.concatenate(errors)
    assert len(z) > 5000 and not np.isnan(z).any()
    assert z.std() == pytest.approx(1.0, abs=4 / math.sqrt(2 * len(z)) + 0.003)
    assert abs(z.mean()) < 4 / math.sqrt(len(z))


def test_amplitude_has_the_stated_sigma_and_no_bias() -> None:
    exact, noisy = (amplitude_of(render(wall_at(3.0), tof_head(), noise)) for noise in (None, Noise(3)))
    errors = (noisy - exact)[exact > 100]
    assert errors.std() == pytest.approx(math.hypot(6.0, ROUNDING), rel=4 / math.sqrt(2 * errors.size))
    assert abs(errors.mean()) < 4 * 6.0 / math.sqrt(errors.size)


def test_pixels_at_a_depth_edge_have_the_phase_and_the_length_of_the_sum_of_their_waves() -> None:
    near_m, far_m, edge_m = 2.0, 4.0, 0.137
    surface = Surface(GREY)
    scene = scene_of(
        [
            Solid("near", Box((0.2, 100, 200)), surface, placed((near_m + 0.1, edge_m - 50, 0))),
            Solid("far", Box((1, 200, 200)), surface, placed((far_m + 0.5, 0, 0))),
        ]
    )
    rig = tof_head()
    scan = render(scene, rig, Noise(4), sensors={RANGE_CAMERA: QUIET_RANGE})
    exact = render(scene, rig, None)
    mixed = np.argwhere(np.abs(scan.range_m - exact.range_m) > 1e-4)
    assert len(mixed) > 100
    ranges, lengths = [], []
    for y, x in mixed:
        wave = 0j
        for j in range(4):
            for i in range(4):
                dx, dy = (i + (j + 0.5) / 4) / 4 - 0.5, (j + 1 - (i + 0.5) / 4) / 4 - 0.5
                ray = rig[RANGE_CAMERA].camera.unproject(np.array([x + dx, y + dy]))
                ray = ray / np.linalg.norm(ray)
                forward, left, _ = AHEAD[:3, :3] @ ray
                depth_m = near_m if left / forward * near_m < edge_m else far_m
                path_m = depth_m / forward
                wave += 20_000 * 0.5 * forward / path_m**2 * np.exp(2j * math.pi * path_m / 10)
        ranges.append(np.angle(wave) / (2 * math.pi) % 1 * 10)
        lengths.append(abs(wave) / 16)
    # The renderer's finer rays are right to 0.01 px, so now and then one of the 16 falls on the other side.
    off_m = np.abs(scan.range_m[tuple(mixed.T)] - ranges)
    assert np.quantile(off_m, 0.9) < 1e-3
    np.testing.assert_allclose(np.median(amplitude_of(scan)[tuple(mixed.T)] / lengths), 1, atol=2e-3)
    # Less than half a turn apart, a mixed range lies between the two: a flying pixel.
    beam = 1 / rig[RANGE_CAMERA].camera.rays()[..., 2]
    flying = (scan.range_m > 1.01 * near_m * beam) & (scan.range_m < 0.99 * far_m * beam)
    assert flying.sum() > 0.5 * len(mixed)
    assert (scan.range_m > 0.98 * near_m * beam).all() and (scan.range_m < 1.02 * far_m * beam).all()


def test_what_is_farther_than_the_wrap_comes_back_near_if_it_returns_enough() -> None:
    middle = np.s_[67:77, 83:93]
    bright = render(wall_at(11.5, replace(GREY, retroreflection=4.0)), tof_head(), Noise(5)).range_m[middle]
    assert np.median(bright) == pytest.approx(1.5, abs=0.02)
    assert np.isnan(render(wall_at(11.5), tof_head(), Noise(5)).range_m[middle]).all()
    assert np.isnan(render(wall_at(11.5), tof_head(), None).range_m).all()


def test_too_much_light_leaves_the_greatest_amplitude_and_no_range() -> None:
    scan = render(wall_at(2.0, replace(GREY, retroreflection=600.0)), tof_head(), Noise(6))
    assert (amplitude_of(scan) == COUNT_MAX).all()
    assert np.isnan(scan.range_m).all()


def test_a_full_pixel_spills_on_average_its_share_and_others_nothing() -> None:
    sensor, received = RangeSensor(), np.full(400_000, 80_000, np.float32)
    received[::2] = 65_534
    spill = sensor.spill(received, np.random.default_rng(7))
    assert not spill[::2].any() and (spill[1::2] > 0).all()
    spread = math.sqrt(math.exp(sensor.blooming_spread**2) - 1)
    share = spill[1::2].mean() / (80_000 - COUNT_MAX)
    assert share == pytest.approx(sensor.blooming, rel=4 * spread / math.sqrt(200_000))


def test_blooming_changes_no_image_in_which_no_pixel_is_full() -> None:
    with_it, without = (
        render(wall_at(2.0), tof_head(), Noise(8), sensors={RANGE_CAMERA: RangeSensor(blooming=b)}) for b in (0.5, 0.0)
    )
    assert with_it.range_m.tobytes() == without.range_m.tobytes()
    np.testing.assert_array_equal(amplitude_of(with_it), amplitude_of(without))


# --- thermal ----------------------------------------------------------------------------------------------------

STEP_K = ROUNDING / ThermalSensor().counts_per_kelvin
"""Error by rounding to counts, kelvin."""


@pytest.mark.parametrize("name", ["thermal_left", "thermal_right"])
def test_two_thermal_images_differ_by_the_temporal_noise(name: str) -> None:
    one, two = (render(wall_at(3.0), only(name), Noise(1), n).thermal[name] for n in (0, 1))
    assert (one - two).std() / math.sqrt(2) == pytest.approx(math.hypot(0.05, STEP_K), rel=0.01)


@pytest.mark.parametrize("name", ["thermal_left", "thermal_right"])
def test_the_mean_of_many_thermal_images_shows_the_fixed_pattern(name: str) -> None:
    rig, images = only(name, scale=0.25), 60
    mean = np.mean([render(wall_at(3.0), rig, Noise(2), n).thermal[name] for n in range(images)], axis=0)
    left = math.hypot(0.05, STEP_K) / math.sqrt(images)
    assert mean.std() == pytest.approx(math.hypot(0.05, left), rel=4 / math.sqrt(2 * mean.size))
    assert mean.mean() == pytest.approx(300.0, abs=4 * 0.05 / math.sqrt(mean.size))
    pattern = Noise(2).fixed_pattern(name, mean.shape)
    assert np.corrcoef(mean.ravel(), pattern.ravel())[0, 1] > 0.98


def test_fixed_patterns_of_other_cameras_and_seeds_are_others() -> None:
    shape = (512, 640)
    patterns = [
        Noise(1).fixed_pattern("a", shape),
        Noise(1).fixed_pattern("b", shape),
        Noise(2).fixed_pattern("a", shape),
    ]
    correlation = np.corrcoef([pattern.ravel() for pattern in patterns]) - np.eye(3)
    assert np.abs(correlation).max() < 5 / math.sqrt(512 * 640)
    assert Noise(1).fixed_pattern("a", shape).tobytes() == patterns[0].tobytes()


def test_kelvin_undoes_counts() -> None:
    sensor, kelvin = ThermalSensor(), np.linspace(200.0, 800.0, 1201)
    np.testing.assert_allclose(sensor.kelvin_of(sensor.counts_of(kelvin)), kelvin, rtol=1e-12)
    assert sensor.counts_per_kelvin == pytest.approx(40, rel=0.05)
    assert (np.diff(sensor.counts_of(kelvin)) > 0).all()


def test_a_surface_that_mirrors_shows_the_surroundings_share() -> None:
    sensor, metal = ThermalSensor(), replace(GREY, emissivity=0.3, temperature_k=350.0)
    seen = render(wall_at(2.0, metal), only("thermal_left", scale=0.1), None).thermal["thermal_left"]
    counts = 0.3 * sensor.counts_of(np.array(350.0)) + 0.7 * sensor.counts_of(np.array(293.15))
    np.testing.assert_allclose(seen, sensor.kelvin_of(counts), atol=1e-3)


# --- colour -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [25, 100, 180, 240])
def test_colour_sigma_grows_from_three_in_black_to_three_and_three_quarters_in_white(value: int) -> None:
    name, sensor = "colour_left", ColourSensor(vignetting=0)
    scene, rig = wall_at(2.0, replace(GREY, colour_srgb=(value, value, value))), only("colour_left", scale=0.5)
    images = [
        render(scene, rig, noise, sensors={name: sensor}, T_map_rig=BACK).colour[name].astype(np.float64)
        for noise in (None, Noise(3))
    ]
    errors = images[1] - images[0]
    expected = math.hypot(math.sqrt(9.0 + 0.02 * images[0].mean()), ROUNDING)
    assert errors.std() == pytest.approx(expected, rel=4 / math.sqrt(2 * errors.size) + 0.001)
    # The exact image is rounded, so its mean may be off by half a value.
    assert abs(errors.mean()) < 0.51
    np.testing.assert_allclose(sensor.sigma(np.array([0.0, 255.0])), [3.0, 3.75], atol=0.01)


def test_vignetting_dims_light_by_the_fourth_power_of_the_cosine() -> None:
    name, rig, scene = (
        "colour_left",
        only("colour_left", scale=0.25),
        wall_at(2.0, replace(GREY, colour_srgb=(250,) * 3)),
    )
    exact, dimmed = (
        render(scene, rig, noise, sensors={name: QUIET_COLOUR}, T_map_rig=BACK).colour[name].astype(np.float64)
        for noise in (None, Noise(1))
    )
    cosine = rig[name].camera.rays()[..., 2]
    assert cosine.min() < 0.9
    np.testing.assert_allclose((dimmed / exact)[..., 1] ** 2.2, cosine**4, atol=0.015)


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("colour_left", replace(QUIET_COLOUR, vignetting=0)),
        ("colour_right", replace(QUIET_COLOUR, vignetting=0, blur_px=1.2)),
        ("thermal_left", QUIET_THERMAL),
        ("thermal_right", replace(QUIET_THERMAL, blur_px=1.5)),
    ],
)
def test_an_edge_is_spread_by_the_blur_and_the_pixels_area(name: str, sensor: ColourSensor | ThermalSensor) -> None:
    dark = replace(GREY, colour_srgb=(10, 10, 10), temperature_k=290.0)
    light = replace(GREY, colour_srgb=(250, 250, 250), temperature_k=310.0)
    scene = wall_at(2.0, Surface(light, dark, (100.0, math.inf)), roll_rad=0.1)
    scan = render(scene, only(name, scale=0.5), Noise(1), sensors={name: sensor}, T_map_rig=BACK)
    image = image_of(scan, name).astype(np.float64)
    rows = image[..., 1] if image.ndim == 3 else image
    if isinstance(sensor, ThermalSensor):
        rows = sensor.counts_of(rows)
    steps = np.diff(rows, axis=1)
    x = np.arange(steps.shape[1])
    middle = np.rint((steps * x).sum(axis=1) / steps.sum(axis=1)).astype(int)
    variances = []
    for row, at in zip(steps, middle, strict=True):
        w, near = row[at - 8 : at + 9], x[at - 8 : at + 9]
        centre = (w * near).sum() / w.sum()
        variances.append((w * (near - centre) ** 2).sum() / w.sum())
    # Differences of neighbours are means over a pixel once more: 1/12 of a pixel squared on top of the area's.
    area = (1 - 1 / sensor.fineness**4) / 12
    assert math.sqrt(np.mean(variances) - area - 1 / 12) == pytest.approx(sensor.blur_px, rel=0.05)


# --- all of them --------------------------------------------------------------------------------------------------

CAMERAS = sorted(full_head().cameras)


@pytest.fixture(scope="module")
def scans() -> dict[str, Scan]:
    scene, rig = wall_at(3.0), full_head(scale=0.1)
    return {
        "first": render(scene, rig, Noise(7)),
        "again": render(scene, rig, Noise(7)),
        "threads": render(scene, rig, Noise(7), threads=4),
        "number": render(scene, rig, Noise(7), 1),
        "seed": render(scene, rig, Noise(8)),
        "exact": render(scene, rig, None),
        "exact number": render(scene, rig, None, 1),
    }


@pytest.mark.parametrize("name", CAMERAS)
def test_the_seed_fixes_every_byte_on_any_number_of_threads(scans: dict[str, Scan], name: str) -> None:
    first = image_of(scans["first"], name).tobytes()
    assert image_of(scans["again"], name).tobytes() == first
    assert image_of(scans["threads"], name).tobytes() == first


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("other", ["number", "seed", "exact"])
def test_another_number_or_seed_gives_other_bytes(scans: dict[str, Scan], name: str, other: str) -> None:
    assert image_of(scans["first"], name).tobytes() != image_of(scans[other], name).tobytes()


@pytest.mark.parametrize("name", CAMERAS)
def test_without_noise_all_images_of_a_view_are_one(scans: dict[str, Scan], name: str) -> None:
    assert image_of(scans["exact"], name).tobytes() == image_of(scans["exact number"], name).tobytes()


@pytest.mark.parametrize("name", CAMERAS)
def test_without_noise_a_pixel_holds_what_its_centre_shows(scans: dict[str, Scan], name: str) -> None:
    image, mounted = image_of(scans["exact"], name), full_head(scale=0.1)[name]
    T_map_camera = AHEAD @ mounted.transform
    rays = transform_points(T_map_camera, mounted.camera.rays()) - T_map_camera[:3, 3]
    if mounted.spectrum is Spectrum.RANGE:
        np.testing.assert_allclose(image, (3.0 - T_map_camera[0, 3]) / rays[..., 0], rtol=1e-7)
    elif mounted.spectrum is Spectrum.THERMAL:
        np.testing.assert_allclose(image, 300.0, rtol=1e-6)
    else:
        assert len(np.unique(image)) == 1


@pytest.mark.parametrize("spectrum", [Spectrum.COLOUR, Spectrum.THERMAL])
def test_two_cameras_at_one_place_have_noise_of_their_own(spectrum: Spectrum) -> None:
    twin = full_head(scale=0.1)[f"{spectrum}_left"]
    rig = Rig(name="twins", cameras={**tof_head().cameras, "one": twin, "two": twin})
    exact, noisy = render(wall_at(3.0), rig, None), render(wall_at(3.0), rig, Noise(1))
    assert image_of(exact, "one").tobytes() == image_of(exact, "two").tobytes()
    assert image_of(noisy, "one").tobytes() != image_of(noisy, "two").tobytes()


def test_two_range_cameras_at_one_place_have_noise_of_their_own() -> None:
    rig = Rig(name="twins", cameras={name: tof_head()[RANGE_CAMERA] for name in ("one", "two")})
    one, two = (
        render_scan(wall_at(3.0), rig, T_map_rig=AHEAD, range_camera=name, time_s=0.0, noise=Noise(1))
        for name in rig.cameras
    )
    assert one.range_m.tobytes() != two.range_m.tobytes()
