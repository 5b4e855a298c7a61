"""A scene file says what it means, and a wrong one says where it is wrong."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.errors import BadInputError
from cairn_sim.scene import scene_file
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import FILE_BYTES_MAX, SHIPPED, load_scene, scene_from_toml, shipped_text
from cairn_sim.scene.solids import Box, Cylinder, Plane, Solid, Sphere
from cairn_sim.scene.surfaces import Optics

HEAD = """
format = "cairn-scene"
version = 1
name = "test"
ambient_c = 21.0
"""
MATERIALS = """
[materials]
wall = {colour = "#0a141e", temperature_c = 17.0, emissivity = 0.9, nir = 0.4, gloss = 0.1, retroreflection = 300}
plain = {colour = "#808080"}
pane = {colour = "#ffffff", optics = "glass"}

[surfaces]
tiles = {material = "wall", second = "plain", period_m = [0.5, inf], phase_m = [0.1, 0], grain = 0.2, grain_m = 0.03}
"""
OBJECT = """
[objects.stool]
parts = [
  {name = "seat", box = [0.4, 0.3, 0.1], at = [0, 0, 0.5], surface = "plain"},
  {name = "leg", cylinder = [0.05, 0.5], at = [0.1, 0, 0], surface = "wall"},
]
"""
ANGLES = st.floats(-180, 180)


def scene(areas: str, *, head: str = HEAD, objects: str = OBJECT) -> Scene:
    return scene_from_toml(head + MATERIALS + objects + areas)


def one(solid: str) -> Solid:
    (found,) = scene(f"[areas.a]\nsolids = [{{name = 'it', surface = 'plain', {solid}}}]").solids
    return found


def placed_stool(place: str) -> dict[str, Solid]:
    found = scene(f"[areas.a]\nplaces = [{{object = 'stool', name = 'stool', {place}}}]")
    return {solid.name: solid for solid in found.solids}


def turn(axis: int, degrees: float) -> np.ndarray:
    """Right-handed rotation about an axis, from its definition: the axis stays, the next goes towards the one after."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    one, two = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[one, one], R[two, one], R[one, two], R[two, two] = cos, sin, -sin, cos
    return R


def test_corners_make_a_box_between_them() -> None:
    box = one("from = [1, 2, -0.2], to = [3, 2.5, 0]")
    low, high = box.bounds_m()
    np.testing.assert_allclose(low, [1, 2, -0.2], atol=1e-12)
    np.testing.assert_allclose(high, [3, 2.5, 0], atol=1e-12)


def test_box_and_cylinder_stand_on_their_place() -> None:
    np.testing.assert_allclose(one("box = [1, 2, 3], at = [5, 6, 7]").bounds_m(), [[4.5, 5, 7], [5.5, 7, 10]])
    np.testing.assert_allclose(one("cylinder = [0.5, 3], at = [5, 6, 7]").bounds_m(), [[4.5, 5.5, 7], [5.5, 6.5, 10]])
    assert one("cylinder = [0.5, 3]").shape == Cylinder(0.5, 3)


def test_sphere_is_around_its_place_and_a_plane_goes_through_it() -> None:
    sphere, plane = one("sphere = 0.5, at = [5, 6, 7]"), one("plane = true, at = [0, 0, 2]")
    assert sphere.shape == Sphere(0.5)
    np.testing.assert_allclose(sphere.T_map_solid[:3, 3], [5, 6, 7])
    assert isinstance(plane.shape, Plane)
    np.testing.assert_allclose(plane.distance_m(np.array([[9.0, 9, 5], [9, 9, 1]])), [3, -1])


@given(ANGLES, ANGLES, ANGLES)
def test_a_turn_is_about_x_then_y_then_z(x: float, y: float, z: float) -> None:
    found = one(f"sphere = 1, turn_deg = [{x}, {y}, {z}]").T_map_solid
    np.testing.assert_allclose(found[:3, :3], turn(2, z) @ turn(1, y) @ turn(0, x), atol=1e-12)


def test_one_angle_turns_about_z_and_all_turns_leave_the_foot_where_it_is() -> None:
    np.testing.assert_allclose(one("box = [1, 2, 3], turn_deg = 30").T_map_solid[:3, :3], turn(2, 30), atol=1e-12)
    lying = one("cylinder = [0.1, 4], at = [1, 2, 3], turn_deg = [0, 90, 0]")
    np.testing.assert_allclose(lying.bounds_m(), [[1, 1.9, 2.9], [5, 2.1, 3.1]], atol=1e-12)


