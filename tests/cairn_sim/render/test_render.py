"""Images of known scenes: exact without noise, repeatable with it."""

import math

import cv2
import numpy as np
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.poses import Transform, inverse, look_at, transform_points
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.recording.scan import Scan, check_scan
from cairn_fusion.transfer.transfer import points_from_range
from cairn_map.errors import BadInputError
from cairn_sim.render.rays import cast, cast_directions
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import (
    RANGE_CAMERA,
    colour_and_tof_head,
    full_head,
    handheld_head,
    lidar_head,
    thermal_and_tof_head,
    tof_head,
)
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.scene.solids import Box, Plane, Solid, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

ROOM = load_scene("small-room")
WALL = Surface(Material((200, 100, 50), 300.0, emissivity=1.0, reflectivity_nir=0.5))
AT_WALL: Transform = look_at((0, 0, 0), (1, 0, 0))
HEADS = {
    "full": full_head(scale=0.125),
    "ideal": full_head(scale=0.125, ideal=True),
    "colour": colour_and_tof_head(scale=0.25),
    "thermal": thermal_and_tof_head(scale=0.25),
    "tof": tof_head(),
    "handheld": handheld_head(scale=0.5),
    "lidar": lidar_head(),
}


def wall(distance_m: float, surface: Surface = WALL, *, name: str = "wall") -> Solid:
    """One endless wall across the x axis."""
    return Solid(name, Box((1, 1000, 1000)), surface, placed((distance_m + 0.5, 0, 0)))


def pane(distance_m: float, surface: Surface) -> Solid:
    return Solid("pane", Box((0.01, 1000, 1000)), surface, placed((distance_m + 0.005, 0, 0)))


def render(scene: Scene, rig: Rig, T_map_rig: Transform, *, seed: int | None = None) -> Scan:
    noise = None if seed is None else Noise(seed)
    return render_scan(scene, rig, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=12.5, noise=noise)


def head_pose(scene: Scene, path: str, *, stop: int, scan: int) -> Transform:
    return ROBOTS["orpheus"].head_poses(stops(scene, path)[stop])[scan]


def test_wall_has_the_range_of_the_plane_along_each_beam() -> None:
    scan = render(scene_of([wall(3.0)]), tof_head(), AT_WALL)
    expected = 3.0 / tof_head()[RANGE_CAMERA].camera.rays()[..., 2]
    np.testing.assert_allclose(scan.range_m, expected, rtol=1e-7, atol=0)


def test_equation_4_holds_to_the_last_bit_of_the_image_without_distortion() -> None:
    rig = tof_head(ideal=True)
    camera = rig[RANGE_CAMERA].camera
    d = render(scene_of([wall(3.0)]), rig, AT_WALL).range_m.astype(np.float64)
    (f, _), (cx, cy) = camera.focal_px, camera.centre_px  # type: ignore[union-attr]
    x, y = np.meshgrid(np.arange(camera.width) - cx, np.arange(camera.height) - cy)
    Z = d * f / np.sqrt(x * x + y * y + f * f)
    np.testing.assert_allclose(Z, 3.0, rtol=1e-7, atol=0)
    np.testing.assert_allclose(points_from_range(d, camera), np.stack([Z * x / f, Z * y / f, Z], axis=-1), atol=1e-12)


def test_ranges_in_the_small_room_are_those_of_its_planes() -> None:
    rig = tof_head()
    for scan_number in (3, 15, 30):
        T_map_rig = head_pose(ROOM, "east", stop=2, scan=scan_number)
        scan = render(ROOM, rig, T_map_rig)
        hits = cast(ROOM, rig[RANGE_CAMERA].camera, T_map_rig)
        directions = rig[RANGE_CAMERA].camera.rays() @ T_map_rig[:3, :3].T
        for name, axis, plane_m in (
            ("floor", 2, 0.0),
            ("ceiling", 2, 2.6),
            ("wall east", 0, 6.0),
            ("wall west", 0, 0.0),
        ):
            seen = (hits.solid == ROOM.number_of(name)).reshape(scan.range_m.shape)
            expected = (plane_m - T_map_rig[axis, 3]) / directions[seen][:, axis]
            np.testing.assert_allclose(scan.range_m[seen], expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("head", list(HEADS))
@pytest.mark.parametrize("scene", ["small-room", "building"])
def test_hit_points_project_to_the_centres_of_their_pixels(head: str, scene: str) -> None:
    known = load_scene(scene)
    T_map_rig = head_pose(known, "west" if scene == "small-room" else "labs", stop=4, scan=14)
    for eye in HEADS[head].cameras.values():
        T_map_camera = T_map_rig @ eye.transform
        hits = cast(known, eye.camera, T_map_camera)
        shape = eye.camera.height, eye.camera.width
        rays = eye.camera.rays() @ T_map_camera[:3, :3].T
        points = T_map_camera[:3, 3] + hits.range_m.reshape(*shape, 1) * rays
        pixels = eye.camera.project(transform_points(inverse(T_map_camera), points))
        x, y = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
        np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), rtol=0, atol=1e-6)
        assert np.abs(known.distance_m(points)).max() < 1e-9


