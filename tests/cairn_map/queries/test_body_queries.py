"""Bodies against the twins: what they meet, what they only touch, and where on a path it begins."""

import itertools
import math

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import PLAIN
from tests.fixtures.map.worlds import ROOM, poses, random_map, random_points, random_rotations, snapshot_with, world_of
from tests.naive import queries as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.queries.occupancy_states import State

EDGE_M = 0.05
DEEPER = Geometry(voxel_edge_um=50_000, depth=4, channels=())


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [PLAIN, DEEPER])
@pytest.mark.parametrize("seed", [1, 2])
def test_boxes_meet_what_the_twin_says(geometry: Geometry, seed: int) -> None:
    whole = random_map(seed, geometry)
    world, rng = world_of(whole), np.random.default_rng(seed)
    points = random_points(seed, whole, 120)[1:]
    R = random_rotations(rng, len(points))
    box = np.array([[-0.05, -0.03, -0.04], [0.06, 0.03, 0.02]]) if seed == 1 else np.array([[0.01] * 3, [0.03] * 3])
    corners = np.array(list(itertools.product(*box.T.tolist())))
    expected = [
        naive.box_state(world, [tuple(c) for c in ((corners @ r.T + p) / EDGE_M).tolist()], [tuple(a) for a in r.T])
        for r, p in zip(R, points, strict=True)
    ]
    states = snapshot_of(whole).check_box(poses(R, points), box).states
    assert states.tolist() == expected
    assert len(set(expected)) >= 2


@pytest.mark.parametrize("geometry", [PLAIN, DEEPER])
@pytest.mark.parametrize("radius_m", [0.004, 0.06, 0.13])
def test_spheres_meet_what_the_twin_says(geometry: Geometry, radius_m: float) -> None:
    whole = random_map(3, geometry)
    world = world_of(whole)
    points = random_points(3, whole, 100)
    points = points[np.arange(100) % 3 > 0]  # on a border a sphere may touch
    expected = [naive.sphere_state(world, tuple(p), radius_m / EDGE_M) for p in (points / EDGE_M).tolist()]
    assert snapshot_of(whole).check_sphere(points, radius_m=radius_m).states.tolist() == expected


def test_a_path_tells_its_first_collision() -> None:
    snapshot = snapshot_with(DEEPER, ROOM)
    path = poses(np.tile(np.eye(3), (30, 1, 1)), np.array([[0.05 * n, 0, 0.0] for n in range(30)]))
    robot = [[-0.2, -0.1, 0.1], [0.2, 0.1, 0.3]]
    found = snapshot.check_box(path, robot)
    # Its front is 0.2 m ahead; at n = 16 it stands at the bar, and touching is not meeting.
    assert (found.first_occupied, found.first_not_free) == (17, 17)
    assert found.first_occupied_m is not None and found.first_not_free_m is not None
    assert found.first_occupied_m.tolist() == found.first_not_free_m.tolist() == pytest.approx([0.85, 0.0, 0.2])
    assert found.states[:17].tolist() == [State.FREE] * 17
    free = snapshot.check_box(path, [[-0.2, -0.1, 0.25], [0.2, 0.1, 0.3]])
    assert free.first_occupied is free.first_occupied_m is None
    tall = snapshot.check_box(path, [[-0.2, -0.1, 0.25], [0.2, 0.1, 0.41]])
    assert (tall.first_occupied, tall.first_not_free) == (None, 0)
    assert tall.states.tolist() == [State.UNKNOWN] * 30


def test_what_only_touches_does_not_collide() -> None:
    snapshot = snapshot_with(
        PLAIN, dict.fromkeys(itertools.product(range(-8, 8), repeat=3), (0, 1)) | {(2, 0, 0): (1, 0)}
    )
    below, above = 0.05 - 1e-9, 0.05 + 1e-6
    at = [[0.05, 0.025, 0.025]]
    assert snapshot.check_sphere(at, radius_m=below).states.tolist() == [State.FREE]
    assert snapshot.check_sphere(at, radius_m=0.05).states.tolist() == [State.FREE]
    assert snapshot.check_sphere(at, radius_m=above).states.tolist() == [State.OCCUPIED]
    for n in range(1, 20):  # its face in the voxel's, as near as floats come
        box = [[-0.01 * n, -0.01, -0.01], [0.01 * n, 0.01, 0.01]]
        beside = poses(np.eye(3)[None], np.array([[0.1 - 0.01 * n, 0.025, 0.025]]))
        assert snapshot.check_box(beside, box).states.tolist() == [State.FREE]
    turned = np.array([[[math.sqrt(0.5), -math.sqrt(0.5), 0], [math.sqrt(0.5), math.sqrt(0.5), 0], [0, 0, 1]]])
    half = 0.05 / math.sqrt(2)  # its edge points at the voxel
    for grown, state in ((-1e-9, State.FREE), (1e-6, State.OCCUPIED)):
        box = [[-half - grown, -half - grown, -0.01], [half + grown, half + grown, 0.01]]
        assert snapshot.check_box(poses(turned, np.array(at)), box).states.tolist() == [state]


def test_around_the_map_all_is_unknown() -> None:
    snapshot = snapshot_of(EvidenceMap(PLAIN))
    found = snapshot.check_sphere([[0, 0, 0], [1e5, 0, 0]], radius_m=1)
    assert found.states.tolist() == [State.UNKNOWN] * 2
    assert (found.first_occupied, found.first_not_free) == (None, 0)
    nowhere = snapshot.check_sphere(np.empty((0, 3)), radius_m=1)
    assert (len(nowhere.states), nowhere.first_occupied, nowhere.first_not_free) == (0, None, None)


@pytest.mark.parametrize(
    ("T", "box", "kind"),
    [
        (np.eye(4), [[0, 0, 0], [1, 1, 1]], "bad_points"),
        (np.diag([1.0, 1, 2, 1])[None], [[0, 0, 0], [1, 1, 1]], "bad_points"),
        (np.full((1, 4, 4), math.nan), [[0, 0, 0], [1, 1, 1]], "bad_points"),
        (poses(np.eye(3)[None], np.array([[math.nan, 0, 0]])), [[0, 0, 0], [1, 1, 1]], "point_range"),
        (np.eye(4)[None], [[0, 0, 0], [1, 0, 1]], "bad_box"),
        (np.eye(4)[None], [[0, 0, 0], [1, math.inf, 1]], "bad_box"),
        (np.eye(4)[None], [1, 1, 1], "bad_box"),
        (np.eye(4)[None], [[0, 0, 0], [1, 100, 1]], "too_large"),
    ],
)
def test_boxes_that_are_none_are_refused(T: npt.NDArray[np.float64], box: list[list[float]], kind: str) -> None:
    with pytest.raises(BadInputError) as refused:
        snapshot_with(PLAIN, ROOM).check_box(T, box)
    assert refused.value.kind == kind


@pytest.mark.parametrize(
    ("centre", "radius_m", "kind"),
    [
        ([0, 0, math.nan], 1, "point_range"),
        ([0, 0, 0], 0, "bad_range"),
        ([0, 0, 0], math.nan, "bad_range"),
        ([0, 0, 0], math.inf, "too_large"),
        ([0, 0], 1, "bad_points"),
    ],
)
def test_spheres_that_are_none_are_refused(centre: list[float], radius_m: float, kind: str) -> None:
    with pytest.raises(BadInputError) as refused:
        snapshot_with(PLAIN, ROOM).check_sphere([centre], radius_m=radius_m)
    assert refused.value.kind == kind
