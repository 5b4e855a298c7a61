"""The truth behind images, and recordings that carry it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cairn_calib.rig.poses import look_at, transform_points
from cairn_fusion.recording.images import read_grey16
from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.trajectory import read_trajectory
from cairn_map.errors import BadInputError, ConflictError
from cairn_sim.render.rays import cast, visible_from
from cairn_sim.render.render import render_scan
from cairn_sim.render.truth import camera_truth
from cairn_sim.robots.heads import RANGE_CAMERA, full_head
from cairn_sim.robots.record import Plan, record, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import PoseErrors, stops
from cairn_sim.scene.scene import scene_of
from cairn_sim.scene.scene_file import load_scene, shipped_text
from cairn_sim.scene.solids import Box, Solid, placed
from cairn_sim.scene.surfaces import Material, Optics, Surface

ROOM = load_scene("small-room")
RIG = full_head(scale=0.25)
T_ROOM = ROBOTS["orpheus"].head_poses(stops(ROOM, "west")[3])[14]
FEW = replace(ROBOTS["orpheus"], scans=(2, 1))


def plan(**changes: object) -> Plan:
    return replace(Plan(scene=ROOM, robot=FEW, path="west", scale=0.1, last_stop=2), **changes)  # type: ignore[arg-type]


def write(what: Plan, folder: Path) -> Path:
    list(record(what, folder, scene_text=shipped_text("small-room")))
    return folder


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("camera", list(RIG.cameras))
def test_truth_is_the_first_surface_of_each_centre_ray(camera: str) -> None:
    truth = camera_truth(ROOM, RIG, camera, T_map_rig=T_ROOM)
    T_map_camera = T_ROOM @ RIG[camera].transform
    points = transform_points(T_map_camera, RIG[camera].camera.rays() * truth.range_m[..., None])
    np.testing.assert_allclose(ROOM.distance_m(points), 0, atol=1e-9)
    np.testing.assert_allclose(truth.temperature_k, ROOM.temperature_k_at(points), rtol=1e-6)
    assert truth.solid.shape == truth.way.shape == truth.visible.shape == truth.range_m.shape
    assert not truth.way.any()


def test_truth_agrees_with_perfect_images() -> None:
    scan = render_scan(ROOM, RIG, T_map_rig=T_ROOM, range_camera=RANGE_CAMERA, time_s=0.0)
    np.testing.assert_array_equal(
        scan.range_m, camera_truth(ROOM, RIG, RANGE_CAMERA, T_map_rig=T_ROOM).range_m.astype(np.float32)
    )
    kelvin = camera_truth(ROOM, RIG, "thermal_left", T_map_rig=T_ROOM).temperature_k
    np.testing.assert_allclose(scan.thermal["thermal_left"], kelvin, rtol=1e-6)


def test_a_point_is_visible_where_the_other_camera_sees_that_very_point() -> None:
    truth = camera_truth(ROOM, RIG, RANGE_CAMERA, T_map_rig=T_ROOM)
    points = transform_points(T_ROOM, RIG[RANGE_CAMERA].camera.rays() * truth.range_m[..., None])
    names = list(RIG.cameras)
    assert (truth.visible & 1).all()
    for name in names[1:]:
        seen = (truth.visible >> names.index(name) & 1).astype(bool)
        T_map_camera = T_ROOM @ RIG[name].transform
        for y, x in np.random.default_rng(1).integers(0, (144, 176), (150, 2)):
            own = np.linalg.inv(T_map_camera) @ [*points[y, x], 1]
            pixel = RIG[name].camera.project(own[:3])
            expected = bool(RIG[name].camera.contains(pixel))
            if expected:
                aim = look_at(T_map_camera[:3, 3], points[y, x])
                one = full_head(ideal=True)[RANGE_CAMERA].camera.model_copy(
                    update={"width": 1, "height": 1, "centre_px": (0.0, 0.0)}
                )
                expected = bool(cast(ROOM, one, aim).range_m[0] > np.linalg.norm(own[:3]) - 1e-6)
            assert seen[y, x] == expected
        assert 0 < seen.mean() < 1


def test_what_stands_between_hides_and_glass_hides_from_thermal_alone() -> None:
    grey = Surface(Material())
    wall = Solid("wall", Box((1, 100, 100)), grey, placed((3.5, 0, 0)))
    point = np.array([[3.0, 0, 0], [np.nan, 0, 0], [3.0, 50, 0], [3.01, 0, 0]])
    T = look_at((0, 0, 0), (1, 0, 0))
    for optics, colour, thermal in ((Optics.OPAQUE, 0, 0), (Optics.GLASS, 1, 0), (Optics.MIRROR, 0, 0)):
        pane = Solid("pane", Box((0.01, 1, 1)), Surface(Material(optics=optics)), placed((1, 0, 0)))
        scene = scene_of([wall, pane])
        assert visible_from(scene, point, RIG, "colour_left", T_map_rig=T).tolist() == [colour, 0, 0, 0]
        assert visible_from(scene, point, RIG, "thermal_left", T_map_rig=T).tolist() == [thermal, 0, 0, 0]
    alone = scene_of([wall])
    assert visible_from(alone, point, RIG, "thermal_left", T_map_rig=T).tolist() == [1, 0, 0, 0]


def test_truth_at_a_pane_is_the_pane_and_says_how_light_goes_on() -> None:
    glass = Surface(Material(temperature_k=280.0, optics=Optics.GLASS))
    wall = Solid("wall", Box((1, 100, 100)), Surface(Material(temperature_k=300.0)), placed((3.5, 0, 0)))
    scene = scene_of([wall, Solid("pane", Box((0.01, 100, 100)), glass, placed((1.005, 0, 0)))])
    truth = camera_truth(scene, full_head(ideal=True), RANGE_CAMERA, T_map_rig=look_at((0, 0, 0), (1, 0, 0)))
    np.testing.assert_allclose(truth.range_m.min(), 1.0, rtol=1e-4)
    assert (truth.solid == 1).all() and (truth.way == 1).all() and (truth.temperature_k == 280).all()


def test_nothing_has_no_truth() -> None:
    post = Solid("post", Box((0.1, 0.1, 0.1)), Surface(Material()), placed((-5, 0, 0)))
    truth = camera_truth(scene_of([post]), RIG, RANGE_CAMERA, T_map_rig=look_at((0, 0, 0), (1, 0, 0)))
    assert np.isinf(truth.range_m).all() and (truth.solid == -1).all()
    assert np.isnan(truth.temperature_k).all() and not truth.visible.any()


def test_a_recording_is_one_like_any_other_with_its_truth_beside_it(tmp_path: Path) -> None:
    folder = write(plan(truth="all"), tmp_path / "rec")
    recording = open_recording(folder)
    assert [len(stop) for stop in recording.measurements()] == [2, 2]
    assert set(recording.rig.cameras) == {"tof", "colour_left", "colour_right", "thermal_left", "thermal_right"}
    about = json.loads((folder / "truth" / "truth.json").read_text())
    assert (about["scene"], about["seed"], about["cameras"]) == ("small-room", 1, list(recording.rig.cameras))
    assert load_scene(folder / "truth" / "scene.toml").name == "small-room"
    for index, shot in enumerate(shots_of(plan())):
        scan = recording.scan(index)
        np.testing.assert_allclose(scan.T_map_rig, shot.T_map_rig, atol=1e-9)
        for name in recording.rig.cameras:
            stored = np.load(folder / "truth" / name / f"{index:06d}.npz")
            truth = camera_truth(ROOM, recording.rig, name, T_map_rig=shot.T_map_rig)
            for field in ("range_m", "solid", "temperature_k", "way", "visible"):
                np.testing.assert_array_equal(stored[field], getattr(truth, field))


def test_the_same_seed_gives_the_same_bytes_and_a_part_is_a_part_of_the_whole(tmp_path: Path) -> None:
    errors = {"errors": PoseErrors(sigma_m=0.01, drift=0.01), "backlash_rad": 0.002}
    one = files_of(write(plan(**errors), tmp_path / "one"))
    assert files_of(write(plan(**errors), tmp_path / "two")) == one
    other = files_of(write(plan(seed=2, **errors), tmp_path / "three"))
    assert [name for name in one if name.endswith(".png") and other[name] == one[name]] == []
    part = files_of(write(plan(first_stop=1, **errors), tmp_path / "part"))
    assert part["images/tof/000000.png"] == one["images/tof/000002.png"]


def test_true_poses_are_kept_where_the_robot_errs(tmp_path: Path) -> None:
    folder = write(plan(errors=PoseErrors(sigma_m=0.05), backlash_rad=0.01, truth="none"), tmp_path / "rec")
    believed = open_recording(folder)
    true = read_trajectory(folder / "truth" / "trajectory.txt")
    shots = shots_of(plan(errors=PoseErrors(sigma_m=0.05), backlash_rad=0.01))
    for index, shot in enumerate(shots):
        np.testing.assert_allclose(true.pose_at(shot.time_s, max_gap_s=0.0), shot.T_map_rig, atol=1e-9)
        np.testing.assert_allclose(believed.scan(index).T_map_rig, shot.T_believed, atol=1e-9)
        assert 0.001 < np.abs(shot.T_map_rig - shot.T_believed).max() < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tof", "lidar", "handheld"])
def test_every_robot_records_standing_and_driving(name: str, tmp_path: Path) -> None:
    robot = ROBOTS[name] if ROBOTS[name].manipulator is None else replace(ROBOTS[name], scans=(2, 1))
    standing = write(plan(robot=robot, last_stop=1), tmp_path / "standing")
    assert len(open_recording(standing)) == robot.scans_per_stop
    driving = write(plan(robot=robot, speed_m_s=1.0, rate_hz=2.0, last_stop=3), tmp_path / "driving")
    recording = open_recording(driving)
    assert [len(stop) for stop in recording.measurements()] == [1, 1, 1]
    gone_m = np.linalg.norm(recording.scan(2).T_map_rig[:3, 3] - recording.scan(0).T_map_rig[:3, 3])
    assert 0.8 < gone_m < 1.1


def test_a_perfect_recording_is_the_truth_to_the_millimetre(tmp_path: Path) -> None:
    folder = write(plan(perfect=True, last_stop=1), tmp_path / "rec")
    truth = np.load(folder / "truth" / "tof" / "000000.npz")
    np.testing.assert_allclose(open_recording(folder).scan(0).range_m, truth["range_m"], atol=0.0005001)


def test_a_recording_that_is_left_early_is_unfinished_and_nothing_is_overwritten(tmp_path: Path) -> None:
    scans = record(plan(), tmp_path / "rec", scene_text="")
    next(scans)
    scans.close()  # type: ignore[attr-defined]
    with pytest.raises(BadInputError, match="never finished"):
        open_recording(tmp_path / "rec")
    with pytest.raises(ConflictError, match="must be empty"):
        write(plan(), tmp_path / "rec")
    with pytest.raises(BadInputError, match="has 8 stops, none of them chosen"):
        shots_of(plan(first_stop=40, last_stop=None))


def test_a_mirror_behind_a_pane_is_in_sight_where_it_is_seen() -> None:
    pane = Solid("pane", Box((0.01, 9, 9)), Surface(Material(optics=Optics.GLASS)), placed((1, 0, 0)))
    mirror = Solid("mirror", Box((0.01, 9, 9)), Surface(Material(optics=Optics.MIRROR)), placed((3.005, 0, 0)))
    behind = Solid("wall", Box((1, 9, 9)), Surface(Material()), placed((5, 0, 0)))
    points = np.array([[3.0, 0, 0], [4.5, 0, 0], [0.995, 0, 0]])
    T = look_at((0, 0, 0), (1, 0, 0))
    scene = scene_of([pane, mirror, behind])
    assert visible_from(scene, points, RIG, "colour_left", T_map_rig=T).tolist() == [True, False, True]
    assert visible_from(scene, points, RIG, "thermal_left", T_map_rig=T).tolist() == [False, False, True]


def test_raw_counts_say_what_the_thermal_images_say(tmp_path: Path) -> None:
    folder = write(plan(raw=True, truth="none", last_stop=1), tmp_path / "rec")
    about = json.loads((folder / "truth" / "truth.json").read_text())["thermal"]["thermal_left"]
    counts = read_grey16(folder / "raw" / "thermal_left" / "000001.png").astype(float)
    kelvin = about["planck_b"] / np.log(about["planck_r"] / (counts - about["planck_o"]) + about["planck_f"])
    np.testing.assert_allclose(open_recording(folder).scan(1).thermal["thermal_left"], kelvin, rtol=0, atol=0.0051)


@pytest.mark.parametrize(
    "numbers",
    [{"seed": -1}, {"speed_m_s": -1.0}, {"speed_m_s": float("nan")}, {"rate_hz": 0.0}, {"backlash_rad": -0.1}],
)
def test_plans_that_cannot_be_are_refused(numbers: dict[str, float]) -> None:
    with pytest.raises(BadInputError, match=r"needs a seed|backlash must be"):
        plan(**numbers)


def test_pose_errors_and_drives_that_cannot_be_are_refused() -> None:
    for value in (-1.0, float("nan"), float("inf")):
        with pytest.raises(BadInputError, match="drift must be 0 to 100"):
            PoseErrors(drift=value)
    with pytest.raises(BadInputError, match="at most 100000 poses"):
        shots_of(plan(speed_m_s=1e-9))


@pytest.mark.parametrize(("panes", "in_sight"), [(8, True), (9, False)])
def test_what_is_too_dim_to_be_seen_is_not_in_sight(panes: int, in_sight: bool) -> None:
    glass = Surface(Material(optics=Optics.GLASS))
    solids = [Solid(f"pane {n}", Box((0.01, 9, 9)), glass, placed((1 + 0.1 * n, 0, 0))) for n in range(panes)]
    solids.append(Solid("wall", Box((1, 9, 9)), Surface(Material()), placed((3.5, 0, 0))))
    point, T = np.array([[3.0, 0, 0]]), look_at((0, 0, 0), (1, 0, 0))
    assert visible_from(scene_of(solids), point, RIG, "colour_left", T_map_rig=T).tolist() == [in_sight]
