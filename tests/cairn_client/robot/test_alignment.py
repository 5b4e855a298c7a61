"""A robot's own frame on the map: right to a voxel from half a metre and ten degrees off, refused where in doubt."""

import dataclasses
import math
import os
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.poses import Transform, check_transform, inverse, transform_points
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client.robot import alignment
from cairn_client.robot.alignment import align_points, one_a_voxel, points_of_scans, starts_around
from cairn_client.robot.alignment_verdict import Alignment, AlignmentVerdict
from cairn_client.robot.robot import Robot
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_fusion.mapping.measurement import Measurement
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_sim.render.render import render_scan
from cairn_sim.render.sensors import Noise
from cairn_sim.robots.heads import RANGE_CAMERA
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene_file import load_scene

Floats = npt.NDArray[np.float64]
DATA = os.environ.get("CAIRN_TEST_DATA")
TOF = Camera(width=4, height=3, focal_px=(4.0, 4.0), centre_px=(1.5, 1.0))
RIG = Rig(name="head", cameras={"tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4))})
EDGE_M = 0.05


def off_by(shift_m: tuple[float, float, float], yaw_deg: float) -> Transform:
    """A rotation about z, then a shift."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], shift_m
    return T


def motion_left(found: Alignment, T_true: Transform) -> Floats:
    """(6,) rotation and translation in the robot's frame, of small ones."""
    E = inverse(found.T_map_robot) @ T_true
    turn = [E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]
    return np.concatenate([np.array(turn) / 2, E[:3, 3]])


def assert_right(found: Alignment, T_true: Transform, *, edge_m: float) -> None:
    assert found.verdict is AlignmentVerdict.ACCEPTED, found.reason
    left = motion_left(found, T_true)
    assert np.linalg.norm(left[3:]) < edge_m
    assert np.linalg.norm(left[:3]) < math.radians(0.5)
    # As sure as it says, and not so unsure that it says nothing.
    assert left @ np.linalg.solve(found.covariance, left) < 22.5  # chi square, 6 degrees of freedom, 0.1 %
    assert np.sqrt(np.diag(found.covariance)[3:]).max() < 2 * edge_m


# In a simulated building


def looks_around(stop: int, seed: int) -> list[Scan]:
    """The scans of a stop in the building, their poses on the map."""
    scene, robot = load_scene("building"), ROBOTS["tof"]
    poses = robot.head_poses(stops(scene, "labs")[stop])[::3]
    rig, noise = robot.rig_of(1.0), Noise(seed=seed)
    return [
        render_scan(scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=float(n), noise=noise, number=n)
        for n, T in enumerate(poses)
    ]


def in_own_frame(scans: list[Scan], T_map_robot: Transform) -> list[Scan]:
    return [dataclasses.replace(scan, T_map_rig=inverse(T_map_robot) @ scan.T_map_rig) for scan in scans]


@pytest.fixture(scope="module")
def building() -> EvidenceMap:
    """Two stops of the laboratories at 5 cm."""
    geometry = geometry_for(voxel_edge_m=EDGE_M, channels=())
    whole, rig = EvidenceMap(geometry), ROBOTS["tof"].rig_of(1.0)
    for stop in (0, 4):
        whole.merge(integrate_scans(looks_around(stop, seed=stop), rig, geometry, integrator=Integrator()))
    return whole


@pytest.mark.slow
@pytest.mark.parametrize(("shift_m", "yaw_deg"), [((0.5, 0.0, 0.0), 10.0), ((-0.35, 0.35, 0.1), -10.0)])
def test_a_robot_in_the_building_finds_its_place_from_half_a_metre_and_ten_degrees_off(
    building: EvidenceMap, shift_m: tuple[float, float, float], yaw_deg: float, tmp_path: Path
) -> None:
    T_true = stops(load_scene("building"), "labs")[2] @ off_by((0.7, -0.2, 0.0), 30.0)  # its own frame lies somewhere
    scans = in_own_frame(looks_around(2, seed=9), T_true)
    guess = off_by(shift_m, 0.0) @ T_true @ off_by((0, 0, 0), yaw_deg)
    rig, nowhere = ROBOTS["tof"].rig_of(1.0), "http://127.0.0.1:9/maps/lab"
    with Robot(rig, nowhere, directory=tmp_path, name="mole", geometry=building.geometry) as robot:
        robot.replica.commit(building.packed())
        found = robot.align(scans, T_map_robot=guess)
        assert_right(found, T_true, edge_m=EDGE_M)
        assert found.fit > 0.9


@pytest.mark.slow
def test_scans_of_another_place_are_not_found_on_the_map(building: EvidenceMap, tmp_path: Path) -> None:
    scene, robot = load_scene("small-room"), ROBOTS["tof"]
    rig, T_true = robot.rig_of(1.0), stops(scene, "west")[0]
    scans = [
        render_scan(scene, rig, T_map_rig=T, range_camera=RANGE_CAMERA, time_s=0.0, noise=Noise(seed=1), number=n)
        for n, T in enumerate(robot.head_poses(T_true)[::3])
    ]
    here = snapshot_of(building)
    guess = stops(load_scene("building"), "labs")[2]
    found = align_points(here, points_of_scans(in_own_frame(scans, T_true), rig, Integrator()), T_map_robot=guess)
    assert found.verdict is not AlignmentVerdict.ACCEPTED, found.reason
    points = points_of_scans(scans, rig, Integrator())
    far = align_points(here, points, T_map_robot=off_by((500, 0, 0), 0))
    assert far.verdict is AlignmentVerdict.FAILED
    assert "0 occupied voxels" in far.reason
    assert np.isinf(np.diag(far.covariance)).all()
    nowhere = "http://127.0.0.1:9/maps/lab"
    with (
        Robot(None, nowhere, directory=tmp_path, name="mole", geometry=building.geometry) as blind,
        pytest.raises(BadInputError),
    ):
        blind.align(scans, T_map_robot=guess)


# In rooms and corridors of planes


def seen_in_a_box(low: list[float], high: list[float], origin: list[float], *, reach_m: float, seed: int) -> Floats:
    """Points of walls around an origin, in its frame, with a centimetre of noise."""
    rng = np.random.default_rng(seed)
    beams = rng.normal(size=(20_000, 3))
    beams /= np.linalg.norm(beams, axis=1)[:, None]
    o = np.array(origin)
    range_m = np.where(beams > 0, (np.array(high) - o) / beams, (np.array(low) - o) / beams).min(axis=1)
    points = beams * (range_m + rng.normal(0, 0.01, len(beams)))[:, None]
    return np.asarray(points[range_m < reach_m])


def map_of_a_box(low: list[float], high: list[float], origins: list[list[float]], *, reach_m: float) -> MapSnapshot:
    measurement = Measurement(RIG, Geometry(voxel_edge_um=50_000, channels=()), Integrator(max_range_m=30))
    for n, origin in enumerate(origins):
        points = seen_in_a_box(low, high, origin, reach_m=reach_m, seed=n)
        T = off_by((origin[0], origin[1], origin[2]), 0)
        measurement.add_points(points, T, T_map_rig=T, time_s=n)
    whole = EvidenceMap(measurement.geometry)
    whole.merge(measurement.diff())
    return snapshot_of(whole)


@pytest.mark.slow
def test_along_a_bare_corridor_an_alignment_is_refused() -> None:
    low, high = [-1e6, -1.0, 0.0], [1e6, 1.0, 2.5]
    whole = map_of_a_box(low, high, [[x, 0.1, 1.0] for x in range(8)], reach_m=8)
    points = seen_in_a_box(low, high, [3.3, 0.2, 1.1], reach_m=6, seed=5)
    T_true = off_by((3.3, 0.2, 1.1), 0)
    found = align_points(whole, points, T_map_robot=off_by((0.3, -0.2, 0), 5) @ T_true)
    assert found.verdict is AlignmentVerdict.AMBIGUOUS
    assert "nothing holds it along" in found.reason
    assert "1.00, " in found.reason.replace("-", "")
    left, sigma = motion_left(found, T_true), np.sqrt(np.diag(found.covariance))
    assert np.abs(left[4:]).max() < EDGE_M  # across the corridor it is right all the same,
    assert sigma[3] > 4 * sigma[4]  # and says what it does not know


@pytest.mark.slow
def test_a_corridor_with_an_end_in_sight_is_accepted() -> None:
    low, high = [-2.0, -1.0, 0.0], [6.0, 1.0, 2.5]
    whole = map_of_a_box(low, high, [[x, 0.1, 1.0] for x in range(6)], reach_m=8)
    T_true = off_by((3.3, 0.2, 1.1), 20)
    points = seen_in_a_box(low, high, [3.3, 0.2, 1.1], reach_m=6, seed=5) @ T_true[:3, :3]
    found = align_points(whole, points, T_map_robot=off_by((0.3, -0.2, 0), 0) @ T_true @ off_by((0, 0, 0), 8))
    assert_right(found, T_true, edge_m=EDGE_M)


@pytest.mark.slow
def test_a_room_that_looks_the_same_from_both_ends_is_refused_if_any_heading_may_be() -> None:
    low, high = [-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]
    whole = map_of_a_box(low, high, [[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)], reach_m=20)
    points = seen_in_a_box(low, high, [0.2, 0.1, 1.1], reach_m=20, seed=3)
    T_true = off_by((0.2, 0.1, 1.1), 0)
    assert_right(align_points(whole, points, T_map_robot=T_true), T_true, edge_m=EDGE_M)
    found = align_points(whole, points, T_map_robot=T_true, reach_m=0, reach_rad=math.pi)
    assert found.verdict is AlignmentVerdict.AMBIGUOUS
    assert "another place" in found.reason
    assert "180 degrees" in found.reason


# Real recordings


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.skipif(DATA is None, reason="CAIRN_TEST_DATA is not set")
@pytest.mark.parametrize(("shift_m", "yaw_deg"), [(0.5, 10.0), (-0.5, -10.0)])
def test_a_real_lidar_sweep_finds_its_place_on_the_map_of_another(shift_m: float, yaw_deg: float) -> None:
    """libpointmatcher's car_cloud401 on a map of car_cloud400, with its published pose, which is good to some 5 cm."""
    folder = Path(str(DATA)) / "lpm_lidar"
    first = np.loadtxt(folder / "car_cloud400.csv", delimiter=",", skiprows=1)[:, :3]
    second = np.loadtxt(folder / "car_cloud401.csv")
    line = (folder / "carCloudList.csv").read_text().splitlines()[2]
    T_true = check_transform(np.array([float(v) for v in line.split(",")[1:]]).reshape(4, 4))
    geometry = geometry_for(voxel_edge_m=0.1, channels=())
    measurement = Measurement(RIG, geometry, Integrator(max_range_m=50))
    measurement.add_points(first, np.eye(4), T_map_rig=np.eye(4), time_s=0)
    whole = EvidenceMap(geometry)
    whole.merge(measurement.diff())
    guess = off_by((shift_m, 0, 0), 0) @ T_true @ off_by((0, 0, 0), yaw_deg)
    assert_right(align_points(snapshot_of(whole), second, T_map_robot=guess), T_true, edge_m=0.1)


# What is refused, and what is sure


def test_too_few_points_and_an_empty_map_are_said(building: EvidenceMap) -> None:
    whole = snapshot_of(building)
    few = align_points(whole, np.full((500, 3), math.nan), T_map_robot=np.eye(4))
    assert (few.verdict, few.reason.split(",")[0]) == (AlignmentVerdict.FAILED, "the scans have 0 points")
    points = np.random.default_rng(1).uniform(0, 5, (1000, 3))
    empty = align_points(snapshot_of(EvidenceMap(building.geometry)), points, T_map_robot=np.eye(4))
    assert "the map has 0 occupied voxels" in empty.reason
    noise = align_points(whole, points + np.array([13, 6, 0]), T_map_robot=np.eye(4), reach_m=0, reach_rad=0)
    assert noise.verdict is AlignmentVerdict.FAILED


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"T_map_robot": np.zeros((4, 4))}, "bad_transform"),
        ({"reach_m": -1.0}, "bad_option"),
        ({"reach_rad": 4.0}, "bad_option"),
        ({"reach_m": 20.0}, "too_large"),
    ],
)
def test_a_search_that_is_none_is_refused(building: EvidenceMap, options: dict[str, object], kind: str) -> None:
    points = np.random.default_rng(1).uniform(0, 5, (1000, 3))
    with pytest.raises(BadInputError) as refused:
        align_points(snapshot_of(building), points, **({"T_map_robot": np.eye(4)} | options))  # type: ignore[arg-type]
    assert refused.value.kind == kind


