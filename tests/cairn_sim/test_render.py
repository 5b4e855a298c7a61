"""Images of known rooms: exact without a generator, repeatable and as noisy as stated with one."""

import numpy as np
import pytest

from cairn_calib.camera import camera_from_field_of_view
from cairn_calib.poses import Transform, inverse, look_at, transform_points
from cairn_calib.rig import Rig, Spectrum
from cairn_fusion.scan import Scan, check_scan
from cairn_map.errors import BadInputError
from cairn_sim.drive import head_poses, stops
from cairn_sim.heads import (
    RANGE_CAMERA,
    colour_and_tof_head,
    full_head,
    thermal_and_tof_head,
    tof_head,
)
from cairn_sim.render import cast, range_sigma_m, render_scan
from cairn_sim.room import Box, Room, Surface, room_of, small_room

WALL = Surface((200, 100, 50), 300.0, 0.5)
AT_WALL: Transform = look_at((0, 0, 0), (1, 0, 0))


def wall_at(distance_m: float, surface: Surface = WALL) -> Room:
    """One endless wall across the x axis."""
    return room_of([Box("wall", surface, (distance_m + 0.5, 0, 0), (1, 1000, 1000))])


def render(room: Room, rig: Rig, T_map_rig: Transform, *, seed: int | None = None) -> Scan:
    rng = None if seed is None else np.random.default_rng(seed)
    return render_scan(room, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=12.5, rng=rng)


def test_wall_has_the_range_of_the_plane_along_each_beam() -> None:
    scan = render(wall_at(3.0), tof_head(), AT_WALL)
    expected = 3.0 / tof_head()[RANGE_CAMERA].camera.rays()[..., 2]
    np.testing.assert_allclose(scan.range_m, expected, rtol=1e-7, atol=0)


def test_ranges_in_the_small_room_are_those_of_its_planes() -> None:
    room, rig = small_room(), tof_head()
    for T_map_rig in head_poses(stops("east")[2], n_yaw=6, n_pitch=2):
        scan = render(room, rig, T_map_rig)
        hits = cast(room, rig[RANGE_CAMERA].camera, T_map_rig)
        directions = rig[RANGE_CAMERA].camera.rays() @ T_map_rig[:3, :3].T
        for name, axis, plane_m in (
            ("floor", 2, 0.0),
            ("ceiling", 2, 2.6),
            ("wall east", 0, 6.0),
            ("wall west", 0, 0.0),
        ):
            seen = hits.solid == [s.name for s in room.solids].index(name)
            expected = (plane_m - T_map_rig[axis, 3]) / directions[seen][:, axis]
            np.testing.assert_allclose(scan.range_m[seen], expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", ["tof", "colour_left", "colour_right", "thermal_left", "thermal_right"])
def test_hit_points_project_to_the_centres_of_their_pixels(name: str) -> None:
    mounted = full_head(scale=0.125)[name]
    T_map_camera = head_poses(stops("west")[4], n_yaw=5, n_pitch=1)[2] @ mounted.transform
    hits = cast(small_room(), mounted.camera, T_map_camera)
    points = T_map_camera[:3, 3] + hits.range_m[..., None] * (mounted.camera.rays() @ T_map_camera[:3, :3].T)
    pixels = mounted.camera.project(transform_points(inverse(T_map_camera), points))
    x, y = np.meshgrid(np.arange(mounted.camera.width), np.arange(mounted.camera.height))
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), rtol=0, atol=1e-6)
    assert np.abs(small_room().distance_m(points)).max() < 1e-9


@pytest.mark.parametrize(
    "rig", [full_head(scale=0.25), colour_and_tof_head(scale=0.25), thermal_and_tof_head(scale=0.25), tof_head()]
)
def test_every_head_renders_a_scan_that_fits_its_rig(rig: Rig) -> None:
    scan = render(small_room(), rig, head_poses(stops("doorway")[0], n_yaw=3, n_pitch=1)[1], seed=1)
    check_scan(scan, rig)
    assert {*scan.colour, *scan.thermal, scan.range_camera} == set(rig.cameras)
    assert scan.time_s == 12.5


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    pose = head_poses(stops("west")[0], n_yaw=4, n_pitch=1)[0]
    rig = full_head(scale=0.1)
    one, same, other = (render(small_room(), rig, pose, seed=seed) for seed in (7, 7, 8))
    for name in one.colour:
        assert one.colour[name].tobytes() == same.colour[name].tobytes() != other.colour[name].tobytes()
    for name in one.thermal:
        assert one.thermal[name].tobytes() == same.thermal[name].tobytes() != other.thermal[name].tobytes()
    assert one.range_m.tobytes() == same.range_m.tobytes() != other.range_m.tobytes()


def test_noise_has_the_stated_sigma() -> None:
    rig = full_head(scale=0.25)
    true, noisy = render(wall_at(3.0), rig, AT_WALL), render(wall_at(3.0), rig, AT_WALL, seed=3)
    colour = noisy.colour["colour_left"].astype(float) - true.colour["colour_left"]
    # Rounding to whole values adds 1/12.
    assert colour.std() == pytest.approx(np.hypot(3.0, 12**-0.5), rel=0.02)
    thermal = noisy.thermal["thermal_right"] - true.thermal["thermal_right"]
    assert thermal.std() == pytest.approx(0.05, rel=0.02)
    assert abs(float(thermal.mean())) < 0.002
    assert true.amplitude is not None
    normalised = (noisy.range_m - true.range_m) / range_sigma_m(true.amplitude)
    assert normalised.std() == pytest.approx(1.0, rel=0.02)


