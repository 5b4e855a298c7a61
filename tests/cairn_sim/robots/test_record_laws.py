"""Laws of recordings and their truth: the plan's sensors, play of the gears, times and scene are in them.

What these tests do not show: that the noise is right; test_sensors.py does.
"""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cairn_calib.rig.poses import Transform, look_at, transform_points
from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.trajectory import read_trajectory
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError
from cairn_sim.render.render import render_scan
from cairn_sim.render.truth import camera_truth
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, tof_head
from cairn_sim.robots.record import Plan, record, shots_of
from cairn_sim.robots.robots import LIDAR, ROBOTS
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.scene_file import load_scene, scene_from_toml, shipped_text
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface
from cairn_sim.sim_command import main

ROOM = load_scene("small-room")


def pan_error_rad(true: Transform, told: Transform) -> float:
    """Angle about the vertical between the head's direction and the commanded one."""
    ahead = (math.atan2(T[1, 2], T[0, 2]) for T in (true, told))
    error = next(ahead) - next(ahead)
    return (error + math.pi) % (2 * math.pi) - math.pi


def test_a_lidar_records_ranges_two_centimetres_around_the_truth(tmp_path: Path) -> None:
    plan = Plan(scene=ROOM, robot=ROBOTS["lidar"], path="west", last_stop=2)
    list(record(plan, tmp_path / "rec", scene_text=shipped_text("small-room")))
    recording, errors = open_recording(tmp_path / "rec"), []
    for index in range(2):
        truth = np.load(tmp_path / "rec" / "truth" / RANGE_CAMERA / f"{index:06d}.npz")
        range_m = recording.scan(index).range_m
        errors.append((range_m - truth["range_m"])[np.isfinite(range_m) & (truth["way"] == 0)])
    error_m = np.concatenate(errors)
    assert len(error_m) > 30_000
    assert error_m.std() == pytest.approx(LIDAR.sigma_m, rel=0.03) and LIDAR.sigma_m == 0.02
    assert abs(error_m.mean()) < 0.001


def test_gears_with_play_stop_half_of_it_short_and_shake_by_a_tenth() -> None:
    gap_rad = 0.01
    shots = shots_of(Plan(scene=ROOM, robot=ROBOTS["tof"], path="west", backlash_rad=gap_rad))
    errors_rad = np.array([pan_error_rad(shot.T_map_rig, shot.T_believed) for shot in shots])
    assert len(errors_rad) == 288 and abs(np.sign(errors_rad).mean()) < 0.5
    off_rad = np.abs(errors_rad) - gap_rad / 2
    assert abs(off_rad.mean()) < gap_rad / 10 / 3
    assert off_rad.std() == pytest.approx(gap_rad / 10, rel=0.15)


def test_backlash_of_one_degree_puts_the_true_head_half_a_degree_off(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    options = ["--robot", "tof", "--stops", "0:1", "--perfect", "--truth", "none", "--backlash-deg", "1"]
    assert main(["record", "small-room", str(folder), *options]) == 0
    recording, true = open_recording(folder), read_trajectory(folder / "truth" / "trajectory.txt")
    scans = [recording.scan(index) for index in range(len(recording))]
    errors_rad = [pan_error_rad(true.pose_at(scan.time_s, max_gap_s=0.0), scan.T_map_rig) for scan in scans]
    assert np.degrees(np.median(np.abs(errors_rad))) == pytest.approx(0.5, abs=0.06)
    assert np.degrees(np.max(np.abs(errors_rad))) < 1


@pytest.mark.parametrize("rate_hz", [2.0, 4.0, 10.0])
def test_a_drive_takes_as_many_scans_a_second_as_planned_and_goes_as_fast(rate_hz: float) -> None:
    plan = Plan(scene=load_scene("building"), robot=ROBOTS["lidar"], path="labs", speed_m_s=1.0, rate_hz=rate_hz)
    shots = shots_of(plan)
    times_s = np.array([shot.time_s for shot in shots])
    assert times_s[0] == CLOCK_START_S
    np.testing.assert_allclose(np.diff(times_s), 1 / rate_hz, rtol=0, atol=1e-6)
    places = np.array([shot.T_map_rig[:3, 3] for shot in shots])
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 1 / rate_hz, rtol=0, atol=1e-9)


