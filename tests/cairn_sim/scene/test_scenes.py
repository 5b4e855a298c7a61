"""The shipped scenes hold what they promise: the building is the paper's site, the room closed, the yard on a slope.

What these tests do not show: that a scene looks like a place. Look at pictures of it for that.
"""

from collections.abc import Iterator
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.poses import look_at
from cairn_sim.render.raycast_kernels import GLASS, MIRROR
from cairn_sim.render.rays import cast
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.scene.solids import Box, Plane, Solid
from cairn_sim.scene.surfaces import Optics

Floats = npt.NDArray[np.float64]

CELL_M = 5.12
COLUMNS = (
    {(i, j) for i in range(7) for j in (-1, 0)}
    | {(i, j) for i in (2, 3) for j in range(1, 6)}
    | {(i, j) for i in (5, 6) for j in (-3, -2)}
)
"""Cells of one storey: corridor 2 x 7, laboratories 2 x 5, extension 2 x 2 (PAPER.md section 8)."""
STOREYS = (-1, 0)
ROBOT_LINES_M = (((1.2, 0), (30.8, 0)), ((15.2, 0), (15.2, 24.5)), ((30.8, 0), (30.8, -9.5)))
CLEARANCE_M = 0.45
EYES_M = (
    (2.0, 0.0, -0.1),
    (15.2, 0.0, 0.5),
    (33.6, 0.0, -0.8),
    (15.2, 6.0, -0.1),
    (15.2, 13.0, 0.2),
    (15.2, 24.0, -0.1),
    (30.8, -8.0, 0.0),
)
"""In every room of the building."""
SAME_M = 1e-6


@cache
def scene(name: str) -> Scene:
    return load_scene(name)


def name_at(name: str, x: float, y: float, z: float) -> str | None:
    number = int(scene(name).solid_at(np.array([x, y, z])))
    return scene(name).solids[number].name if number >= 0 else None


def looks(eye: tuple[float, float, float]) -> Iterator[Floats]:
    """Directions of six views of 90 degrees that see all around."""
    for axis in range(3):
        for step in (-1.0, 1.0):
            yield look_at(eye, np.add(eye, step * np.eye(3)[axis]), up=np.eye(3)[axis - 1])


def test_building_lies_in_its_56_cells() -> None:
    outside = []
    for solid in scene("building").solids:
        low, high = (np.floor(corner / CELL_M).astype(int) for corner in solid.bounds_m())
        columns = {(i, j) for i in range(low[0], high[0] + 1) for j in range(low[1], high[1] + 1)}
        if not (columns <= COLUMNS and set(range(low[2], high[2] + 1)) <= set(STOREYS)):
            outside.append(solid.name)
    assert outside == []
    assert len(COLUMNS) * len(STOREYS) == 56


def test_every_cell_of_the_building_holds_a_surface_that_is_seen() -> None:
    seen: set[tuple[int, ...]] = set()
    camera = camera_from_field_of_view(96, 96, horizontal_deg=91.0)
    for eye in EYES_M:
        for T in looks(eye):
            hits = cast(scene("building"), camera, T)
            rays = camera.rays().reshape(-1, 3) @ T[:3, :3].T
            points = T[:3, 3] + rays * (hits.range_m[:, None] - SAME_M)
            seen |= {tuple(cell) for cell in np.unique(np.floor(points / CELL_M).astype(int), axis=0).tolist()}
    assert seen == {(i, j, k) for i, j in COLUMNS for k in STOREYS}


def test_building_is_closed() -> None:
    camera = camera_from_field_of_view(256, 256, horizontal_deg=91.0)
    for eye in EYES_M:
        for T in looks(eye):
            hits = cast(scene("building"), camera, T)
            assert (hits.seen >= 0).all()
            assert hits.range_m.max() < 36