def test_range_sigma_is_one_centimetre_for_grey_at_three_metres_and_stays_in_bounds() -> None:
    scan = render(wall_at(3.0), tof_head(), AT_WALL)
    assert scan.amplitude is not None
    assert range_sigma_m(scan.amplitude)[72, 88] == pytest.approx(0.01, rel=0.01)
    ends = range_sigma_m(np.array([[0, 1, 65535]], dtype=np.uint16))
    np.testing.assert_allclose(ends, [[0.03, 0.03, 0.005]], atol=1e-4)


def test_amplitude_falls_with_distance_squared_with_reflectivity_and_with_slant() -> None:
    def middle(room: Room, T_map_rig: Transform) -> float:
        scan = render(room, tof_head(), T_map_rig)
        assert scan.amplitude is not None
        return float(scan.amplitude[72, 88])

    near = middle(wall_at(1.0), AT_WALL)
    assert middle(wall_at(2.0), AT_WALL) == pytest.approx(near / 4, rel=0.01)
    assert middle(wall_at(1.0, Surface((0, 0, 0), 300.0, 0.25)), AT_WALL) == pytest.approx(near / 2, rel=0.01)
    # Turned by 60 degrees the beam is twice as long and meets the wall at half the cosine.
    slanted = look_at((0, 0, 0), (0.5, np.sqrt(0.75), 0))
    assert middle(wall_at(1.0), slanted) == pytest.approx(near / 8, rel=0.05)


def test_beyond_ten_metres_and_into_nothing_there_is_no_range() -> None:
    far = render(wall_at(10.5), full_head(scale=0.1), AT_WALL)
    assert np.isnan(far.range_m).all()
    assert far.amplitude is not None and not far.amplitude.any()
    assert (far.thermal["thermal_left"] == 300).all()
    away = render(wall_at(1.0), full_head(scale=0.1), look_at((0, 0, 0), (-1, 0, 0)), seed=2)
    assert np.isnan(away.range_m).all()
    assert np.isnan(away.thermal["thermal_left"]).all()
    assert away.colour["colour_left"].mean() < 3


def test_thermal_image_shows_the_radiator_hot_and_the_tank_cold() -> None:
    room, rig = small_room(), thermal_and_tof_head(scale=0.25)
    radiator = render(room, rig, look_at((2, 2, 1.1), (0, 2, 0.5)), seed=1).thermal["thermal_left"]
    tank = render(room, rig, look_at((5.5, 2.5, 1.1), (5.5, 0.5, 0.6)), seed=1).thermal["thermal_left"]
    assert radiator[64, 80] == pytest.approx(330, abs=0.3)
    assert tank[64, 80] == pytest.approx(278, abs=0.3)
    assert np.median(radiator) == pytest.approx(293, abs=2)


def test_a_place_has_one_colour_from_wherever_it_is_seen() -> None:
    rig, room, place = colour_and_tof_head(scale=0.25), small_room(), np.array([1.23, 1.87, 0.0])
    seen = []
    for eye in ((0.9, 1.0, 1.1), (2.6, 3.1, 1.1), (2.2, 2.3, 1.6)):
        T_map_rig = look_at(eye, place)
        mounted = rig["colour_left"]
        pixel = mounted.camera.project(transform_points(inverse(T_map_rig @ mounted.transform), place))
        x, y = np.rint(pixel).astype(int)
        seen.append(render(room, rig, T_map_rig).colour["colour_left"][y, x].tolist())
    assert seen[0] == seen[1] == seen[2]


def test_checkerboard_turns_every_period() -> None:
    board = Surface((255, 0, 0), 293.0, 0.5, (0, 0, 255), (0.5, 0.5))
    camera = camera_from_field_of_view(9, 1, horizontal_deg=2 * np.degrees(np.arctan(2.25)))
    rig = Rig(
        name="line",
        cameras={
            **tof_head().cameras,
            "eye": full_head()["colour_left"].model_copy(
                update={"camera": camera, "T_rig_camera": tof_head()[RANGE_CAMERA].T_rig_camera}
            ),
        },
    )
    # Pixels half a metre apart on a wall at 1 m, each in the middle of a square.
    scan = render(wall_at(1.0, board), rig, look_at((0, 0.25, 0.25), (1, 0.25, 0.25)))
    red = scan.colour["eye"][0, :, 0] > 0
    assert red.tolist() == [True, False] * 4 + [True] or red.tolist() == [False, True] * 4 + [False]


def test_camera_inside_a_solid_or_of_another_spectrum_is_refused() -> None:
    with pytest.raises(BadInputError, match="one in pillar"):
        render(small_room(), tof_head(), look_at((1.8, 3.1, 1), (0, 0, 1)))
    rig = colour_and_tof_head(scale=0.1)
    with pytest.raises(BadInputError, match="must be a range camera"):
        render_scan(small_room(), rig, T_map_rig=AT_WALL, range_camera="colour_left", time_s=0, rng=None)
    assert rig["colour_left"].spectrum is Spectrum.COLOUR
