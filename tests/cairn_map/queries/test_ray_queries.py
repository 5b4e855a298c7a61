"""Rays through a snapshot against exact twins, and where they start, end and graze."""

import itertools
import math
from functools import partial

import numpy as np
import pytest
from tests.fixtures.bounded import result_within
from tests.fixtures.map.made import MIDDLE, PLAIN
from tests.fixtures.map.worlds import random_map, random_points, snapshot_with, world_of
from tests.naive import queries as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_map.queries import distance_queries
from cairn_map.queries.distance_queries import NO_VOXEL
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.queries.occupancy_states import State

EDGE_M = 0.05
WALL = {(10, y, z): (3, 0) for y in range(-12, 12) for z in range(-12, 12)}
"""Across x, from 0.5 m on."""


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the tests have several."""
    monkeypatch.setattr(distance_queries, "CHUNK", 32)


@pytest.mark.parametrize("geometry", [PLAIN, Geometry(voxel_edge_um=50_000, depth=4, channels=())])
@pytest.mark.parametrize("ends_in_unknown", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rays_end_where_the_twin_says(geometry: Geometry, seed: int, ends_in_unknown: bool) -> None:
    whole = random_map(seed, geometry)
    world, rng = world_of(whole), np.random.default_rng(seed)
    origins = random_points(seed, whole, 100)
    directions = rng.normal(size=origins.shape)
    directions[::4] = rng.integers(-1, 2, (len(directions[::4]), 3)) * [2.0, 1.0, 4.0]
    directions[(directions == 0).all(axis=1)] = [0, 0, -3]
    directions[5:] *= rng.choice([1e-200, 1e-3, 1, 1e200], (len(directions) - 5, 1))
    ends = snapshot_of(whole).cast_rays(origins, directions, max_range_m=0.6, ends_in_unknown=ends_in_unknown)
    expected = [
        naive.cast(
            world,
            naive.position(origin, geometry.voxel_edge_um * 1000),
            tuple(direction / np.abs(direction).max()),
            range_max=0.6 / EDGE_M,
            ends_in_unknown=ends_in_unknown,
        )
        for origin, direction in zip(origins, directions, strict=True)
    ]
    np.testing.assert_allclose(ends.distance_m / EDGE_M, [end for end, _ in expected], atol=1e-6)
    assert ends.states.tolist() == [state for _, state in expected]
    assert len(np.unique(ends.states)) >= 2
    ended = np.isfinite(ends.distance_m)
    assert [naive.state(world, tuple(voxel)) for voxel in ends.voxels[ended].tolist()] == ends.states[ended].tolist()
    assert (ends.voxels[~ended] == NO_VOXEL).all() and np.isnan(ends.points_m[~ended]).all()
    # Where it enters: on the ray, and on that voxel's surface, or in it where it starts there.
    low_m = ends.voxels[ended] * EDGE_M
    there = ends.points_m[ended]
    np.testing.assert_allclose(np.linalg.norm(there - origins[ended], axis=1), ends.distance_m[ended], atol=1e-9)
    assert ((there >= low_m - 1e-7) & (there <= low_m + EDGE_M + 1e-7)).all()


@pytest.mark.parametrize("seed", [1, 2])
def test_rays_meet_the_voxel_that_a_cut_with_each_of_them_finds_first(seed: int) -> None:
    whole = random_map(seed, PLAIN)
    world, rng = world_of(whole), np.random.default_rng(seed)
    origins, directions = random_points(seed, whole, 60), rng.normal(size=(60, 3))
    ends = snapshot_of(whole).cast_rays(origins, directions, max_range_m=math.inf)
    positions = [naive.position(origin, 50_000_000) for origin in origins]
    expected = [naive.first_hit(world, o, tuple(d)) for o, d in zip(positions, directions, strict=True)]
    np.testing.assert_allclose(ends.distance_m / EDGE_M, expected, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("aside_m", [0.0, 0.02, 0.05, -0.05])
def test_rays_along_an_axis_meet_what_lies_on_their_line(axis: int, sign: int, aside_m: float) -> None:
    target, start = np.zeros(3, np.int64), np.full((1, 3), aside_m)
    target[axis] = 7 * sign
    start[0, axis] = 0.025
    direction = np.zeros((1, 3))
    direction[0, axis] = sign
    ends = snapshot_with(PLAIN, {tuple(target.tolist()): (1, 0)}).cast_rays(start, direction, max_range_m=1)
    # A ray in the border between two voxels is in the upper one.
    assert ends.hit.tolist() == [0 <= aside_m < 0.05]
    if ends.hit[0]:
        assert ends.distance_m[0] == pytest.approx(0.325)
        assert ends.voxels[0].tolist() == target.tolist()


def test_a_diagonal_ray_passes_between_voxels_that_it_only_touches() -> None:
    beside = {voxel: (1, 0) for voxel in itertools.product(range(-4, 5), repeat=3) if len(set(voxel)) > 1}
    diagonals = np.array(list(itertools.product((1, -1), repeat=3)), float)
    through = np.array([(1, 1, 1), (-1, -1, -1)], float)
    snapshot = snapshot_with(PLAIN, beside)
    ends = snapshot.cast_rays(np.full((2, 3), 0.025), through, max_range_m=1)
    assert not ends.hit.any()
    ends = snapshot.cast_rays(np.full((8, 3), 0.025), diagonals, max_range_m=1)
    assert ends.hit.tolist() == [abs(sum(d)) != 3 for d in diagonals.tolist()]


def test_a_ray_that_starts_in_an_occupied_voxel_ends_there() -> None:
    ends = snapshot_with(PLAIN, WALL).cast_rays([[0.51, 0, 0]] * 2, [[1, 0, 0], [-1, 0, 0]], max_range_m=0)
    assert ends.distance_m.tolist() == [0, 0]
    assert ends.voxels.tolist() == [[10, 0, 0]] * 2


@pytest.mark.parametrize("max_range_m", [0.5, 0.5 - 1e-9])
def test_what_lies_at_the_maximum_range_is_met(max_range_m: float) -> None:
    ends = snapshot_with(PLAIN, WALL).cast_rays([[0, 0.01, 0.01]], [[9, 0, 0]], max_range_m=max_range_m)
    assert ends.hit.tolist() == [max_range_m == 0.5]
    assert ends.distance_m.tolist() == ([0.5] if max_range_m == 0.5 else [math.inf])
    assert ends.states.tolist() == [State.OCCUPIED if max_range_m == 0.5 else State.FREE]


def test_rays_from_far_outside_find_the_map_and_those_that_pass_it_end() -> None:
    snapshot = snapshot_with(PLAIN, WALL)
    origins = [[-4e6, 0.01, 0.01], [4e6, 0.01, 0.01], [-4e6, 0.01, 0.01], [0.2, 4e6, 0.1]]
    directions = [[1, 0, 0], [-1, 0, 0], [-1, 0, 0], [0, -1, 0]]
    geometry = Geometry(voxel_edge_um=1_000_000, depth=3, channels=())
    ends = snapshot_with(geometry, WALL).cast_rays(origins, directions, max_range_m=math.inf)
    assert ends.hit.tolist() == [True, True, False, False]
    assert ends.distance_m[:2].tolist() == [4e6 + 10, 4e6 - 11]
    near = snapshot.cast_rays([[-300, 0.01, 0.01]], [[1, 0, 0]], max_range_m=1000)
    assert near.distance_m[0] == pytest.approx(300.5)


def test_unknown_ends_a_ray_only_where_asked() -> None:
    snapshot = snapshot_with(PLAIN, WALL | {(x, 0, 0): (0, 1) for x in range(8)})
    ray = [[0.01, 0.01, 0.01]], [[1, 0, 0]]
    assert snapshot.cast_rays(*ray, max_range_m=5).hit.all()
    ends = snapshot.cast_rays(*ray, max_range_m=5, ends_in_unknown=True)
    assert ends.states.tolist() == [State.UNKNOWN]
    assert ends.voxels.tolist() == [[8, 0, 0]]
    assert ends.distance_m[0] == pytest.approx(0.39)
    assert snapshot.cast_rays(*ray, max_range_m=0.3, ends_in_unknown=True).states.tolist() == [State.FREE]


@pytest.mark.parametrize("geometry", [PLAIN, MIDDLE])
def test_an_empty_map_stops_nothing_but_is_unknown(geometry: Geometry) -> None:
    snapshot = snapshot_of(EvidenceMap(geometry))
    ray = [[0, 0, 0]], [[1, 2, 3]]
    assert snapshot.cast_rays(*ray, max_range_m=math.inf).states.tolist() == [State.FREE]
    ends = snapshot.cast_rays(*ray, max_range_m=math.inf, ends_in_unknown=True)
    assert (ends.states.tolist(), ends.distance_m.tolist()) == ([State.UNKNOWN], [0])
    assert len(snapshot.cast_rays(np.empty((0, 3)), np.empty((0, 3)), max_range_m=1).states) == 0


@pytest.mark.parametrize(
    ("origin", "direction", "max_range_m", "kind"),
    [
        ([0, 0, math.nan], [1, 0, 0], 1, "point_range"),
        ([0, 0, math.inf], [1, 0, 0], 1, "point_range"),
        ([0, 0, 0], [0, 0, 0], 1, "bad_points"),
        ([0, 0, 0], [1, math.nan, 0], 1, "bad_points"),
        ([0, 0, 0], [1, math.inf, 0], 1, "bad_points"),
        ([0, 0, 0], [1, 0, 0], math.nan, "bad_range"),
        ([0, 0, 0], [1, 0, 0], -1, "bad_range"),
    ],
)
def test_rays_that_are_none_are_refused(
    origin: list[float], direction: list[float], max_range_m: float, kind: str
) -> None:
    with pytest.raises(BadInputError) as refused:
        snapshot_with(PLAIN, WALL).cast_rays([origin], [direction], max_range_m=max_range_m)
    assert refused.value.kind == kind


@pytest.mark.parametrize("ends_in_unknown", [False, True])
@pytest.mark.parametrize("origin", [[math.nan, 0, 0], [math.nan] * 3, [math.inf, 0, 0]])
def test_no_walk_begins_at_an_origin_that_is_none(origin: list[float], ends_in_unknown: bool) -> None:
    snapshot = snapshot_with(PLAIN, WALL)
    origins, directions = [[0, 0, 0], origin, [0, 0, 0]], [[1, 1, 1]] * 3
    with pytest.raises(BadInputError) as refused:
        result_within(
            20.0,
            lambda: snapshot.cast_rays(origins, directions, max_range_m=math.inf, ends_in_unknown=ends_in_unknown),
        )
    assert refused.value.kind == "point_range"


@pytest.mark.parametrize("part", [5e-324, 1e-310, 1e-300, -1e-310])
def test_a_ray_that_nearly_lies_in_a_plane_ends_as_one_that_does(part: float) -> None:
    snapshot = snapshot_with(PLAIN, WALL)
    for direction in ([1, part, 0], [part, 1, 0], [part, part, 1]):
        flat = [round(number) for number in direction]
        ends = result_within(20.0, partial(snapshot.cast_rays, [[0, 0, 0]], [direction], max_range_m=10))
        assert ends.distance_m.tolist() == snapshot.cast_rays([[0, 0, 0]], [flat], max_range_m=10).distance_m.tolist()


def test_one_origin_or_one_direction_is_that_of_all_rays_and_other_numbers_must_agree() -> None:
    snapshot, directions = snapshot_with(PLAIN, WALL), [[1.0, 0, 0], [0, 1, 0], [1, 1, 0]]
    many = snapshot.cast_rays([[0.01, 0.01, 0.01]] * 3, directions, max_range_m=1)
    for origin in ([0.01, 0.01, 0.01], [[0.01, 0.01, 0.01]]):
        one = snapshot.cast_rays(origin, directions, max_range_m=1)
        assert one.distance_m.tolist() == many.distance_m.tolist()
    assert len(snapshot.cast_rays([[0, 0, 0]] * 4, [1, 0, 0], max_range_m=1).states) == 4
    assert len(snapshot.cast_rays(np.empty((0, 3)), np.empty((0, 3)), max_range_m=1).states) == 0
    assert repr(many).startswith("RayEnds(3 rays, ")
    for origins, ways in ((2, 3), (0, 1), (1, 0), (3, 2)):
        with pytest.raises(BadInputError, match="as many directions as origins, or one of either"):
            snapshot.cast_rays(np.zeros((origins, 3)), np.ones((ways, 3)), max_range_m=1)