def test_full_images_project_back_too() -> None:
    eye = full_head()["colour_left"]
    T_map_camera = head_pose(ROOM, "west", stop=1, scan=17) @ eye.transform
    hits = cast(ROOM, eye.camera, T_map_camera)
    points = hits.range_m[:, None] * eye.camera.rays().reshape(-1, 3)
    pixels = eye.camera.project(points).reshape(960, 1280, 2)
    x, y = np.meshgrid(np.arange(1280), np.arange(960))
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("head", list(HEADS))
def test_every_head_renders_a_scan_that_fits_its_rig(head: str) -> None:
    rig = HEADS[head]
    for seed in (None, 1):
        scan = render(ROOM, rig, head_pose(ROOM, "doorway", stop=0, scan=13), seed=seed)
        check_scan(scan, rig)
        assert {*scan.colour, *scan.thermal, scan.range_camera} == set(rig.cameras)
        assert scan.time_s == 12.5
        assert np.isfinite(scan.range_m).mean() > 0.5


def test_thermal_images_show_what_is_emitted_and_what_is_mirrored() -> None:
    rig = thermal_and_tof_head(scale=0.1)
    black, half, bare = (
        render(
            scene_of([wall(3.0, Surface(Material(temperature_k=330.0, emissivity=e)))], ambient_k=290.0), rig, AT_WALL
        ).thermal["thermal_left"]
        for e in (1.0, 0.5, 0.05)
    )
    np.testing.assert_allclose(black, 330.0, atol=1e-3)
    assert 308 < half.mean() < 315 and half.std() < 1e-3
    assert 290 < bare.mean() < 293


def test_nothing_is_the_sky() -> None:
    scene = scene_of(
        [Solid("post", Box((0.1, 0.1, 0.1)), WALL, placed((-5, 0, 0)))], sky_k=255.0, sky_srgb=(10, 20, 30)
    )
    scan = render(scene, full_head(scale=0.1), AT_WALL)
    assert np.isnan(scan.range_m).all() and scan.amplitude is not None and not scan.amplitude.any()
    np.testing.assert_allclose(scan.thermal["thermal_left"], 255.0, atol=1e-3)
    assert (scan.colour["colour_left"] == (10, 20, 30)).all()


def test_a_pane_is_air_for_colour_and_range_and_a_wall_for_thermal() -> None:
    glass = Surface(Material(temperature_k=280.0, emissivity=1.0, optics=Optics.GLASS))
    scan = render(scene_of([wall(3.0), pane(1.0, glass)]), full_head(scale=0.1, ideal=True), AT_WALL)
    np.testing.assert_allclose(scan.range_m[72, 88], 3.0, rtol=1e-4)
    np.testing.assert_allclose(scan.thermal["thermal_left"], 280.0, atol=1e-3)
    plain = render(scene_of([wall(3.0)]), full_head(scale=0.1, ideal=True), AT_WALL)
    np.testing.assert_allclose(
        scan.colour["colour_left"].astype(float), 0.85 * plain.colour["colour_left"], rtol=0, atol=1
    )
    assert scan.amplitude is not None and plain.amplitude is not None
    np.testing.assert_allclose(scan.amplitude, 0.85**2 * plain.amplitude.astype(float), rtol=0.01)


def test_a_mirror_shows_the_wall_behind_the_camera_at_the_length_of_the_way() -> None:
    behind = Solid("behind", Box((1, 1000, 1000)), WALL, placed((-2.5, 0, 0)))
    mirror = Surface(Material(temperature_k=280.0, emissivity=1.0, optics=Optics.MIRROR))
    scan = render(scene_of([behind, pane(1.0, mirror)]), full_head(scale=0.1, ideal=True), AT_WALL)
    np.testing.assert_allclose(scan.range_m[72, 88], 4.0, rtol=1e-4)
    np.testing.assert_allclose(scan.thermal["thermal_right"], 280.0, atol=1e-3)
    assert scan.colour["colour_left"].any()


