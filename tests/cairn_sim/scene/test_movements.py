"""What moves: a scene at a time is the scene that someone would write who only knew that time."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_calib.rig.poses import Transform, look_at
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_sim.render.raycast_kernels import cast_each
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.scene.movements import CLOCK_START_S, Keyframe, Movement, MovingObject
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.scene_file import load_scene, scene_from_toml
from cairn_sim.scene.solids import Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Surface

GREY = Surface(Material(), grain=0.3)
RIG = full_head(scale=0.1)
ROOM = """
format = "cairn-scene"
version = 1
name = "room"
[materials]
plaster = {colour = "#c0b8a0", temperature_c = 18}
skin = {colour = "#d8a688", temperature_c = 36}
[surfaces]
wall = {material = "plaster", grain = 0.2}
[objects.body]
parts = [
  {name = "trunk", cylinder = [0.2, 1.4], surface = "wall"},
  {name = "head", sphere = 0.12, at = [0, -0.02, 1.5], surface = "skin"},
]
[areas.all]
solids = [
  {name = "floor", plane = true, surface = "wall"},
  {name = "wall", from = [4, -3, 0], to = [4.2, 3, 3], surface = "wall"},
]
"""
EYE: Transform = look_at((0, 0, 1.2), (3, 0, 0.8))


class Stand(NamedTuple):
    """A pose as a file has it."""

    at: tuple[float, float, float]
    turn_deg: float

    def __str__(self) -> str:
        return f"at = {list(self.at)}, turn_deg = {self.turn_deg}"


HERE, THERE = Stand((2.0, -1.0, 0.1), 30), Stand((3.0, 1.0, 0.3), 120)
STANDS = st.builds(
    Stand, st.tuples(st.floats(1.5, 3.5), st.floats(-2, 2), st.floats(0, 0.5)), st.floats(-80, 80).map(float)
)


def moving_room(keyframes: str, *, repeat_s: float | None = None, place: str = "") -> Scene:
    period = "" if repeat_s is None else f"repeat_s = {repeat_s}"
    entry = f"[[moving]]\nname = 'man'\nobject = 'body'\n{period}\n{place}\nkeyframes = [{keyframes}]\n"
    return scene_from_toml(ROOM + entry)


def still_room(stand: Stand) -> Scene:
    return scene_from_toml(ROOM + f"places = [{{object = 'body', name = 'man', {stand}}}]\n")


def from_here_to_there(*, repeat_s: float | None = None) -> Scene:
    return moving_room(f"{{time_s = 10, {HERE}}}, {{time_s = 20, {THERE}}}", repeat_s=repeat_s)


def at(scene: Scene, after_s: float) -> Scene:
    return scene.at(CLOCK_START_S + after_s)


def seen(scene: Scene, *, time_s: float = CLOCK_START_S) -> list[bytes]:
    scan = render_scan(scene, RIG, T_map_rig=EYE, range_camera=RANGE_CAMERA, time_s=time_s, noise=Noise(3))
    return images_of(scan)


def images_of(scan: Scan) -> list[bytes]:
    assert scan.amplitude is not None
    return [image.tobytes() for image in (scan.range_m, scan.amplitude, *scan.colour.values(), *scan.thermal.values())]


def man(scene: Scene) -> Transform:
    """Pose of the trunk's foot."""
    return scene.solids[scene.number_of("man/trunk")].T_map_solid @ placed((0, 0, -0.7))


@given(STANDS, STANDS)
def test_a_scene_at_the_time_of_a_keyframe_is_the_scene_written_with_its_pose(one: Stand, other: Stand) -> None:
    scene = moving_room(f"{{time_s = 0, {one}}}, {{time_s = 60, {other}}}")
    for after_s, stand in ((0, one), (60, other)):
        now, written = at(scene, after_s), still_room(stand)
        assert [solid.name for solid in now.solids] == [solid.name for solid in written.solids]
        np.testing.assert_array_equal(now.shapes.frame, written.shapes.frame)
        np.testing.assert_array_equal(now.shapes.bounds, written.shapes.bounds)