def test_without_small_gicp_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(BadInputError, match=r"pip install .*\[robot\]"):
        alignment.MapSurfaces(np.zeros((1, 3)))


def test_starts_cover_the_reach_and_each_heading_once() -> None:
    assert [start.tolist() for start in starts_around(np.eye(4), reach_m=0, reach_rad=0)] == [np.eye(4).tolist()]
    starts = list(starts_around(off_by((1, 2, 3), 0), reach_m=0.8, reach_rad=math.pi))
    assert len(starts) == 5 * 5 * 24
    assert {tuple(np.round(start[:3, 3] * 10).tolist()) for start in starts} == {
        (x, y, 30) for x in (2, 6, 10, 14, 18) for y in (12, 16, 20, 24, 28)
    }
    assert len({round(math.atan2(start[1, 0], start[0, 0]) % (2 * math.pi), 6) for start in starts}) == 24


def test_one_a_voxel_is_the_mean_of_each() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (300, 3))
    expected: dict[tuple[int, ...], list[Floats]] = {}
    for point in points:
        expected.setdefault(tuple(np.floor(point / 0.5).astype(int).tolist()), []).append(point)
    means = np.array([np.mean(expected[key], axis=0) for key in sorted(expected)])
    assert np.allclose(one_a_voxel(points, 0.5), means)
    assert one_a_voxel(np.empty((0, 3)), 0.5).shape == (0, 3)
    assert transform_points(np.eye(4), means).shape == means.shape