@given(ANGLES, ANGLES, ANGLES)
def test_an_object_is_placed_as_one_piece(x: float, y: float, z: float) -> None:
    stood, placed = placed_stool("at = [0, 0, 0]"), placed_stool(f"at = [1, 2, 3], turn_deg = [{x}, {y}, {z}]")
    R = turn(2, z) @ turn(1, y) @ turn(0, x)
    for name, solid in stood.items():
        moved = placed[name].T_map_solid
        np.testing.assert_allclose(moved[:3, 3], R @ solid.T_map_solid[:3, 3] + [1, 2, 3], atol=1e-9)
        np.testing.assert_allclose(moved[:3, :3], R @ solid.T_map_solid[:3, :3], atol=1e-9)
        assert placed[name].shape == solid.shape


def test_parts_are_named_after_their_place() -> None:
    assert list(placed_stool("at = [0, 0, 0]")) == ["stool/seat", "stool/leg"]


def test_a_row_is_counted_and_stepped() -> None:
    row = placed_stool("at = [1, 0, 0], turn_deg = 90, count = 3, step_m = [0, 2, 0.5]")
    assert list(row) == [f"stool {n}/{part}" for n in (1, 2, 3) for part in ("seat", "leg")]
    for n in (1, 2, 3):
        np.testing.assert_allclose(
            row[f"stool {n}/seat"].T_map_solid[:3, 3], [1, 2 * (n - 1), 0.55 + (n - 1) / 2], atol=1e-12
        )


def test_a_place_puts_other_surfaces() -> None:
    stool = placed_stool("at = [0, 0, 0], surfaces = {plain = 'tiles'}")
    assert stool["stool/seat"].surface.second is not None
    assert stool["stool/leg"].surface.material.colour_srgb == (10, 20, 30)


def test_materials_and_surfaces_are_what_is_written() -> None:
    surface = scene("[areas.a]\nsolids = [{name = 'it', surface = 'tiles', sphere = 1}]").solids[0].surface
    wall, plain = surface.material, surface.second
    assert (wall.colour_srgb, wall.emissivity, wall.reflectivity_nir) == ((10, 20, 30), 0.9, 0.4)
    assert (wall.gloss_nir, wall.retroreflection, wall.optics) == (0.1, 300.0, Optics.OPAQUE)
    assert wall.temperature_k == pytest.approx(290.15)
    assert plain is not None
    assert plain.temperature_k == pytest.approx(294.15), "the surroundings' where a material has none"
    assert (surface.period_m, surface.phase_m, surface.grain, surface.grain_m) == ((0.5, math.inf), (0.1, 0), 0.2, 0.03)


def test_a_solid_may_have_a_temperature_of_its_own() -> None:
    hot = scene("[areas.a]\nsolids = [{name = 'it', surface = 'tiles', sphere = 1, temperature_c = 60}]").solids[0]
    assert [m.temperature_k for m in hot.surface.materials] == pytest.approx([333.15, 333.15])


def test_sky_is_the_surroundings_unless_said() -> None:
    ball = "[areas.a]\nsolids = [{name = 'it', surface = 'pane', sphere = 1}]"
    inside, outside = scene(ball), scene(ball, head=HEAD + "sky_c = -10\nsky = '#aAc8e8'\n")
    assert (inside.name, inside.ambient_k, inside.sky_k, inside.sky_srgb) == ("test", 294.15, 294.15, (0, 0, 0))
    assert outside.sky_k == pytest.approx(263.15)
    assert outside.sky_srgb == (170, 200, 232)
    assert inside.solids[0].surface.material.optics is Optics.GLASS


def refused(text: str) -> str:
    with pytest.raises(BadInputError) as caught:
        scene_from_toml(text, source="mine.toml")
    assert caught.value.kind == "bad_scene"
    assert len(caught.value.message) < 1000
    return caught.value.message


def solid(fields: str) -> str:
    return HEAD + MATERIALS + OBJECT + f"[areas.hall]\nsolids = [{{{fields}}}]\n"


def place(fields: str) -> str:
    return HEAD + MATERIALS + OBJECT + f"[areas.hall]\nplaces = [{{{fields}}}]\n"


def moving(fields: str) -> str:
    return solid(BALL) + f"[[moving]]\nname = 'cart'\nobject = 'stool'\n{fields}\n"


def based(fields: str) -> str:
    return f"format = 'cairn-scene'\nversion = 1\nname = 'mine'\n{fields}\n"