@pytest.mark.parametrize(("after_s", "stand"), [(3, HERE), (10, HERE), (20, THERE), (9999, THERE)])
def test_every_image_of_a_scene_at_a_time_is_that_of_the_written_scene(after_s: float, stand: Stand) -> None:
    assert seen(from_here_to_there(), time_s=CLOCK_START_S + after_s) == seen(still_room(stand))


def test_the_images_of_a_scene_are_those_of_the_scene_at_the_time_of_the_scan() -> None:
    scene = from_here_to_there()
    pictures = [seen(scene, time_s=CLOCK_START_S + after_s) for after_s in (10, 12, 14)]
    assert pictures == [seen(at(scene, after_s)) for after_s in (10, 12, 14)]
    assert pictures[0] != pictures[1] != pictures[2]


@pytest.mark.parametrize("name", ["small-room", "building", "yard"])
def test_a_scene_in_which_nothing_moves_is_itself_at_all_times(name: str) -> None:
    scene = load_scene(name)
    assert scene.moving == ()
    assert all(scene.at(time_s) is scene for time_s in (0.0, CLOCK_START_S, CLOCK_START_S + 1e6))


def test_a_scene_as_loaded_is_that_of_its_start_and_of_all_times_before() -> None:
    scene = from_here_to_there()
    np.testing.assert_array_equal(scene.shapes.frame, at(scene, 0).shapes.frame)
    assert at(scene, 0) is at(scene, -1e6) is scene.at(0.0)


@pytest.mark.parametrize(("one_s", "other_s"), [(0, 10), (0, 4.5), (20, 21), (20, 1e6)])
def test_while_nothing_moves_it_is_the_very_same_scene(one_s: float, other_s: float) -> None:
    scene = from_here_to_there()
    assert at(scene, one_s) is at(scene, other_s)


def test_a_scene_at_a_time_no_longer_moves() -> None:
    now = at(from_here_to_there(), 15)
    assert at(now, 20) is now


@given(st.floats(0, 1))
def test_between_keyframes_the_place_runs_straight_and_the_turn_evenly(share: float) -> None:
    pose = man(at(from_here_to_there(), 10 + 10 * share))
    turn_rad = np.radians(HERE.turn_deg + share * (THERE.turn_deg - HERE.turn_deg))
    expected = placed((0, 0, 0), (0, 0, float(turn_rad)))
    expected[:3, 3] = (1 - share) * np.array(HERE.at) + share * np.array(THERE.at)
    np.testing.assert_allclose(pose, expected, atol=1e-6)


@given(st.floats(0, 30), st.integers(1, 1000))
def test_a_period_repeats(after_s: float, periods: int) -> None:
    scene = from_here_to_there(repeat_s=32)
    np.testing.assert_allclose(man(at(scene, after_s + 32 * periods)), man(at(scene, after_s)), atol=1e-5)


def test_after_its_last_keyframe_a_movement_waits_for_its_period() -> None:
    scene = from_here_to_there(repeat_s=32)
    assert at(scene, 25) is at(scene, 20) is at(scene, 31.5)
    assert at(scene, 32) is at(scene, 0) is not at(scene, 31.5)


def test_keyframes_count_from_the_place_of_the_entry() -> None:
    scene = moving_room("{time_s = 0, at = [1, 0, 0]}", place="at = [2, 0, 0]\nturn_deg = 90")
    np.testing.assert_allclose(man(scene), placed((2, 1, 0), (0, 0, np.pi / 2)), atol=1e-12)


def test_a_door_turns_about_its_hinge() -> None:
    leaf = Solid("leaf", Box((1, 0.04, 2)), GREY, placed((0.5, 0, 1)))
    movement = Movement(
        (Keyframe(0, placed((0, 0, 0))), Keyframe(9, placed((0, 0, 0), (0, 0, np.pi / 2)))), placed((3, 4, 0))
    )
    scene = scene_of([Solid("floor", Plane(), GREY, np.eye(4))], moving=[MovingObject("door", (leaf,), movement)])
    for share in (0, 1 / 3, 2 / 3, 1):
        along = np.array([np.cos(share * np.pi / 2), np.sin(share * np.pi / 2), 0])
        points = np.array([3, 4, 1]) + np.outer([-0.1, 0.1, 0.9, 1.1], along)
        assert at(scene, 9 * share).solid_at(points).tolist() == [-1, 1, 1, -1]