def test_robots_fit_through_the_building() -> None:
    near = set()
    for start, end in ROBOT_LINES_M:
        steps = int(np.hypot(end[0] - start[0], end[1] - start[1]) / 0.05) + 1
        for z in np.linspace(-0.8, 0, 9):
            line = np.column_stack([np.linspace(start, end, steps), np.full(steps, z)])
            for solid in scene("building").solids:
                if not solid.name.endswith(" floor") and solid.distance_m(line).min() < CLEARANCE_M:
                    near.add(solid.name)
    assert near == set()


def test_robots_drive_on_floor() -> None:
    for start, end in ROBOT_LINES_M:
        for x, y in np.linspace(start, end, 60):
            assert str(name_at("building", x, y, -1.21)).endswith(" floor")


def temperatures_c(name: str) -> Floats:
    return np.array([m.temperature_k - 273.15 for s in scene(name).solids for m in s.surface.materials])


def test_building_has_fire_and_hot_and_cold_pipes_and_people() -> None:
    found = temperatures_c("building")
    assert found.max() + 273.15 == pytest.approx(900, abs=1)
    assert found.min() < 0
    for name, low, high in (("hot pipe", 55, 70), ("hot bare pipe", 55, 70), ("cold pipe", 7, 9)):
        number = scene("building").number_of(name)
        assert low <= scene("building").solids[number].surface.material.temperature_k - 273.15 <= high
    heads = [s for s in scene("building").solids if s.name.endswith("/head") and "frame" not in s.name]
    assert len([head for head in heads if head.surface.material.temperature_k == pytest.approx(309.15)]) >= 5


def test_bare_metal_differs_from_paint() -> None:
    solids = {solid.name: solid for solid in scene("building").solids}
    assert solids["hot bare pipe"].surface.material.emissivity == 0.2
    assert solids["hot pipe"].surface.material.emissivity > 0.85


def test_building_has_glass_and_a_mirror_that_show_something_else() -> None:
    kinds = [solid.surface.material.optics for solid in scene("building").solids]
    assert kinds.count(Optics.GLASS) >= 4
    camera = camera_from_field_of_view(32, 24, horizontal_deg=10.0)
    for eye, at, way in (((17.0, 9.0, 0.2), (17.0, 10.5, 0.2), GLASS), ((17.5, 23.0, 0.0), (17.5, 19.5, 0.0), MIRROR)):
        hits = cast(scene("building"), camera, look_at(np.array(eye, dtype=float), np.array(at, dtype=float)))
        assert (hits.way & way).all()
        assert (hits.seen >= 0).all()
        assert (hits.path_m > hits.range_m + 1).all()


def test_building_has_signs_that_shine_back() -> None:
    shining = {s.name for s in scene("building").solids if max(m.retroreflection for m in s.surface.materials) >= 300}
    assert {"exit sign west/sign", "exit sign lab/sign", "tape north 1"} <= shining


@pytest.mark.parametrize("name", ["building", "yard"])
def test_no_two_upright_boxes_share_a_visible_face(name: str) -> None:
    """Rounding would decide which of the two a ray meets. Turned boxes are not looked at."""
    boxes = [
        solid
        for solid in scene(name).solids
        if isinstance(solid.shape, Box) and np.allclose(np.abs(solid.T_map_solid[:3, :3]).max(axis=0), 1)
    ]
    bounds = np.array([np.concatenate(box.bounds_m()) for box in boxes])
    shared = []
    for a in range(len(boxes)):
        low, high = np.maximum(bounds[a, :3], bounds[:, :3]), np.minimum(bounds[a, 3:], bounds[:, 3:])
        for face in range(6):
            axis = face % 3
            across = [other for other in range(3) if other != axis]
            overlap = (high - low)[:, across].min(axis=1) > SAME_M
            for b in np.flatnonzero(overlap & (np.abs(bounds[:, face] - bounds[a, face]) < SAME_M)):
                before = (low[b] + high[b]) / 2
                before[axis] = bounds[a, face] + (1e-3 if face >= 3 else -1e-3)
                if b > a and scene(name).distance_m(before) > 0:
                    shared.append((boxes[a].name, boxes[b].name))
    assert shared == []


