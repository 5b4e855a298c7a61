"""Bodies between the poses of a path: nothing that is not met is reported, and nothing deep is missed."""

import itertools
import math

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import PLAIN
from tests.fixtures.map.worlds import ROOM, poses, random_map, random_points, random_rotations, snapshot_with

from cairn_map.errors import BadInputError
from cairn_map.evidence.grid import Geometry
from cairn_map.queries import body_queries
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.queries.occupancy_states import State

EDGE_M = 0.05
DEEPER = Geometry(voxel_edge_um=50_000, depth=4, channels=())
Floats = npt.NDArray[np.float64]
BOX = np.array([[-0.05, -0.03, -0.04], [0.06, 0.03, 0.02]])
WEIGHT = {State.FREE: 0, State.UNKNOWN: 1, State.OCCUPIED: 2}


def turned(R: Floats, R_to: Floats, fraction: float) -> Floats:
    """A rotation on its way to another, the slow way: by the eigenvector of the turn between them."""
    between = R.T @ R_to
    values, vectors = np.linalg.eig(between)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    across = np.linalg.svd(axis[None])[2][1]
    angle = math.atan2(float(np.cross(across, between @ across) @ axis), float(across @ between @ across))
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    by = angle * fraction
    return np.asarray(R @ (np.eye(3) + math.sin(by) * K + (1 - math.cos(by)) * K @ K))


def finely(R: Floats, t: Floats, per_segment: int) -> tuple[Floats, Floats]:
    """Many poses on each segment: rotations and positions, (N - 1, per_segment + 1, ...)."""
    fractions = [n / per_segment for n in range(per_segment + 1)]
    rotations = [[turned(a, b, f) for f in fractions] for a, b in itertools.pairwise(R)]
    positions = [[a + (b - a) * f for f in fractions] for a, b in itertools.pairwise(t)]
    return np.array(rotations), np.array(positions)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_box_meets_what_it_meets_on_the_way_and_nothing_else(seed: int) -> None:
    whole = random_map(seed, DEEPER)
    snapshot, rng = snapshot_of(whole), np.random.default_rng(seed)
    t = random_points(seed, whole, 14)[1:]
    t = t[0] + (t - t[0]) * 0.2
    R = random_rotations(rng, len(t))
    R[3] = R[2]
    R[5] = R[4] @ np.diag([1.0, -1.0, -1.0])  # half a turn
    swept = snapshot.sweep_box(poses(R, t), BOX).states
    rotations, positions = finely(R, t, 60)
    larger = np.array([[-1.0] * 3, [1.0] * 3])
    thin, thick = BOX - larger * EDGE_M / 4, BOX + larger * 1e-6
    for n in range(1, len(t)):
        if n == 5:
            continue  # half a turn may go either way
        way = poses(rotations[n - 1], positions[n - 1])
        deep, any_at_all = (
            max(WEIGHT[State(s)] for s in snapshot.check_box(way, box).states.tolist()) for box in (thin, thick)
        )
        assert deep <= WEIGHT[State(int(swept[n]))]
        if any_at_all == 0:
            assert swept[n] == State.FREE
    assert swept[0] == snapshot.check_box(poses(R, t), BOX).states[0]
    assert len(set(swept.tolist())) >= 2


def test_a_thin_bar_between_two_poses_is_met() -> None:
    snapshot = snapshot_with(DEEPER, ROOM)  # a bar across at x = 1 m
    box = [[-0.1, -0.1, 0.1], [0.1, 0.1, 0.3]]
    there = np.array([[0.5, 0, 0], [1.15 + 0.12, 0, 0]])
    path = poses(np.tile(np.eye(3), (2, 1, 1)), there)
    assert snapshot.check_box(path, box).first_occupied is None
    assert snapshot.sweep_box(path, box).first_occupied == 1
    assert snapshot.sweep_box(path[:1], box).states.tolist() == [State.FREE]
    centres = there + np.array([0, 0, 0.22])
    assert snapshot.check_sphere(centres, radius_m=0.04).first_occupied is None
    assert snapshot.sweep_sphere(centres, radius_m=0.04).first_occupied == 1
    assert snapshot.sweep_sphere(centres - [0, 0, 0.12], radius_m=0.04).first_occupied is None
    assert snapshot.sweep_sphere(centres[::-1], radius_m=0.04).states.tolist() == [State.UNKNOWN, State.OCCUPIED]


def test_a_body_that_slides_along_what_it_touches_meets_nothing() -> None:
    world = dict.fromkeys(itertools.product(range(-8, 24), range(-8, 8), range(8)), (0, 1)) | {
        (x, y, 0): (5, 0) for x in range(-8, 24) for y in range(-8, 8)
    }
    snapshot = snapshot_with(DEEPER, world)
    path = poses(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0.05], [0.9, 0, 0.05]]))
    assert snapshot.sweep_box(path, [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]]).states.tolist() == [State.FREE] * 2


def test_a_turning_box_meets_what_its_corners_pass() -> None:
    snapshot = snapshot_with(DEEPER, ROOM)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    path = poses(np.stack([np.eye(3), quarter]), np.tile([0.8, 0, 0], (2, 1)))
    box = [[-0.19, -0.19, 0.1], [0.19, 0.19, 0.3]]  # 0.27 m to its corners, and the bar is 0.2 m away
    assert snapshot.check_box(path, box).first_occupied is None
    assert snapshot.sweep_box(path, box).first_occupied == 1


def test_turns_go_the_shortest_way() -> None:
    rng = np.random.default_rng(4)
    R, to = random_rotations(rng, 40), random_rotations(rng, 40)
    to[:5] = R[:5]
    to[5] = R[5] @ np.diag([-1.0, -1.0, 1.0])
    turns = body_queries._turns(R, to)
    assert np.allclose(R @ body_queries._rotations(turns), to, atol=1e-9)
    assert np.linalg.norm(turns, axis=1).max() <= math.pi + 1e-9
    assert np.abs(turns[:5]).max() < 1e-9
    assert np.linalg.norm(turns[5]) == pytest.approx(math.pi)
    nearly = body_queries._turns(np.eye(3)[None], body_queries._rotations(np.array([[0, math.pi - 1e-5, 0]])))
    assert nearly[0].tolist() == pytest.approx([0, math.pi - 1e-5, 0], abs=1e-9)


def test_paths_that_are_none_or_too_long_are_refused() -> None:
    snapshot = snapshot_with(PLAIN, ROOM)
    far = poses(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [90_000, 0, 0]]))
    for refused, kind in (
        (lambda: snapshot.sweep_box(far, [[0, 0, 0], [1, 1, 1]]), "too_large"),
        (lambda: snapshot.sweep_sphere(far[:, :3, 3], radius_m=1), "too_large"),
        (lambda: snapshot.sweep_sphere([[0, 0, math.nan]], radius_m=1), "point_range"),
        (lambda: snapshot.sweep_box(np.zeros((2, 4, 4)), [[0, 0, 0], [1, 1, 1]]), "bad_points"),
    ):
        with pytest.raises(BadInputError) as error:
            refused()
        assert error.value.kind == kind
    assert len(snapshot.sweep_sphere(np.empty((0, 3)), radius_m=1).states) == 0