GONE = f"{{time_s = 0, gone = true}}, {{time_s = 10, {HERE}}}, {{time_s = 20, gone = true}}"


@pytest.mark.parametrize(("after_s", "there"), [(0, False), (9.9, False), (10, True), (19.9, True), (20, False)])
def test_what_is_gone_is_as_if_it_had_never_been_there(after_s: float, there: bool) -> None:
    now = at(moving_room(GONE), after_s)
    alike = still_room(HERE) if there else scene_from_toml(ROOM)
    assert seen(now) == seen(alike)
    points = np.random.default_rng(1).uniform((1, -2, -0.5), (4, 1, 2), (500, 3))
    np.testing.assert_array_equal(now.distance_m(points), alike.distance_m(points))
    np.testing.assert_array_equal(now.solid_at(points), alike.solid_at(points))
    assert now.gone == (frozenset() if there else {2, 3})


def test_solids_keep_their_numbers_at_all_times() -> None:
    scene = moving_room(GONE)
    assert [solid.name for solid in at(scene, 0).solids] == [solid.name for solid in at(scene, 15).solids]


def test_what_appears_stands_still_until_it_goes() -> None:
    scene = moving_room(GONE)
    assert at(scene, 10) is at(scene, 19) is not at(scene, 20)


def random_solid(name: str, rng: np.random.Generator) -> Solid:
    a, b, c, x, y, z = rng.uniform(0.1, 0.8, 6)
    shapes: list[Shape] = [Box((a, b, c)), Cylinder(a / 2, b), Sphere(c / 2)]
    return Solid(name, shapes[rng.integers(3)], GREY, placed((x, y, z), (3 * a, 3 * b, 3 * c)))


@pytest.mark.parametrize("seed", range(12))
def test_rays_meet_in_still_and_moved_solids_what_they_meet_in_one_scene_of_both(seed: int) -> None:
    rng = np.random.default_rng(seed)
    still = [random_solid(f"still {n}", rng) for n in range(rng.integers(0, 9))]
    if seed % 2:
        still.insert(0, Solid("ground", Plane(), GREY, placed((0, 0, -2))))
    moving, together = [], list(still)
    for n in range(rng.integers(1, 6)):
        parts = tuple(random_solid(f"part {n} {k}", rng) for k in range(rng.integers(1, 4)))
        pose = placed(tuple(rng.uniform(-2, 2, 3)), tuple(rng.uniform(-1, 1, 3)))
        object_ = MovingObject(f"object {n}", parts, Movement((Keyframe(0, np.eye(4)), Keyframe(5, pose)), np.eye(4)))
        moving.append(object_)
        together += object_.placed_solids(pose)
    now, written = at(scene_of(still, moving=moving), 5), scene_of(together)
    origins, towards = rng.uniform(-4, 4, (400, 3)), rng.uniform(-2, 2, (400, 3))
    directions = (towards - origins) / np.linalg.norm(towards - origins, axis=1)[:, None]
    for found, expected in zip(
        cast_each(origins, directions, now.shapes), cast_each(origins, directions, written.shapes), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(now.distance_m(origins), written.distance_m(origins), atol=1e-12)


@pytest.mark.parametrize(
    ("times_s", "repeat_s", "words"),
    [
        ((), None, "at least one keyframe"),
        ((-1.0,), None, "from 0"),
        ((float("nan"),), None, "from 0"),
        ((3.0, 3.0), None, "must rise"),
        ((0.0, 3.0), 2.0, "3 s, got 2"),
        ((0.0,), 0.0, "above 0"),
    ],
)
def test_a_movement_that_is_none_is_refused(times_s: tuple[float, ...], repeat_s: float | None, words: str) -> None:
    with pytest.raises(BadInputError, match=words) as caught:
        Movement(tuple(Keyframe(time_s, np.eye(4)) for time_s in times_s), np.eye(4), repeat_s)
    assert caught.value.kind == "bad_movement"
