"""Laws of casting: the tree of boxes never changes what a ray meets; and all that a pattern depends on."""

import itertools
import math

import numpy as np
import pytest

from cairn_map.arrays import Floats
from cairn_sim.render.raycast_kernels import Hits, cast_each, cast_rays
from cairn_sim.scene.scene import Scene, scene_of
from cairn_sim.scene.solid_kernels import enter
from cairn_sim.scene.solids import Box, Cylinder, Plane, Shape, Solid, Sphere, placed
from cairn_sim.scene.surfaces import Material, Surface

GREY = Surface(Material())


def cast(scene: Scene, origin: Floats, directions: Floats, *, bundle: int) -> Hits:
    order = np.arange(len(directions), dtype=np.int32)
    starts = np.append(order[::bundle], np.int32(len(directions)))
    return cast_rays(origin, np.eye(3), directions, order, starts, scene.shapes, True)


def entered(scene: Scene, origin: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """The nearest that each ray enters and its number, of all solids one after the other, without a tree."""
    s = scene.shapes
    best, which = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for k in range(len(scene.solids)):
        for n, (dx, dy, dz) in enumerate(directions):
            t, _ = enter(origin[0], origin[1], origin[2], dx, dy, dz, k, s.kind, s.frame, s.half_m)
            if 0 < t < best[n]:
                best[n], which[n] = t, k
    return best, which


def unit(directions: Floats) -> Floats:
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def rim(solid: Solid, rng: np.random.Generator, count: int) -> Floats:
    """(count, 3) points of the map where a solid touches the box around it, or of a box's own edges and corners."""
    half = np.array(solid.shape.half_m)
    local = rng.uniform(-1, 1, (count, 3))
    if isinstance(solid.shape, Box):
        on_edge = rng.permuted(np.tile([True, True, False], (count, 1)), axis=1) | (rng.random((count, 1)) < 0.3)
        local = np.where(on_edge, np.sign(local), local) * half
    else:
        axis = rng.integers(3, size=count)
        local = np.sign(local) * (np.arange(3) == axis[:, None]) * half
    return np.asarray(local @ solid.T_map_solid[:3, :3].T + solid.T_map_solid[:3, 3])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_ray_past_the_rim_of_a_solid_meets_what_the_solid_itself_says(seed: int, turned: bool) -> None:
    """To the bit: the boxes of the tree may bring a solid in vain, and never keep one back."""
    rng = np.random.default_rng(seed)
    for _ in range(30):
        size = rng.uniform(0.05, 2, 3)
        shapes: tuple[Shape, ...] = (Box(tuple(size)), Box(tuple(size)), Cylinder(size[0], size[1]), Sphere(size[0]))
        angles = tuple(rng.uniform(-4, 4, 3)) if turned else (0.0, 0.0, 0.0)
        solids = [
            Solid(str(n), shape, GREY, placed(tuple(unit(rng.standard_normal(3)) * rng.uniform(5, 20)), angles))
            for n, shape in enumerate(shapes)
        ]
        scene, origin = scene_of(solids), rng.uniform(-1, 1, 3)
        directions = unit(np.concatenate([rim(solid, rng, 60) for solid in solids]) - origin)
        range_m, solid = entered(scene, origin, directions)
        for bundle in (1, 60):
            hits = cast(scene, origin, directions, bundle=bundle)
            assert hits.range_m.tobytes() == range_m.tobytes() and hits.solid.tolist() == solid.tolist()
        each_m, each, _ = cast_each(np.tile(origin, (len(directions), 1)), directions, scene.shapes)
        assert each_m.tobytes() == range_m.tobytes() and each.tolist() == solid.tolist()


@pytest.mark.parametrize("bundle", [1, 8])
def test_a_ray_in_the_plane_of_a_face_meets_what_the_solid_itself_says(bundle: int) -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        size, at = rng.uniform(0.1, 3, 3), rng.uniform(-5, 5, 3)
        at[0] = 6.0
        scene = scene_of([Solid("box", Box(tuple(size)), GREY, placed(tuple(at)))])
        corners = [at + np.array(signs) * size / 2 for signs in itertools.product((-1, 1), repeat=3)]
        for corner in corners:
            # In the plane of the face above it, and along the edge.
            origin = np.array([0.0, rng.uniform(-5, 5), corner[2]])
            directions = np.array([*unit(np.array([*(corner[:2] - origin[:2]), 0.0])[None]), [1.0, 0.0, 0.0]])
            for start in (origin, np.array([0.0, corner[1], corner[2]])):
                range_m, _ = entered(scene, start, directions)
                assert cast(scene, start, directions, bundle=bundle).range_m.tobytes() == range_m.tobytes()
                each_m, _, _ = cast_each(np.tile(start, (2, 1)), directions, scene.shapes)
                assert each_m.tobytes() == range_m.tobytes()


TOWARDS_MINUS_X = np.array([[0.0, 0, -1, 2], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
FRONT = [
    Solid("plane", Plane(), GREY, TOWARDS_MINUS_X),
    *(Solid(f"{depth_m} m", Box((depth_m, 8, 8)), GREY, placed((2 + depth_m / 2, 0, 0))) for depth_m in (0.5, 1, 2, 4)),
]
"""Solids whose faces all lie at x = 2, of which the tree makes an order of its own."""
EXACT = np.array([[1.0, 0, 0], [1, 0.25, 0.5], [1, -0.5, 0.125], [1, 0.5, -1]])
"""Directions, not unit vectors, whose inverses are exact, so that all faces are met at the same range."""


@pytest.mark.parametrize("planes", [0, 1])
def test_of_coincident_faces_the_lower_number_is_met_whatever_the_order(planes: int) -> None:
    for solids in itertools.permutations(FRONT[1 - planes :]):
        scene = scene_of(solids)
        for bundle in (1, 4):
            hits = cast(scene, np.zeros(3), EXACT, bundle=bundle)
            assert hits.range_m.tolist() == [2.0] * 4 and hits.solid.tolist() == [0] * 4
        range_m, solid, _ = cast_each(np.zeros((4, 3)), EXACT, scene.shapes)
        assert range_m.tolist() == [2.0] * 4 and solid.tolist() == [0] * 4


def test_of_the_same_solid_many_times_the_first_is_met() -> None:
    rng = np.random.default_rng(5)
    kinds: tuple[Shape, ...] = (Box((1, 2, 3)), Cylinder(0.7, 2), Sphere(0.9))
    poses = [placed(tuple(unit(rng.standard_normal(3)) * 4), tuple(rng.uniform(-3, 3, 3))) for _ in kinds]
    solids = [Solid(str(n), kinds[n % 3], GREY, poses[n % 3]) for n in range(24)]
    scene, directions = scene_of(solids), unit(rng.standard_normal((4000, 3)))
    hits = cast(scene, np.zeros(3), directions, bundle=16)
    _, each, _ = cast_each(np.zeros((4000, 3)), directions, scene.shapes)
    assert set(hits.solid.tolist()) == set(each.tolist()) == {-1, 0, 1, 2}


def grains(scene: Scene, origin: Floats, points: Floats) -> Floats:
    hits = cast(scene, origin, unit(points - origin), bundle=16)
    np.testing.assert_allclose(hits.range_m, np.linalg.norm(points - origin, axis=1), rtol=1e-9)
    return hits.grain.astype(np.float64)


def likeness(one: Floats, other: Floats) -> float:
    return float(np.corrcoef(one, other)[0, 1])


SPECKLED = Surface(Material(), grain=0.5, grain_m=0.05)
SQUARE = np.random.default_rng(3).uniform(-0.95, 0.95, (2000, 2))
"""Places on a face of 2 x 2 m, as lengths along it; some 1600 spots."""


def test_two_faces_of_a_box_have_patterns_of_their_own() -> None:
    scene = scene_of([Solid("box", Box((2, 2, 2)), SPECKLED, placed((0, 0, 0)))])
    (u, v), one = SQUARE.T, np.ones(len(SQUARE))
    seen = {}
    for name, points in {"x": (one, u, v), "y": (u, one, v), "z": (u, v, one)}.items():
        seen[name] = grains(scene, np.array([3.0, 3.5, 4.0]), np.stack(points, axis=1))
        again = grains(scene, np.array([4.0, 5.0, 3.0]), np.stack(points, axis=1))
        np.testing.assert_allclose(again, seen[name], atol=1e-5)
    for one_face, other in itertools.combinations(seen.values(), 2):
        assert abs(likeness(one_face, other)) < 0.15


def test_two_boxes_have_patterns_of_their_own_wherever_they_stand() -> None:
    two = [Solid(str(x), Box((2, 2, 2)), SPECKLED, placed((x, 0, 0))) for x in (-3.0, 3.0)]
    u, v = SQUARE.T
    left, right = (
        grains(scene_of(two), np.zeros(3), np.stack([np.full(len(u), x), u, v], axis=1)) for x in (-2.0, 2.0)
    )
    assert abs(likeness(left, right)) < 0.15
    # And what stands first elsewhere has there the pattern that it had here.
    moved = scene_of([Solid("moved", Box((2, 2, 2)), SPECKLED, placed((0, 0, 9)))])
    there = grains(moved, np.array([4.0, 0, 9]), np.stack([np.ones(len(u)), u, v + 9], axis=1))
    assert likeness(left, there) > 0.99 and math.isfinite(there.sum())
