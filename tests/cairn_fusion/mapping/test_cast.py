"""Rays through voxels against the slow statement of which cubes a segment meets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.naive import rays as naive_rays

from cairn_fusion.mapping.cast_kernels import HIT, MISS
from cairn_fusion.mapping.ray_casting import SeenBricks, beam_evidence, seen_bricks, unique_voxels
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Geometry, voxels_in_cell, voxels_of_points

law = settings(max_examples=50, deadline=None, database=None)  # the first call of a kernel compiles it
GEOMETRY = Geometry(voxel_edge_um=100_000, depth=3, channels=())
EDGE_M = 0.1
CLOSE = 1e-6
"""In voxels: where a segment passes an edge or a corner as closely as this, either side is right."""

Voxel = tuple[int, ...]
# Multiples of 1/4 voxel and of a whole one hit borders, edges and corners; the others hit none.
coordinates = st.one_of(
    st.integers(-80, 80).map(lambda n: n / 4), st.integers(-12, 12).map(float), st.floats(-15, 15, width=32)
)
points = st.tuples(coordinates, coordinates, coordinates)


def cast(origin: Voxel, targets: list[tuple[float, ...]]) -> tuple[SeenBricks, np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Rays to targets in voxels; and which targets were taken, one for each end voxel."""
    ends_m = np.array(targets, dtype=np.float64).reshape(-1, 3) * EDGE_M
    voxels, first = np.unique(voxels_of_points(ends_m, GEOMETRY), axis=0, return_index=True)
    first = np.sort(first)
    every = voxels_of_points(ends_m, GEOMETRY)
    return seen_bricks(np.array(origin) * EDGE_M, every, ends_m, GEOMETRY), ends_m[first], voxels


def as_sets(seen: SeenBricks) -> tuple[set[Voxel], set[Voxel]]:
    """Hits and misses as voxel numbers; no voxel may be there twice."""
    hits: set[Voxel] = set()
    misses: set[Voxel] = set()
    for cell, place, hit in marked(seen):
        (voxel,) = voxels_in_cell(np.array([place]), cell, GEOMETRY)
        (hits if hit else misses).add(tuple(voxel.tolist()))
    assert len(hits) + len(misses) == len(marked(seen))
    return hits, misses


def marked(seen: SeenBricks) -> list[tuple[int, int, bool]]:
    """Cell and place of each voxel that was passed or hit, and which it was, brick by brick."""
    found = []
    for cell, number, slot in zip(seen.cells, seen.numbers, seen.slots, strict=True):
        for inner, mark in enumerate(seen.marks[slot].tolist()):
            if mark & (HIT | MISS):
                found.append((int(cell), int(number) * 512 + inner, bool(mark & HIT)))
    return found


def check_against_twin(origin: tuple[float, ...], targets: list[tuple[float, ...]]) -> None:
    seen, ends_m, voxels = cast(origin, targets)
    hits, misses = as_sets(seen)
    start = tuple(float(v) for v in origin)
    rays = [tuple((end / EDGE_M).tolist()) for end in ends_m]
    assert hits == {tuple(voxel) for voxel in voxels.tolist()}
    surely = {voxel for ray in rays for voxel in naive_rays.voxels_passed(start, ray, grown=-CLOSE)} - hits
    perhaps = {voxel for ray in rays for voxel in naive_rays.voxels_passed(start, ray, grown=CLOSE)} - hits
    assert surely <= misses <= perhaps


@pytest.mark.slow
@law
@given(points, st.lists(points, max_size=5))
def test_rays_mark_what_they_meet(origin: tuple[float, ...], targets: list[tuple[float, ...]]) -> None:
    check_against_twin(origin, targets)


@law
@given(points, st.integers(0, 2), st.floats(-12, 12))
def test_rays_along_an_axis_mark_what_they_meet(origin: tuple[float, ...], axis: int, to: float) -> None:
    target = list(origin)
    target[axis] = to
    check_against_twin(origin, [tuple(target)])


@law
@given(st.tuples(*[st.integers(-9, 9)] * 3), st.tuples(*[st.integers(-9, 9)] * 3))
def test_rays_from_corner_to_corner_mark_what_they_meet(origin: Voxel, target: Voxel) -> None:
    check_against_twin(tuple(map(float, origin)), [tuple(map(float, target))])


@law
@given(points, points)
def test_one_ray_is_a_path_of_neighbours(origin: tuple[float, ...], target: tuple[float, ...]) -> None:
    seen, _, (end,) = cast(origin, [target])
    hits, misses = as_sets(seen)
    (start,) = voxels_of_points(np.array([origin]) * EDGE_M, GEOMETRY)
    path = np.array(sorted(hits | misses, key=lambda voxel: np.abs(np.array(voxel) - start).sum()))
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()
    assert path[0].tolist() == start.tolist()
    assert path[-1].tolist() == end.tolist()
    assert len(path) == np.abs(end - start).sum() + 1


