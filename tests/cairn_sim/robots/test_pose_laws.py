"""Laws of estimated poses: what they keep of the true ones at any error; and the corners of a drive."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cairn_calib.rig.poses import Transform, check_transform, inverse
from cairn_map.arrays import Floats
from cairn_sim.robots.trajectories import CORNER_M, PATHS, PoseErrors, believed, on_ground
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.solids import Plane, Solid, placed
from cairn_sim.scene.surfaces import Material, Surface

GROUND = scene_of([Solid("ground", Plane(), Surface(Material()), placed((0, 0, 0)))])


def winding_way(rng: np.random.Generator, *, count: int = 40) -> list[Transform]:
    """Poses one after the other, far from the map's origin, each turned and tilted as it likes."""
    places = np.array([80.0, -60.0, 5.0]) + np.cumsum(rng.uniform(-1, 1, (count, 3)), axis=0)
    return [placed(tuple(p), tuple(rng.uniform(-1, 1, 3))) for p in places]


def steps_m(way: list[Transform]) -> Floats:
    """(N - 1, 3) each place as seen from the pose before."""
    return np.array([(inverse(a) @ b)[:3, 3] for a, b in pairwise(way)])


@pytest.mark.parametrize("seed", range(4))
def test_heading_drift_keeps_every_step_in_the_robots_own_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = winding_way(rng)
    own = believed(true, PoseErrors(drift_rad=0.2), rng)
    np.testing.assert_allclose(steps_m(own), steps_m(true), rtol=0, atol=1e-9)
    ends = np.linalg.norm([b[:3, 3] - a[:3, 3] for a, b in zip(true, own, strict=True)], axis=1)
    assert ends[0] == 0 and ends.max() > 0.3


@pytest.mark.parametrize("seed", range(4))
def test_heading_drift_is_about_the_maps_vertical(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = winding_way(rng)
    own = believed(true, PoseErrors(drift_rad=0.2), rng)
    # Height, and where up is in the robot's own axes.
    np.testing.assert_allclose([T[2] for T in own], [T[2] for T in true], rtol=0, atol=1e-9)
    turned = [check_transform(b)[:3, :3] @ a[:3, :3].T for a, b in zip(true, own, strict=True)]
    turns_rad = np.unwrap([math.atan2(R[1, 0], R[0, 0]) for R in turned])
    assert np.ptp(turns_rad) > 0.2


def test_a_step_is_wrong_by_its_own_error_alone_however_far_the_way() -> None:
    errors, late, early = PoseErrors(drift=0.01, drift_rad=0.3), [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        true = winding_way(rng)
        wrong = steps_m(believed(true, errors, rng)) - steps_m(true)
        # Of the random walk a step of a metre adds its share, in any direction.
        share = wrong / np.sqrt(np.linalg.norm(steps_m(true), axis=1))[:, None]
        early.append(share[:10])
        late.append(share[-10:])
    for shares in (np.array(early), np.array(late)):
        assert shares.reshape(-1, 3).std(axis=0) == pytest.approx([errors.drift] * 3, rel=0.1)
        assert np.abs(shares.mean(axis=(0, 1))).max() < 4 * errors.drift / math.sqrt(1500)


def headings_rad(waypoints: tuple[tuple[float, float], ...], at_m: Floats) -> Floats:
    """Headings of a robot at some lengths along a line on level ground."""
    route = replace(PATHS["yard"]["loop"], waypoints=waypoints)
    poses = [on_ground(GROUND, route, float(at)) for at in at_m]
    return np.array([math.atan2(T[1, 0], T[0, 0]) for T in poses])


@pytest.mark.parametrize("turn_deg", [-120, -90, -30, 0, 20, 90, 150])
def test_at_a_corner_a_robot_looks_along_the_bisector_and_turns_alike_before_and_after(turn_deg: float) -> None:
    turn_rad, leg_m = math.radians(turn_deg), 4.0
    corner = (leg_m, 1.0)
    line = ((0.0, 1.0), corner, (corner[0] + leg_m * math.cos(turn_rad), corner[1] + leg_m * math.sin(turn_rad)))
    aside_m = np.linspace(0, 2 * CORNER_M, 13)
    before, after = headings_rad(line, leg_m - aside_m), headings_rad(line, leg_m + aside_m)
    assert before[0] == pytest.approx(turn_rad / 2, abs=1e-9)
    np.testing.assert_allclose(before + after, turn_rad, rtol=0, atol=1e-9)
    # Beyond the corner it looks along the line.
    np.testing.assert_allclose(before[aside_m >= CORNER_M], 0, atol=1e-9)
    assert (np.diff(after) * np.sign(turn_deg) >= -1e-9).all()