def test_amplitude_falls_with_distance_squared_with_reflectivity_and_with_slant() -> None:
    def middle(distance_m: float, T_map_rig: Transform, reflectivity: float = 0.5) -> float:
        surface = Surface(Material(reflectivity_nir=reflectivity))
        scan = render(scene_of([wall(distance_m, surface)]), tof_head(ideal=True), T_map_rig)
        assert scan.amplitude is not None
        return float(scan.amplitude[72, 88])

    near = middle(1.0, AT_WALL)
    assert middle(2.0, AT_WALL) == pytest.approx(near / 4, rel=0.01)
    assert middle(1.0, AT_WALL, 0.25) == pytest.approx(near / 2, rel=0.01)
    # Turned by 60 degrees the beam is twice as long and meets the wall at half the cosine.
    slanted = look_at((0, 0, 0), (0.5, math.sqrt(0.75), 0))
    assert middle(1.0, slanted) == pytest.approx(near / 8, rel=0.05)


def test_perfect_range_ends_at_ten_metres() -> None:
    assert np.isnan(render(scene_of([wall(10.1)]), tof_head(), AT_WALL).range_m).all()
    scan = render(scene_of([wall(9.9)]), tof_head(ideal=True), AT_WALL)
    assert np.isfinite(scan.range_m[72, 88]) and np.isnan(scan.range_m[0, 0])


def test_the_place_of_a_surface_has_one_colour_from_wherever_it_is_seen() -> None:
    rig = full_head(scale=0.5)
    poses = [look_at((2.5, 2.5, 1.3), (6, 2.0, 1.0)), look_at((4.9, 2.2, 1.4), (6, 2.0, 1.0))]
    point = np.array([6.0, 2.0, 1.0])
    seen = []
    for T_map_rig in poses:
        image = render(ROOM, rig, T_map_rig).colour["colour_left"]
        pixel = rig["colour_left"].camera.project(
            transform_points(inverse(T_map_rig @ rig["colour_left"].transform), point)
        )
        x, y = np.rint(pixel).astype(int)
        seen.append(image[y, x])
    assert np.abs(np.diff(np.array(seen, dtype=int), axis=0)).max() <= 2


def test_camera_in_a_wall_and_a_camera_that_is_none_are_refused() -> None:
    with pytest.raises(BadInputError, match="is inside wall"):
        render(scene_of([wall(-0.1)]), tof_head(), AT_WALL)
    with pytest.raises(BadInputError, match="has no camera 'eye'"):
        render_scan(ROOM, tof_head(), T_map_rig=AT_WALL, range_camera="eye", time_s=0.0)
    with pytest.raises(BadInputError, match="must be a range camera"):
        render_scan(ROOM, full_head(scale=0.1), T_map_rig=AT_WALL, range_camera="colour_left", time_s=0.0)


FOLDING = Camera(
    width=320, height=240, focal_px=(120.0, 120.0), centre_px=(159.5, 119.5), distortion=(-0.4, 0.0, 0.0, 0.0, 0.0)
)
"""A lens that folds back within its image: the corners have no rays."""


def test_pixels_without_a_ray_hold_nothing_and_do_not_touch_their_neighbours() -> None:
    ground = scene_of([Solid("ground", Plane(), WALL, placed((0, 0, -2)))])
    rig = Rig(
        name="folding",
        cameras={
            name: mount_camera(spectrum, FOLDING, look_at((0, 0, 0), (0, 0, 1), up=(0, -1, 0)))
            for name, spectrum in (("tof", Spectrum.RANGE), ("c", Spectrum.COLOUR), ("t", Spectrum.THERMAL))
        },
    )
    blind = np.isnan(FOLDING.rays()[..., 0])
    assert 0.05 < blind.mean() < 0.9
    T = look_at((0, 0, 0), (0.01, 0, -1))
    beside = cv2.dilate(blind.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    for noise in (None, 1):
        scan = render(ground, rig, T, seed=noise)
        assert np.isnan(scan.range_m[blind]).all() and np.isfinite(scan.range_m[~beside]).mean() > 0.8
        rim = cv2.dilate(blind.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & ~beside
        assert abs(float(np.median(scan.thermal["t"][rim])) - 300) < 0.5
        assert np.median(scan.colour["c"][rim & ~cv2.dilate(blind.astype(np.uint8), np.ones((7, 7))).astype(bool)]) > 20


def test_rays_without_direction_in_a_scene_without_a_tree_meet_nothing() -> None:
    blind = SpinningLidar(width=4, height=1, elevations_deg=(0.0,))
    ground = scene_of([Solid("ground", Plane(), WALL, placed((0, 0, -2)))])
    nothing = cast_directions(ground, np.full((9, 3), np.nan), AT_WALL, bundle=3, opaque=False)
    assert (nothing.solid == -1).all()
    assert (cast(ground, blind, AT_WALL).solid == -1).all()