@law
@given(points, st.lists(points, min_size=1, max_size=5), st.randoms(use_true_random=False))
def test_the_order_of_rays_changes_nothing(origin: tuple[float, ...], targets: list, random: object) -> None:  # type: ignore[type-arg]
    _, ends_m, voxels = cast(origin, targets)
    order = list(range(len(voxels)))
    random.shuffle(order)  # type: ignore[attr-defined]
    origin_m = np.array(origin) * EDGE_M
    one, other = (
        seen_bricks(origin_m, voxels, ends_m, GEOMETRY),
        seen_bricks(origin_m, voxels[order], ends_m[order], GEOMETRY),
    )
    assert marked(one) == marked(other)


def test_a_hit_is_never_overruled_by_a_ray_that_passes_it() -> None:
    seen, _, _ = cast((0.5, 0.5, 0.5), [(5.5, 0.5, 0.5), (9.5, 0.5, 0.5)])
    hits, misses = as_sets(seen)
    assert hits == {(5, 0, 0), (9, 0, 0)}
    assert misses == {(x, 0, 0) for x in (0, 1, 2, 3, 4, 6, 7, 8)}


def test_an_end_in_the_origins_voxel_is_a_hit_and_no_miss() -> None:
    hits, misses = as_sets(cast((-0.5, 0.5, 0.5), [(-0.25, 0.5, 0.5)])[0])
    assert (hits, misses) == ({(-1, 0, 0)}, set())


def test_a_ray_of_no_length_is_a_hit_where_it_is() -> None:
    hits, misses = as_sets(cast((3.0, -4.0, 0.0), [(3.0, -4.0, 0.0)])[0])
    assert (hits, misses) == ({(3, -4, 0)}, set())


def test_no_rays_see_nothing() -> None:
    assert marked(cast((0.5, 0.5, 0.5), [])[0]) == []


def test_cells_and_places_rise() -> None:
    rng = np.random.default_rng(1)
    seen, _, _ = cast((0.1, 0.2, 0.3), [tuple(p) for p in rng.uniform(-40, 40, (200, 3))])
    keys = [(cell, place) for cell, place, _ in marked(seen)]
    assert keys == sorted(set(keys))


@pytest.mark.parametrize("with_samples", [False, True])
def test_evidence_is_that_of_the_marks_packed_voxel_by_voxel(with_samples: bool) -> None:
    rng = np.random.default_rng(3)
    geometry = Geometry(voxel_edge_um=100_000, depth=4)
    points_m = rng.uniform(-3, 3, (300, 3)).round(1)
    clear_m = 0.9 * points_m
    sums = rng.integers(0, 2, (300, geometry.plane_count)) * rng.integers(1, 9, (300, geometry.plane_count))
    found = beam_evidence(
        np.array([0.1, 0.2, 0.3]),
        points_m,
        clear_m,
        geometry,
        sums_of=(lambda _, count: sums[:count]) if with_samples else None,
    )
    voxels, voxel_of = unique_voxels(voxels_of_points(points_m, geometry))
    assert (voxels[voxel_of] == voxels_of_points(points_m, geometry)).all()
    sums_at = dict(zip(map(tuple, voxels.tolist()), sums, strict=False))
    seen = seen_bricks(np.array([0.1, 0.2, 0.3]), voxels_of_points(points_m, geometry), clear_m, geometry)
    expected: dict[int, list[tuple[int, bool, np.ndarray]]] = {}  # type: ignore[type-arg]
    for cell, place, hit in marked(seen):
        (voxel,) = voxels_in_cell(np.array([place]), cell, geometry)
        row = sums_at[tuple(voxel.tolist())] if hit and with_samples else np.zeros(geometry.plane_count, np.int64)
        expected.setdefault(cell, []).append((place, hit, row))
    assert found.keys() == expected.keys()
    for key, rows in expected.items():
        places, hits, samples = zip(*rows, strict=True)
        counts = np.array([[hit, not hit] for hit in hits], np.int32)
        assert found[key] == packed_evidence(np.array(places, np.uint32), counts, np.array(samples), geometry)  # type: ignore[index]


def test_many_long_rays_make_the_pool_grow_and_agree_with_the_twin() -> None:
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(60, 3))
    targets = 45 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    hits, misses = as_sets(cast((0.5, 0.5, 0.5), [tuple(t) for t in targets])[0])
    assert len(hits) == len(targets)
    for voxel in list(misses)[:: len(misses) // 100]:
        assert any(naive_rays.passes((0.5, 0.5, 0.5), tuple(t), voxel, grown=CLOSE) for t in targets.tolist())


def test_a_scan_that_would_not_fit_in_memory_is_refused() -> None:
    fine = Geometry(voxel_edge_um=1000, depth=3, channels=())
    ends_m = np.array([[9.0, 9.0, 9.0]])
    with pytest.raises(BadInputError):
        seen_bricks(np.zeros(3), voxels_of_points(ends_m, fine), ends_m, fine)