def test_times_of_a_part_are_those_of_the_whole_and_rise_everywhere() -> None:
    for speed_m_s in (0.0, 0.7):
        plan = Plan(scene=ROOM, robot=ROBOTS["tof"], path="west", speed_m_s=speed_m_s, rate_hz=3.0)
        whole = [shot.time_s for shot in shots_of(plan)]
        per_stop = 1 if speed_m_s else 36
        assert [shot.time_s for shot in shots_of(replace(plan, first_stop=2, last_stop=4))] == whole[
            2 * per_stop : 4 * per_stop
        ]
        assert (np.diff(whole) > 0).all()


def test_rounds_go_the_same_way_again_at_the_next_times() -> None:
    plan = Plan(scene=ROOM, robot=ROBOTS["tof"], path="west", last_stop=2)
    once, thrice = shots_of(plan), shots_of(replace(plan, rounds=3))
    assert len(thrice) == 3 * len(once) == 3 * 72
    for number, shot in enumerate(thrice):
        np.testing.assert_array_equal(shot.T_map_rig, once[number % 72].T_map_rig)
        assert (shot.stop, shot.scan) == (once[number % 72].stop, once[number % 72].scan)
    assert len({shot.number for shot in thrice}) == len(thrice)
    # A round of all 8 stops takes 144 s, whichever of them are recorded.
    assert {b.time_s - a.time_s for a, b in zip(once, thrice[72:], strict=False)} == {144.0}


def test_a_recording_of_hours_visits_its_stops_at_even_times() -> None:
    plan = Plan(scene=ROOM, robot=ROBOTS["tof"], path="west", rounds=5, lasts_s=7200.0)
    shots = shots_of(plan)
    first = [shot.time_s - CLOCK_START_S for shot in shots if shot.scan == 0]
    np.testing.assert_allclose(first, np.arange(40) * 180.0)
    for a, b in pairwise(shots):
        if b.scan:
            assert b.time_s - a.time_s == pytest.approx(0.5)
    assert sum(shot.ends_stop for shot in shots) == 40


def test_rounds_of_a_drive_are_spread_over_the_time() -> None:
    plan = Plan(scene=ROOM, robot=ROBOTS["tof"], path="west", speed_m_s=0.5, rate_hz=2.0, rounds=2, lasts_s=600.0)
    times_s = np.array([shot.time_s for shot in shots_of(plan)]) - CLOCK_START_S
    gaps_s = np.diff(times_s)
    half = len(times_s) // 2
    assert times_s[half] == pytest.approx(300)
    np.testing.assert_allclose(np.delete(gaps_s, half - 1), 0.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rounds": 0}, "at least 1 round"),
        ({"lasts_s": -1.0}, "a time from 0 s"),
        ({"lasts_s": math.nan}, "a time from 0 s"),
        ({"lasts_s": 100.0}, "288 scans take 0.04 h at least, got 0.028 h"),
        ({"rounds": 1000}, "at most 200000 scans, got 1000 rounds of 288"),
    ],
)
def test_rounds_and_hours_that_cannot_be_are_refused(changes: dict[str, float], words: str) -> None:
    with pytest.raises(BadInputError, match=words) as caught:
        shots_of(replace(Plan(scene=ROOM, robot=ROBOTS["tof"], path="west"), **changes))  # type: ignore[arg-type]
    assert caught.value.kind == "bad_plan"


def test_each_scan_of_a_recording_shows_its_own_time_and_so_does_its_truth(tmp_path: Path) -> None:
    scene = scene_from_toml(MOVING)
    plan = Plan(
        scene=replace(scene, name="small-room"),
        robot=replace(ROBOTS["tof"], scans=(2, 1)),
        path="west",
        perfect=True,
        rounds=2,
        lasts_s=7200.0,
        last_stop=1,
    )
    shots = list(record(plan, tmp_path / "rec", scene_text=MOVING))
    recording = open_recording(tmp_path / "rec")
    assert [recording.scan(n).time_s for n in range(4)] == [shot.time_s for shot in shots]
    for index, shot in enumerate(shots):
        now, rig = scene.at(shot.time_s), plan.robot.rig_of(1.0)
        expected = camera_truth(now, rig, RANGE_CAMERA, T_map_rig=shot.T_map_rig)
        truth = np.load(tmp_path / "rec" / "truth" / RANGE_CAMERA / f"{index:06d}.npz")
        np.testing.assert_array_equal(truth["range_m"], expected.range_m)
        seen = render_scan(now, rig, T_map_rig=shot.T_map_rig, range_camera=RANGE_CAMERA, time_s=shot.time_s)
        np.testing.assert_allclose(recording.scan(index).range_m, seen.range_m, atol=6e-4)
    screen = scene.number_of("screen/sheet")
    hit = [(np.load(tmp_path / "rec/truth/tof" / f"{n:06d}.npz")["solid"] == screen).any() for n in range(4)]
    assert not any(hit[:2]) and any(hit[2:]), "the screen comes after half an hour"
    names = json.loads((tmp_path / "rec" / "truth" / "truth.json").read_text())["solids"]
    assert names[screen] == "screen/sheet"


