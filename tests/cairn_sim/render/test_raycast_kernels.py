"""The kernels against their slow twins and against the solids' own distances, on random and on ugly input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.naive.raycast import naive_cast, naive_sight

from cairn_calib.rig.poses import look_at
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_sim.render.raycast_kernels import Hits, cast_each, cast_rays
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.scene_file import load_scene
from cairn_sim.scene.solids import Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

GREY = Surface(Material())
GLASS = Surface(Material(optics=Optics.GLASS))
MIRROR = Surface(Material(optics=Optics.MIRROR))


def random_scene(rng: np.random.Generator, *, count: int = 30, surfaces: tuple[Surface, ...] = (GREY,)) -> Scene:
    """Solids turned every way, all around the origin, none of them holding it; and a slanted ground."""
    solids = [Solid("ground", Plane(), GREY, placed((0, 0, -5), tuple(rng.uniform(-0.3, 0.3, 3))))]
    while len(solids) < count:
        sizes = rng.uniform(0.05, 1.5, 3)
        shapes: tuple[Shape, ...] = (Box(tuple(sizes)), Cylinder(sizes[0] / 2, sizes[1]), Sphere(sizes[0] / 2))
        pose = placed(tuple(rng.uniform(-4, 4, 3)), tuple(rng.uniform(-4, 4, 3)))
        surface = surfaces[rng.integers(len(surfaces))]
        solid = Solid(f"solid {len(solids)}", shapes[rng.integers(3)], surface, pose)
        if float(solid.distance_m(np.zeros(3))) > 0.01:
            solids.append(solid)
    return scene_of(solids)


def random_directions(rng: np.random.Generator, n: int) -> Floats:
    d = rng.standard_normal((n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def cast(scene: Scene, origin: Floats, directions: Floats, *, bundle: int = 7, opaque: bool = False) -> Hits:
    order = np.arange(len(directions), dtype=np.int32)
    starts = np.append(order[::bundle], np.int32(len(directions)))
    return cast_rays(origin, np.eye(3), directions, order, starts, scene.shapes, opaque)


@pytest.mark.parametrize("bundle", [1, 7, 3000])
@pytest.mark.parametrize("seed", range(6))
def test_kernel_agrees_with_its_slow_twin(seed: int, bundle: int) -> None:
    rng = np.random.default_rng(seed)
    scene, directions = random_scene(rng), random_directions(rng, 3000)
    hits = cast(scene, np.zeros(3), directions, bundle=bundle)
    naive_range_m, naive_solid = naive_cast(scene, np.zeros(3), directions)
    np.testing.assert_allclose(hits.range_m, naive_range_m, rtol=1e-12, atol=1e-9)
    # Where two solids overlap, the surface of both may be met at once.
    assert (hits.solid != naive_solid).mean() < 1e-3
    assert 0.05 < (hits.solid > 0).mean() < 1


def test_rays_in_bundles_or_one_by_one_give_the_same_bits() -> None:
    rng = np.random.default_rng(11)
    scene, directions = random_scene(rng, count=200), random_directions(rng, 2000)
    hits = cast(scene, np.zeros(3), directions, bundle=16, opaque=True)
    range_m, solid, normal = cast_each(np.zeros((2000, 3)), directions, scene.shapes)
    assert range_m.tobytes() == hits.range_m.tobytes()
    assert solid.tobytes() == hits.solid.tobytes()
    assert normal.astype(np.float32).tobytes() == hits.normal.tobytes()


def test_a_camera_may_be_turned_and_its_rays_come_in_any_order() -> None:
    rng = np.random.default_rng(12)
    scene, rays = random_scene(rng), random_directions(rng, 500)
    T = look_at((0.1, 0.2, 0.3), (1, 2, 3))
    order = rng.permutation(500).astype(np.int32)
    hits = cast_rays(
        T[:3, 3].copy(), T[:3, :3].copy(), rays, order, np.array([0, 100, 100, 500], np.int32), scene.shapes, False
    )
    range_m, solid = naive_cast(scene, T[:3, 3], rays @ T[:3, :3].T)
    np.testing.assert_allclose(hits.range_m, range_m, rtol=1e-12, atol=1e-9)
    assert (hits.solid != solid).mean() < 1e-2


def test_kernel_agrees_with_its_slow_twin_along_the_axes_of_the_small_room() -> None:
    directions = np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0], [0, -0.6, 0.8]]])
    origin = np.array([2.9, 2.45, 1.1])
    hits = cast(load_scene("small-room"), origin, directions)
    naive_range_m, naive_solid = naive_cast(load_scene("small-room"), origin, directions)
    np.testing.assert_allclose(hits.range_m, naive_range_m, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(hits.solid, naive_solid)
    np.testing.assert_allclose(hits.range_m[2:6:3], [1.5, 1.1], rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_light_goes_through_glass_and_round_mirrors_as_step_by_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, count=40, surfaces=(GREY, GLASS, MIRROR))
    directions = random_directions(rng, 400)
    hits = cast(scene, np.zeros(3), directions)
    sights = [naive_sight(scene, np.zeros(3), d) for d in directions]
    same = np.array([s.way == w and s.solid == k for s, w, k in zip(sights, hits.way, hits.seen, strict=True)])
    # Where panes overlap, or a ray grazes an edge, the step-by-step one may step over the other's surface.
    assert same.mean() > 0.95
    path_m = np.array([s.path_m for s in sights])
    near = np.isclose(hits.path_m[same], path_m[same], rtol=0, atol=1e-5)
    assert near.mean() > 0.99
    assert {int(w) for w in hits.way} == {0, 1, 2, 3}
    naive_range_m, _ = naive_cast(scene, np.zeros(3), directions)
    np.testing.assert_allclose(hits.range_m, naive_range_m, rtol=1e-12, atol=1e-9)


def test_in_the_far_infrared_glass_and_mirrors_are_walls() -> None:
    rng = np.random.default_rng(3)
    scene = random_scene(rng, count=40, surfaces=(GREY, GLASS, MIRROR))
    hits = cast(scene, np.zeros(3), random_directions(rng, 500), opaque=True)
    np.testing.assert_array_equal(hits.seen, hits.solid)
    np.testing.assert_array_equal(hits.path_m, hits.range_m)
    assert not hits.way.any()


def test_a_mirror_shows_what_stands_before_it_as_far_as_the_light_goes() -> None:
    mirror = Solid("mirror", Box((0.1, 10, 10)), MIRROR, placed((2.05, 0, 0)))
    wall = Solid("wall", Box((0.1, 10, 10)), GREY, placed((-3.05, 0, 0)))
    hits = cast(scene_of([mirror, wall]), np.zeros(3), np.array([[1.0, 0, 0]]))
    np.testing.assert_allclose([hits.range_m[0], hits.path_m[0]], [2, 7], rtol=1e-15)
    assert (hits.seen[0], hits.way[0]) == (1, 2)
    assert hits.normal[0].tolist() == [1, 0, 0] and hits.incidence[0] == 1


def test_between_two_mirrors_light_ends() -> None:
    mirrors = [Solid(f"mirror {x}", Box((0.1, 10, 10)), MIRROR, placed((x, 0, 0))) for x in (-2, 2)]
    hits = cast(scene_of(mirrors), np.zeros(3), np.array([[1.0, 0, 0]]))
    assert hits.seen[0] == -1 and math.isinf(hits.path_m[0]) and hits.passes[0] == 9


def test_hit_lies_on_the_solid_that_is_named() -> None:
    rng = np.random.default_rng(5)
    scene, directions = random_scene(rng), random_directions(rng, 5000)
    hits = cast(scene, np.zeros(3), directions)
    points = hits.range_m[:, None] * directions
    for k, solid in enumerate(scene.solids):
        assert np.abs(solid.distance_m(points[hits.solid == k])).max(initial=0) < 1e-11
    assert (scene.distance_m(0.999 * points[hits.solid >= 0]) > 0).all()


def test_normal_is_the_gradient_of_the_distance() -> None:
    rng = np.random.default_rng(6)
    scene, directions = random_scene(rng), random_directions(rng, 3000)
    hits = cast(scene, np.zeros(3), directions)
    hit = hits.solid >= 0
    np.testing.assert_allclose(np.linalg.norm(hits.normal[hit], axis=1), 1, rtol=0, atol=1e-6)
    np.testing.assert_allclose(hits.incidence[hit], -(hits.normal * directions).sum(axis=1)[hit], rtol=0, atol=1e-6)
    assert (hits.incidence[hit] > 0).all()
    outside = hits.range_m[hit, None] * directions[hit] + 1e-3 * hits.normal[hit]
    own = np.array([scene.solids[k].distance_m(p) for k, p in zip(hits.solid[hit], outside, strict=True)])
    np.testing.assert_allclose(own, 1e-3, rtol=0, atol=1e-8)


def test_ray_without_direction_and_ray_into_nothing_meet_nothing() -> None:
    scene = scene_of([Solid("ball", Sphere(0.5), GREY, placed((2, 0, 0)))])
    directions = np.array([[math.nan] * 3, [-1.0, 0, 0], [1.0, 0, 0]])
    for bundle in (1, 3):
        hits = cast(scene, np.zeros(3), directions, bundle=bundle)
        assert hits.range_m.tolist() == hits.path_m.tolist() == [math.inf, math.inf, 1.5]
        assert hits.solid.tolist() == [-1, -1, 0]
    around_it = scene_of([Solid("post", Cylinder(0.5, 9), GREY, placed((0, 0, 0)))])
    assert cast(around_it, np.zeros(3), directions[:1]).solid.tolist() == [-1]


def test_no_rays_meet_nothing() -> None:
    hits = cast(load_scene("small-room"), np.array([2.0, 2, 1]), np.zeros((0, 3)))
    assert len(hits.range_m) == 0


def test_vertical_ray_meets_a_cylinder_at_its_end() -> None:
    scene = scene_of([Solid("post", Cylinder(0.5, 1.0), GREY, placed((0, 0, 1.5)))])
    up = np.array([[0.0, 0, 1]])
    hits = cast(scene, np.array([0.4, 0.0, 0.0]), up)
    assert hits.range_m[0] == 1.0
    assert hits.normal[0].tolist() == [0, 0, -1]
    assert cast(scene, np.array([0.6, 0.0, 0.0]), up).solid[0] == -1


def test_ray_that_slides_along_a_face_of_a_box_gives_a_number() -> None:
    scene = scene_of([Solid("box", Box((1, 1, 1)), GREY, placed((2, 0, 0)))])
    hits = cast(scene, np.array([0.0, 0.5, 0.5]), np.array([[1.0, 0, 0]]))
    assert hits.range_m[0] in (1.5, math.inf)


def test_a_scene_of_planes_alone_needs_no_tree() -> None:
    hits = cast(scene_of([Solid("ground", Plane(), GREY, placed((0, 0, -2)))]), np.zeros(3), np.array([[0.0, 0, -1]]))
    assert hits.range_m[0] == 2 and hits.normal[0].tolist() == [0, 0, 1]


def test_a_texture_takes_turns_in_metres_along_the_surface_from_its_phase() -> None:
    checker = Surface(Material(), Material(), (0.5, 0.25), (0.1, 0.0))
    wall = scene_of([Solid("wall", Box((4, 1, 2)), checker, placed((0, 9, 0)))])

    def second(u_m: float, v_m: float) -> int:
        return int(cast(wall, np.array([u_m, 2.0, v_m]), np.array([[0.0, 1, 0]])).second[0])

    assert [second(u, 0.1) for u in (0.09, 0.11, 0.59, 0.61, 1.11)] == [1, 0, 0, 1, 0]
    assert [second(0.2, v) for v in (-0.01, 0.01, 0.24, 0.26)] == [1, 0, 0, 1]
    at = np.array([[0.09, 8.4, 0.1], [0.2, 8.6, 0.1]])
    two = replace(checker, second=Material(temperature_k=400.0))
    warm = scene_of([Solid("wall", Box((4, 1, 2)), two, placed((0, 9, 0)))])
    np.testing.assert_allclose(warm.temperature_k_at(at), [400, 293.15])


def test_a_cylinders_texture_runs_around_it() -> None:
    post = scene_of(
        [Solid("post", Cylinder(0.5, 2.0), Surface(Material(), Material(), (0.25, math.inf)), placed((0, 0, 0)))]
    )
    for angle_rad, expected in ((0.1, 0), (0.49, 0), (0.51, 1), (-0.1, 1), (1.1, 0)):
        ahead = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.1])
        assert cast(post, 3 * ahead * [1, 1, 0], -np.array([ahead * [1, 1, 0]])).second[0] == expected


def test_grain_is_even_and_depends_on_the_place_alone() -> None:
    surface = Surface(Material(), grain=0.2, grain_m=0.05)
    wall = scene_of([Solid("wall", Box((1, 20, 20)), surface, placed((3.5, 0, 0)))])
    directions = random_directions(np.random.default_rng(1), 20_000) * [1, 1, 1]
    directions[:, 0] = np.abs(directions[:, 0]) + 1
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    grain = cast(wall, np.zeros(3), directions).grain
    assert np.abs(grain).max() <= 1 and abs(float(grain.mean())) < 0.02 and 0.2 < grain.std() < 0.6
    moved = directions * cast(wall, np.zeros(3), directions).range_m[:, None] - [1, 0, 0]
    again = cast(wall, np.array([1.0, 0, 0]), moved / np.linalg.norm(moved, axis=1, keepdims=True)).grain
    np.testing.assert_allclose(again, grain, atol=1e-5)


def test_solids_and_surfaces_that_cannot_be_are_refused() -> None:
    with pytest.raises(BadInputError, match="finite sizes above 0"):
        Solid("flat", Box((1, 0, 1)), GREY, placed((0, 0, 0)))
    with pytest.raises(BadInputError, match="finite sizes above 0"):
        Solid("endless", Sphere(math.inf), GREY, placed((0, 0, 0)))
    with pytest.raises(BadInputError, match="needs 50 to 5000 K"):
        Material(temperature_k=-5.0)
    with pytest.raises(BadInputError, match="same optics"):
        Surface(Material(), Material(optics=Optics.GLASS))
    with pytest.raises(BadInputError, match="needs 1 to"):
        scene_of([])