BALL = "name = 'a', surface = 'plain', sphere = 1"
WRONG: dict[str, tuple[str, list[str]]] = {
    "no TOML": ("format = ", ["mine.toml", "TOML"]),
    "too many digits": ("version = " + "1" * 5000, ["TOML"]),
    "too deep": ("a = " + "[" * 20_000, ["TOML"]),
    "empty": ("", ["format", "required"]),
    "another format": (solid(BALL).replace("cairn-scene", "cairn-map"), ["format", "'cairn-scene'", "'cairn-map'"]),
    "another version": (solid(BALL).replace("version = 1", "version = 2"), ["version", "got 2"]),
    "version true": (solid(BALL).replace("version = 1", "version = true"), ["version", "got True"]),
    "two angles": (solid(BALL + ", turn_deg = [0, 1]"), ["areas.hall.solids.0.turn_deg.2", "required"]),
    "unknown field": (solid(BALL + ", weight = 3"), ["areas.hall.solids.0.weight", "got 3"]),
    "unknown surface": (
        solid("name = 'a', surface = 'gold', sphere = 1"),
        ["areas.hall.solids.0.surface", "pane, plain, tiles, wall", "'gold'"],
    ),
    "unknown object": (
        place("object = 'throne', name = 'a', at = [0, 0, 0]"),
        ["areas.hall.places.0.object", "stool", "'throne'"],
    ),
    "unknown new surface": (
        place("object = 'stool', name = 'a', at = [0, 0, 0], surfaces = {wall = 'gold'}"),
        ["areas.hall.places.0.surfaces.wall", "'gold'"],
    ),
    "unknown old surface": (
        place("object = 'stool', name = 'a', at = [0, 0, 0], surfaces = {gold = 'wall'}"),
        ["areas.hall.places.0.surfaces", "plain, wall", "'gold'"],
    ),
    "name twice": (solid(BALL) + "[areas.b]\nsolids = [{" + BALL + "}]", ["areas.b.solids.0.name", "'a'"]),
    "no shape": (solid("name = 'a', surface = 'plain'"), ["areas.hall.solids.0", "one shape"]),
    "two shapes": (solid(BALL + ", box = [1, 1, 1]"), ["areas.hall.solids.0", "one shape"]),
    "one corner": (solid("name = 'a', surface = 'plain', from = [0, 0, 0]"), ["areas.hall.solids.0", "from and to"]),
    "corners swapped": (
        solid("name = 'a', surface = 'plain', from = [0, 0, 0], to = [1, 1, -1]"),
        ["areas.hall.solids.0", "from below to", "-1"],
    ),
    "corners turned": (
        solid("name = 'a', surface = 'plain', from = [0, 0, 0], to = [1, 1, 1], turn_deg = 3"),
        ["areas.hall.solids.0", "turn_deg"],
    ),
    "no size": (solid("name = 'a', surface = 'plain', box = [1, 0, 1]"), ["areas.hall.solids.0.box.1", "got 0"]),
    "not a number": (solid(BALL + ", at = [0, nan, 0]"), ["areas.hall.solids.0.at.1", "got nan"]),
    "infinite": (solid(BALL + ", at = [0, 0, inf]"), ["areas.hall.solids.0.at.2", "got inf"]),
    "infinite turn": (solid(BALL + ", turn_deg = inf"), ["areas.hall.solids.0.turn_deg.2", "got inf"]),
    "text for a number": (solid(BALL + ", at = [0, '1', 0]"), ["areas.hall.solids.0.at.1", "got '1'"]),
    "two coordinates": (solid(BALL + ", at = [0, 1]"), ["areas.hall.solids.0.at.2", "required"]),
    "plane false": (solid("name = 'a', surface = 'plain', plane = false"), ["areas.hall.solids.0.plane", "got False"]),
    "below zero kelvin": (solid(BALL + ", temperature_c = -300"), ["areas.hall.solids.0.temperature_c", "got -300"]),
    "colour by name": (solid(BALL).replace("#808080", "grey"), ["materials.plain.colour", "got 'grey'"]),
    "emissivity": (solid(BALL).replace("emissivity = 0.9", "emissivity = 9"), ["materials.wall.emissivity", "got 9"]),
    "optics": (
        solid(BALL).replace("'glass'", "'x'").replace('"glass"', '"prism"'),
        ["materials.pane.optics", "'prism'"],
    ),
    "period": (solid(BALL).replace("[0.5, inf]", "[0.5, 0]"), ["surfaces.tiles.period_m.1", "got 0"]),
    "unknown material": (
        solid(BALL).replace('material = "wall"', 'material = "m"'),
        ["surfaces.tiles.material", "'m'"],
    ),
    "unknown second": (solid(BALL).replace('second = "plain"', 'second = "m"'), ["surfaces.tiles.second", "'m'"]),
    "other optics": (solid(BALL).replace('second = "plain"', 'second = "pane"'), ["surfaces.tiles", "same optics"]),
    "surface named as material": (solid(BALL).replace("tiles =", "plain ="), ["surfaces.plain", "'plain'"]),
    "nothing": (HEAD + MATERIALS + "[areas.hall]\n", ["areas", "got 0"]),
    "no parts": (solid(BALL) + "[objects.none]\nparts = []", ["objects.none.parts"]),
    "no count": (place("object = 'stool', name = 'a', at = [0, 0, 0], count = 0"), ["places.0.count", "got 0"]),
    "too many solids": (place("object = 'stool', name = 'a', at = [0, 0, 0], count = 10001"), ["areas", "20002"]),
    "no keyframes": (moving("keyframes = []"), ["moving.0.keyframes"]),
    "keyframe without time": (moving("keyframes = [{at = [0, 0, 0]}]"), ["moving.0.keyframes.0.time_s", "required"]),
    "time before the start": (
        moving("keyframes = [{time_s = -1}]"),
        ["moving.0.keyframes.0.time_s", "greater than or equal to 0", "got -1"],
    ),
    "time as text": (moving("keyframes = [{time_s = '1'}]"), ["moving.0.keyframes.0.time_s", "got '1'"]),
    "endless time": (moving("keyframes = [{time_s = inf}]"), ["moving.0.keyframes.0.time_s", "got inf"]),
    "times that fall": (
        moving("keyframes = [{time_s = 20}, {time_s = 10}]"),
        ["moving.0", "times of keyframes must rise", "got 10 after 20"],
    ),
    "times that stay": (moving("keyframes = [{time_s = 20}, {time_s = 20}]"), ["moving.0", "must rise"]),
    "half a turn": (
        moving("keyframes = [{time_s = 0, turn_deg = -90}, {time_s = 10, turn_deg = 90}]"),
        ["moving.0", "less than 180 degrees", "got 180 from 0 to 1", "put one between"],
    ),
    "gone and somewhere": (
        moving("keyframes = [{time_s = 0, gone = true, at = [0, 0, 1]}]"),
        ["moving.0.keyframes.0", "what is gone is nowhere"],
    ),
    "gone false": (moving("keyframes = [{time_s = 0, gone = false}]"), ["moving.0.keyframes.0.gone", "got False"]),
    "short period": (
        moving("repeat_s = 5\nkeyframes = [{time_s = 0}, {time_s = 10}]"),
        ["moving.0", "repeat_s", "last keyframe's 10 s", "got 5"],
    ),
    "no period": (moving("repeat_s = 0\nkeyframes = [{time_s = 0}]"), ["moving.0.repeat_s", "got 0"]),
    "unknown field of a movement": (moving("speed = 3\nkeyframes = [{time_s = 0}]"), ["moving.0.speed", "got 3"]),
    "moving unknown object": (
        moving("keyframes = [{time_s = 0}]").replace("'stool'", "'throne'"),
        ["moving.0.object", "stool", "'throne'"],
    ),
    "moving unknown surface": (
        moving("surfaces = {gold = 'wall'}\nkeyframes = [{time_s = 0}]"),
        ["moving.0.surfaces", "plain, wall", "'gold'"],
    ),
    "moving name twice": (
        moving("keyframes = [{time_s = 0}]")
        + "[[moving]]\nname = 'cart'\nobject = 'stool'\nkeyframes = [{time_s = 0}]",
        ["objects.stool.parts.0.name", "'cart/seat'"],
    ),
    "a plane that moves": (
        moving("keyframes = [{time_s = 0}]").replace("cylinder = [0.05, 0.5]", "plane = true"),
        ["moving.0", "cart/leg is a plane", "cannot move"],
    ),
    "unknown base": (based("base = 'castle'"), ["base", "building, small-room", "'castle'"]),
    "a path as base": (based("base = '../building'"), ["base", "'../building'"]),
    "unknown in the base": (
        based("base = 'small-room'\nwithout = ['torso', 'throne']"),
        ["without.1", "small-room", "'throne'"],
    ),
    "without a base": (solid(BALL).replace("[materials]", "without = ['a']\n[materials]"), ["without", "base"]),
    "a name of the base": (
        based("base = 'yard'\n[materials]\ngrass = {colour = '#808080'}"),
        ["materials.grass", "yard does not have"],
    ),
    "a solid of the base": (
        based("base = 'yard'\n[areas.mine]\nsolids = [{name = 'lamp', surface = 'grass', sphere = 1}]"),
        ["areas.mine.solids.0.name", "'lamp'"],
    ),
    "key of many parts": ("a." * 200_000 + "b = 1", ["64 dots"]),
    "too large": ("#" * (FILE_BYTES_MAX + 1), ["mine.toml", "1048576"]),
}