MOVING = """
format = "cairn-scene"
version = 1
name = "mine"
base = "small-room"
[materials]
cloth = {colour = "#804040"}
[objects.screen]
parts = [{name = "sheet", box = [0.1, 1.6, 1.6], surface = "cloth"}]
[[moving]]
name = "screen"
object = "screen"
keyframes = [{time_s = 0, gone = true}, {time_s = 1800, at = [0.9, 2.4, 0.4], turn_deg = 90}]
"""

WARM, COLD = Material(temperature_k=330.0), Material(temperature_k=270.0)
PERIOD_M, PHASE_M = np.array([0.31, 0.23]), np.array([0.04, -0.07])


def checker_kelvin(points: Floats) -> Floats:
    """The temperature of a checkered wall across x, by place, from how `Surface` describes its squares."""
    squares = np.floor((points[..., 1:] - PHASE_M) / PERIOD_M).sum(axis=-1)
    return np.where(squares % 2 == 0, WARM.temperature_k, COLD.temperature_k)


@pytest.mark.parametrize("optics", list(Optics))
@pytest.mark.parametrize("camera", [RANGE_CAMERA, "thermal_left"])
def test_the_truth_is_as_warm_as_the_square_of_the_first_surface(optics: Optics, camera: str) -> None:
    one, two = (replace(m, optics=optics) for m in (WARM, COLD))
    checker = Surface(one, two, (PERIOD_M[0], PERIOD_M[1]), (PHASE_M[0], PHASE_M[1]))
    stripes = Surface(Material(temperature_k=350.0), Material(temperature_k=250.0), (0.11, math.inf))
    around = [Solid(f"wall {x}", Box((1, 90, 90)), stripes, placed((x, 0, 0))) for x in (-4.5, 4.5)]
    scene = scene_of([*around, Solid("checker", Box((0.01, 90, 90)), checker, placed((2.005, 0, 0)))])
    rig, T_map_rig = full_head(scale=0.1), look_at((0.1, 0.2, 0.3), (2, 0.6, 0.1))
    truth = camera_truth(scene, rig, camera, T_map_rig=T_map_rig)
    rays = rig[camera].camera.rays()
    points = transform_points(T_map_rig @ rig[camera].transform, rays * truth.range_m[..., None])
    assert (truth.solid == 2).all()
    expected = checker_kelvin(points)
    np.testing.assert_array_equal(truth.temperature_k, expected.astype(np.float32))
    np.testing.assert_array_equal(truth.temperature_k, scene.temperature_k_at(points))
    assert 0.3 < (expected == 330).mean() < 0.7


def test_the_truth_of_a_shipped_scene_is_as_warm_as_the_scene_says_at_that_point() -> None:
    scene, rig = load_scene("building"), tof_head()
    T_map_rig = look_at((17.0, 20.6, 0.0), (17.5, 19.5, -0.2))
    truth = camera_truth(scene, rig, RANGE_CAMERA, T_map_rig=T_map_rig)
    points = transform_points(T_map_rig, rig[RANGE_CAMERA].camera.rays() * truth.range_m[..., None])
    same = truth.temperature_k == scene.temperature_k_at(points).astype(np.float32)
    # A point of a face that another solid touches may lie a rounding deeper in that.
    assert same.mean() > 0.995 and (truth.way == 2).any()


def test_the_truth_is_as_warm_as_the_solid_that_it_names_where_two_are_flush() -> None:
    walls = []
    for depth_m, kelvin in ((1.0, 280.0), (0.3, 300.0), (2.2, 320.0)):
        T = look_at((0, 0, 0), (1.0, 0.7, 0.3))
        T[:3, 3] = T[:3, 2] * (3 + depth_m / 2)
        walls.append(Solid(f"wall of {kelvin} K", Box((90, 90, depth_m)), Surface(Material(temperature_k=kelvin)), T))
    scene = scene_of(walls)
    truth = camera_truth(scene, tof_head(), RANGE_CAMERA, T_map_rig=look_at((0, 0, 0), (1.0, 0.6, 0.2)))
    assert len(np.unique(truth.solid)) > 1
    np.testing.assert_array_equal(truth.temperature_k, scene.surfaces.temperature_k[truth.solid, 0])
