"""The kernel against its slow twin and against the solids' own distances, on random and on ugly input."""

import math

import numpy as np
import pytest
from tests.cairn_sim.naive_raycast import naive_cast

from cairn_map.errors import BadInputError
from cairn_sim.raycast_kernels import cast_rays
from cairn_sim.room import Box, Cylinder, Floats, Room, Solid, Sphere, Surface, room_of, small_room

GREY = Surface((128, 128, 128), 293.0, 0.5)


def random_room(rng: np.random.Generator) -> Room:
    """Solids all around the origin, none of them holding it."""
    solids: list[Solid] = []
    while len(solids) < 30:
        at = tuple(rng.uniform(-4, 4, 3))
        sizes = rng.uniform(0.05, 1.5, 3)
        kind = rng.integers(3)
        solid: Solid
        if kind == 0:
            solid = Box("box", GREY, at, tuple(sizes), rng.uniform(-4, 4))
        elif kind == 1:
            solid = Cylinder("cylinder", GREY, at, sizes[0] / 2, sizes[1])
        else:
            solid = Sphere("sphere", GREY, at, sizes[0] / 2)
        if float(solid.distance_m(np.zeros(3))) > 0.01:
            solids.append(solid)
    return room_of(solids)


def random_directions(rng: np.random.Generator, n: int) -> Floats:
    d = rng.standard_normal((n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def cast(room: Room, origin: Floats, directions: Floats) -> tuple[Floats, np.ndarray, Floats, Floats]:
    return cast_rays(origin, directions, room.boxes, room.cylinders, room.spheres)


@pytest.mark.parametrize("seed", range(10))
def test_kernel_agrees_with_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    room, directions = random_room(rng), random_directions(rng, 3000)
    range_m, solid, _, _ = cast(room, np.zeros(3), directions)
    naive_range_m, naive_solid = naive_cast(room, np.zeros(3), directions)
    np.testing.assert_allclose(range_m, naive_range_m, rtol=0, atol=1e-9)
    # Where two solids overlap, the surface of both may be met at once.
    tied = solid != naive_solid
    assert tied.mean() < 1e-3
    assert 0.05 < (solid >= 0).mean() < 1


def test_kernel_agrees_with_its_slow_twin_along_the_axes_of_the_small_room() -> None:
    directions = np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0], [0, -0.6, 0.8]]])
    origin = np.array([2.9, 2.45, 1.1])
    range_m, solid, _, _ = cast(small_room(), origin, directions)
    naive_range_m, naive_solid = naive_cast(small_room(), origin, directions)
    np.testing.assert_allclose(range_m, naive_range_m, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(solid, naive_solid)
    np.testing.assert_allclose(range_m[2:6:3], [1.5, 1.1], rtol=0, atol=1e-12)


def test_hit_lies_on_the_solid_that_is_named() -> None:
    rng = np.random.default_rng(5)
    room, directions = random_room(rng), random_directions(rng, 5000)
    range_m, solid, _, _ = cast(room, np.zeros(3), directions)
    points = range_m[:, None] * directions
    for k, s in enumerate(room.solids):
        assert np.abs(s.distance_m(points[solid == k])).max(initial=0) < 1e-12
    free = room.distance_m(0.999 * points[solid >= 0])
    assert (free > 0).all()


def test_normal_is_the_gradient_of_the_distance() -> None:
    rng = np.random.default_rng(6)
    room, directions = random_room(rng), random_directions(rng, 3000)
    range_m, solid, normal, _ = cast(room, np.zeros(3), directions)
    hit = solid >= 0
    np.testing.assert_allclose(np.linalg.norm(normal[hit], axis=1), 1, rtol=0, atol=1e-9)
    assert ((normal * directions).sum(axis=1)[hit] < 0).all()
    outside = range_m[hit, None] * directions[hit] + 1e-6 * normal[hit]
    own = np.array([room.solids[k].distance_m(p) for k, p in zip(solid[hit], outside, strict=True)])
    np.testing.assert_allclose(own, 1e-6, rtol=0, atol=1e-10)


def test_ray_without_direction_and_ray_into_nothing_meet_nothing() -> None:
    room = room_of([Sphere("ball", GREY, (2, 0, 0), 0.5)])
    directions = np.array([[math.nan] * 3, [-1.0, 0, 0], [1.0, 0, 0]])
    range_m, solid, _, _ = cast(room, np.zeros(3), directions)
    assert range_m.tolist() == [math.inf, math.inf, 1.5]
    assert solid.tolist() == [-1, -1, 0]


def test_vertical_ray_meets_a_cylinder_at_its_end() -> None:
    room = room_of([Cylinder("post", GREY, (0, 0, 1), 0.5, 1.0)])
    up = np.array([[0.0, 0, 1]])
    range_m, _, normal, _ = cast(room, np.array([0.4, 0.0, 0.0]), up)
    assert range_m[0] == 1.0
    assert normal[0].tolist() == [0, 0, -1]
    assert cast(room, np.array([0.6, 0.0, 0.0]), up)[1][0] == -1


def test_ray_that_slides_along_a_face_of_a_box_gives_a_number() -> None:
    room = room_of([Box("box", GREY, (2, 0, 0), (1, 1, 1))])
    range_m, _, _, _ = cast(room, np.array([0.0, 0.5, 0.5]), np.array([[1.0, 0, 0]]))
    assert range_m[0] in (1.5, math.inf)


def test_uv_are_metres_along_the_surface() -> None:
    room = room_of([Cylinder("post", GREY, (0, 0, -1), 0.5, 2.0), Box("wall", GREY, (0, 9, 0), (4, 1, 2))])
    angle_rad = 0.3
    origin = 3 * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.1])
    _, solid, _, uv = cast(room, origin, np.array([[-math.cos(angle_rad), -math.sin(angle_rad), 0]]))
    np.testing.assert_allclose(uv[0], [0.5 * angle_rad, 0.3], atol=1e-12)
    _, solid, _, uv = cast(room, np.array([0.7, 2.0, 0.2]), np.array([[0.0, 1, 0]]))
    assert room.solids[solid[0]].name == "wall"
    np.testing.assert_allclose(uv[0], [0.7, 0.2], atol=1e-12)


def test_solids_and_surfaces_that_cannot_be_are_refused() -> None:
    with pytest.raises(BadInputError, match="sizes above 0"):
        Box("flat", GREY, (0, 0, 0), (1, 0, 1))
    with pytest.raises(BadInputError, match="sizes above 0"):
        Sphere("endless", GREY, (0, 0, 0), math.inf)
    with pytest.raises(BadInputError, match="kelvin above 0"):
        Surface((0, 0, 0), -5.0, 0.5)
    with pytest.raises(BadInputError, match="at least one solid"):
        room_of([])
