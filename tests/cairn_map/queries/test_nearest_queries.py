"""The nearest voxels against the twins, and at the radius itself."""

import math

import numpy as np
import pytest
from tests.fixtures.map.made import PLAIN
from tests.fixtures.map.worlds import random_map, random_points, snapshot_with, world_of
from tests.naive import queries as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.distance_queries import NO_VOXEL
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.queries.occupancy_states import State

EDGE_M = 0.05
DEEPER = Geometry(voxel_edge_um=50_000, depth=4, channels=())


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [PLAIN, DEEPER])
@pytest.mark.parametrize("state", [State.OCCUPIED, State.UNKNOWN])
@pytest.mark.parametrize("radius_m", [0.0, 0.07, 0.3])
def test_nearest_voxels_are_as_far_as_the_twin_says(geometry: Geometry, state: State, radius_m: float) -> None:
    whole = random_map(1, geometry)
    world, snapshot = world_of(whole), snapshot_of(whole)
    points = random_points(1, whole, 60)
    ask = snapshot.nearest_occupied if state is State.OCCUPIED else snapshot.nearest_unknown
    found = ask(points, radius_m=radius_m)
    positions = [naive.position(point, 50_000_000) for point in points]
    expected = [naive.nearest(world, position, state, radius_m / EDGE_M) for position in positions]
    np.testing.assert_allclose(found.distance_m / EDGE_M, expected, atol=1e-6)
    assert found.found.any() or radius_m == 0
    for position, voxel, distance_m in zip(positions, found.voxels.tolist(), found.distance_m, strict=True):
        if np.isfinite(distance_m):
            assert naive.state(world, tuple(voxel)) == state
            assert naive.gap(position, tuple(voxel)) == pytest.approx(distance_m / EDGE_M, abs=1e-6)
        else:
            assert voxel == [NO_VOXEL] * 3
    assert np.isnan(found.points_m[~found.found]).all()
    there = found.points_m[found.found]
    np.testing.assert_allclose(
        np.linalg.norm(there - points[found.found], axis=1), found.distance_m[found.found], atol=1e-9
    )
    low_m = found.voxels[found.found] * EDGE_M
    assert ((there >= low_m) & (there <= low_m + EDGE_M)).all()


def test_what_lies_at_the_radius_is_found_and_beyond_is_not() -> None:
    snapshot = snapshot_with(PLAIN, {(20, 0, 0): (1, 0), (0, 0, -90): (1, 0)})
    at = [[0.0, 0.01, 0.01]]
    found = snapshot.nearest_occupied(at, radius_m=1)
    assert (found.distance_m.tolist(), found.voxels.tolist()) == ([1], [[20, 0, 0]])
    assert not snapshot.nearest_occupied(at, radius_m=0.999).found.any()
    assert snapshot.nearest_occupied([[0, 0, 1e5]], radius_m=1e6).distance_m[0] == pytest.approx(1e5 - 0.05)


def test_cells_far_apart_make_no_search_long() -> None:
    """Their box has 10^18 bricks; the nearest voxel is 2 km away, in no direction that a shell meets soon."""
    far = 999_999
    snapshot = snapshot_with(
        PLAIN,
        {(far, far, far): (1, 0), (-far, -far, -far): (1, 0), (40_000, -5, 3): (1, 0), (-40_001, 5, 8): (1, 0)},
    )
    found = snapshot.nearest_occupied([[0, 0, 0], [0.04, 0, 0], [-1500, 0, 0], [9, 9, 9]], radius_m=2500)
    assert found.voxels.tolist() == [[40_000, -5, 3], [40_000, -5, 3], [-40_001, 5, 8], [40_000, -5, 3]]
    away = [np.hypot.reduce(gap) * EDGE_M for gap in ((40_000, 4, 3), (40_000 - 0.8, 4, 3), (10_000, 5, 8))]
    np.testing.assert_allclose(found.distance_m[:3], away)
    assert not snapshot.nearest_occupied([[0, 0, 0]], radius_m=1999).found.any()
    assert snapshot.nearest_unknown([[0, 0, 0]], radius_m=1e6).distance_m.tolist() == [0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_every_occupied_voxel_of_a_sparse_map_may_be_the_nearest(seed: int) -> None:
    """Brute force, at radii where shells suffice and where all cells are looked through."""
    rng = np.random.default_rng(seed)
    voxels = rng.integers(-3000, 3000, (60, 3))
    snapshot = snapshot_with(DEEPER, {tuple(voxel): (1, 0) for voxel in voxels.tolist()})
    points = rng.uniform(-160, 160, (50, 3))
    gaps = np.maximum(0, np.maximum(voxels - points[:, None] / EDGE_M, points[:, None] / EDGE_M - voxels - 1))
    expected = np.sqrt((gaps**2).sum(-1)).min(1) * EDGE_M
    for radius_m in (1.0, 30.0, 1000.0):
        found = snapshot.nearest_occupied(points, radius_m=radius_m)
        np.testing.assert_allclose(found.distance_m, np.where(expected <= radius_m, expected, np.inf), rtol=1e-6)


def test_in_an_empty_map_all_is_unknown_and_nothing_occupied() -> None:
    snapshot = snapshot_of(EvidenceMap(DEEPER))
    assert snapshot.nearest_unknown([[0.3, 0, 0], [-1e5, 0, 0]], radius_m=0).distance_m.tolist() == [0, 0]
    assert not snapshot.nearest_occupied([[0.3, 0, 0]], radius_m=1e6).found.any()
    assert len(snapshot.nearest_occupied(np.empty((0, 3)), radius_m=1).voxels) == 0


def test_around_a_known_cell_the_unknown_begins_at_its_faces() -> None:
    snapshot = snapshot_with(PLAIN, {(x, y, z): (0, 1) for x in range(8) for y in range(8) for z in range(8)})
    found = snapshot.nearest_unknown([[0.2, 0.2, 0.39], [0.2, 0.01, 0.2], [-0.1, 0.2, 0.2]], radius_m=1)
    np.testing.assert_allclose(found.distance_m, [0.01, 0.01, 0], atol=1e-12)
    assert found.voxels.tolist() == [[4, 4, 8], [4, -1, 4], [-2, 4, 4]]


@pytest.mark.parametrize(
    ("point", "radius_m", "kind"),
    [
        ([0, 0, math.nan], 1, "point_range"),
        ([0, math.inf, 0], 1, "point_range"),
        ([0, 0, 0], math.inf, "bad_range"),
        ([0, 0, 0], math.nan, "bad_range"),
        ([0, 0, 0], -1, "bad_range"),
    ],
)
def test_what_cannot_be_asked_is_refused(point: list[float], radius_m: float, kind: str) -> None:
    with pytest.raises(BadInputError) as refused:
        snapshot_of(random_map(1, PLAIN)).nearest_unknown([[0, 0, 0], point], radius_m=radius_m)
    assert refused.value.kind == kind