@pytest.mark.parametrize("case", sorted(WRONG))
def test_a_wrong_scene_says_where_and_what(case: str) -> None:
    text, words = WRONG[case]
    message = refused(text)
    assert message.startswith("mine.toml: ")
    assert [word for word in words if word not in message] == [], message


def test_too_many_wrong_fields_are_refused_at_once() -> None:
    solids = ", ".join("{}" for _ in range(50_000))
    assert "areas.hall.solids.0" in refused(HEAD + MATERIALS + f"[areas.hall]\nsolids = [{solids}]")


def test_a_file_is_a_scene(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(solid(BALL))
    assert load_scene(path).solids[0].name == load_scene(str(path)).solids[0].name == "a"


@pytest.mark.parametrize(
    "write",
    [lambda path: None, lambda path: path.mkdir(), lambda path: path.write_bytes(b"\xff\xfe")],
    ids=["missing", "folder", "no text"],
)
def test_a_file_that_is_no_text_is_refused(tmp_path: Path, write: Callable[[Path], object]) -> None:
    path = tmp_path / "hall.toml"
    write(path)
    with pytest.raises(BadInputError, match=r"hall\.toml"):
        load_scene(path)


def test_an_unknown_name_lists_the_known_ones() -> None:
    for ask in (load_scene, shipped_text):
        with pytest.raises(BadInputError, match=r"building, small-room, yard.*'castle'") as caught:
            ask("castle")
        assert caught.value.kind == "unknown_scene"


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenes_load_and_bear_their_name(name: str) -> None:
    found = load_scene(name)
    assert found.name == name
    assert len({solid.name for solid in found.solids}) == len(found.solids)
    assert found.shapes.frame.shape == (len(found.solids), 12)


def example(first: str, last: str) -> str:
    """Lines of the documentation, from one to another."""
    lines = [line.strip() for line in str(scene_file.__doc__).splitlines()]
    start = next(n for n, line in enumerate(lines) if line.startswith(first))
    end = next(n for n, line in enumerate(lines) if n >= start and line.startswith(last))
    return "\n".join(lines[start : end + 1]) + "\n"


def test_example_of_the_documentation_loads() -> None:
    names = [solid.name for solid in scene_from_toml(example("format =", "places =")).solids]
    assert names == ["floor", "stool/seat", "stool/leg"]


def test_moving_examples_of_the_documentation_load() -> None:
    found = scene_from_toml(example("format =", "places =") + example("[objects.leaf]", "repeat_s ="))
    assert [each.name for each in found.moving] == ["door", "second stool", "cart"]
    assert found.solids[found.number_of("cart/seat")].surface.material.colour_srgb == (0x69, 0x64, 0x5F)


def test_base_of_the_documentation_loads() -> None:
    found = scene_from_toml("format = 'cairn-scene'\nversion = 1\nname = 'mine'\n" + example("base =", "without ="))
    assert "lab 1 door/leaf" not in {solid.name for solid in found.solids}


def test_a_scene_has_all_of_its_base_but_what_it_leaves_out() -> None:
    room, mine = load_scene("small-room"), scene_from_toml(based("base = 'small-room'\nwithout = ['torso']"))
    assert (mine.name, mine.ambient_k, mine.sky_k) == ("mine", room.ambient_k, room.sky_k)
    assert [solid.name for solid in mine.solids] == [solid.name for solid in room.solids if solid.name != "torso"]


def test_a_scene_adds_to_its_base_and_may_have_another_sky() -> None:
    text = "base = 'yard'\nsky_c = 3\n[areas.mine]\nplaces = [{object = 'barrel', name = 'keg', at = [0, 0, 9]}]"
    yard, mine = load_scene("yard"), scene_from_toml(based(text))
    assert [solid.name for solid in mine.solids[len(yard.solids) :]] == [
        "keg/drum",
        "keg/hoop 1",
        "keg/hoop 2",
        "keg/bung",
    ]
    assert (mine.sky_k, mine.sky_srgb) == (pytest.approx(276.15), yard.sky_srgb)


def test_a_base_may_move_and_be_left_still() -> None:
    assert [each.name for each in scene_from_toml(based("base = 'moving-yard'\nwithout = ['car']")).moving] == [
        "walker"
    ]


def test_boxes_of_the_file_are_boxes() -> None:
    assert one("box = [1, 2, 3]").shape == Box((1, 2, 3))