@pytest.mark.parametrize("name", ["building", "yard"])
def test_every_solid_touches_another(name: str) -> None:
    """To 3 cm, by points of a lattice in each; that all of them hang together is not shown."""
    solids = scene(name).solids
    bounds = np.array([np.concatenate(solid.bounds_m()) for solid in solids])
    alone = []
    for n, solid in enumerate(solids):
        if isinstance(solid.shape, Plane):
            continue
        gaps_m = np.maximum(bounds[:, :3] - bounds[n, 3:], bounds[n, :3] - bounds[:, 3:]).max(axis=1)
        others = [other for k, other in enumerate(solids) if k != n and gaps_m[k] < 0.03]
        points = points_in(solid)
        if not any(
            other.distance_m(points).min() < 0.03 or solid.distance_m(points_in(other)).min() < 0.03 for other in others
        ):
            alone.append(solid.name)
    assert alone == []


def points_in(solid: Solid) -> Floats:
    """A lattice of points in a solid, on its border too; map frame; of a plane, one far away."""
    if isinstance(solid.shape, Plane):
        return np.full((1, 3), 1e9)
    steps = np.linspace(-1, 1, 7)
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = unit * np.array(solid.shape.half_m)
    points = points[solid.shape.distance_m(points) <= 1e-9]
    return np.asarray(points @ solid.T_map_solid[:3, :3].T + solid.T_map_solid[:3, 3])


def ground_m(x: float, y: float) -> float:
    """Height of what a ray from high above (x, y) meets in the yard."""
    T = look_at(np.array([x, y, 30.0]), np.array([x, y, 0.0]), up=np.array([0.0, 1.0, 0.0]))
    return 30.0 - float(cast(scene("yard"), camera_from_field_of_view(1, 1, horizontal_deg=1.0), T).range_m[0])


def test_yard_slopes_by_6_degrees_and_its_bank_by_28() -> None:
    meadow = (ground_m(14, 2) - ground_m(-15, 2)) / 29
    assert np.degrees(np.arctan(meadow)) == pytest.approx(6, abs=0.01)
    up = np.array([(ground_m(0, 16) - ground_m(0, 11)) / 5, (ground_m(4, 11) - ground_m(0, 11)) / 4])
    assert np.degrees(np.arctan(np.linalg.norm(up))) == pytest.approx(28.5, abs=0.5)


def test_yard_has_a_cold_sky_a_warm_bonnet_and_two_people() -> None:
    yard = scene("yard")
    assert yard.sky_k < yard.ambient_k - 30
    solids = {solid.name: solid for solid in yard.solids}
    assert solids["car/bonnet"].surface.material.temperature_k == pytest.approx(333.15)
    assert {"person 1/head", "person 2/head", "container 1/body", "container 2/body", "shed/window"} <= set(solids)


def test_small_room_is_closed() -> None:
    """Points just outside the interior are solid, all around."""
    x, y, z = np.meshgrid(np.linspace(-0.05, 6.05, 62), np.linspace(-0.05, 5.05, 52), np.linspace(-0.05, 2.65, 28))
    outside = (x < 0) | (x > 6) | (y < 0) | (y > 5) | (z < 0) | (z > 2.6)
    assert (scene("small-room").solid_at(np.stack([x, y, z], axis=-1)[outside]) >= 0).all()


def test_small_room_says_what_is_where() -> None:
    places = {
        (3, 2, -0.1): "floor",
        (3, 2, 2.7): "ceiling",
        (0.1, 2, 0.5): "radiator",
        (2.9, 1.1, 1.2): "torso",
        (1.8, 3.1, 1.0): "pillar",
        (5.5, 0.5, 1.2): "cold tank dome",
        (4.05, 1.0, 1.0): "partition south",
        (4.05, 2.45, 1.0): None,
        (2.5, 2.5, 1.3): None,
    }
    assert {at: name_at("small-room", *at) for at in places} == places


def test_small_room_is_as_warm_as_it_looks() -> None:
    assert (scene("small-room").surfaces.emissivity == 1).all()
