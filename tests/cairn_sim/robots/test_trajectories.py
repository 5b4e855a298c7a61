"""Heads as the paper prints them, joints that put them somewhere, and paths where a robot can stand."""

import math

import numpy as np
import pytest

from cairn_calib.rig.poses import check_transform
from cairn_calib.rig.rig import Spectrum, rig_from_json
from cairn_map.errors import BadInputError
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, handheld_head, lidar_head, thermal_and_tof_head, tof_head
from cairn_sim.robots.kinematics import Joints, Manipulator, measurement_joints, with_backlash
from cairn_sim.robots.robots import ROBOTS, robot_named
from cairn_sim.robots.trajectories import PATHS, PoseErrors, believed, drive, path_names, stops
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene_file import SHIPPED, load_scene

BODY_M = 0.35
"""Half a robot's width."""


def test_full_head_has_the_papers_cameras() -> None:
    rig = full_head()
    sizes = {name: (m.camera.width, m.camera.height) for name, m in rig.cameras.items()}
    assert sizes[RANGE_CAMERA] == (176, 144)
    assert sizes["colour_left"] == sizes["colour_right"] == (1280, 960)
    assert sizes["thermal_left"] == sizes["thermal_right"] == (640, 512)
    # Derived in PAPER.md section 2.
    assert rig["colour_left"].camera.focal_px[0] == pytest.approx(1330, rel=0.02)
    assert rig["thermal_left"].camera.focal_px[0] == pytest.approx(470, rel=0.02)
    assert rig[RANGE_CAMERA].camera.focal_px[0] == pytest.approx(130, rel=0.02)


def test_tof_frame_is_the_rigs_and_left_is_at_negative_x() -> None:
    rig = full_head()
    np.testing.assert_array_equal(rig[RANGE_CAMERA].transform, np.eye(4))
    for spectrum in ("colour", "thermal"):
        left, right = rig[f"{spectrum}_left"].transform, rig[f"{spectrum}_right"].transform
        assert left[0, 3] < 0 < right[0, 3]
        assert left[0, 2] > 0 > right[0, 2]


def test_no_two_lenses_are_alike_and_every_pixel_has_a_ray() -> None:
    rig = full_head(scale=0.25)
    assert len({mounted.camera for mounted in rig.cameras.values()}) == 5
    for mounted in rig.cameras.values():
        assert np.isfinite(mounted.camera.rays()).all()


def test_scale_keeps_the_view_and_lesser_heads_keep_the_places() -> None:
    full, quarter = full_head(), full_head(scale=0.25)
    assert (quarter["colour_left"].camera.width, quarter["thermal_left"].camera.height) == (320, 128)
    assert quarter["colour_left"].camera.focal_px[0] == pytest.approx(full["colour_left"].camera.focal_px[0] / 4)
    assert quarter[RANGE_CAMERA] == full[RANGE_CAMERA] == tof_head()[RANGE_CAMERA]
    assert thermal_and_tof_head()["thermal_left"] == full["thermal_left"]
    assert tof_head().of_spectrum(Spectrum.COLOUR) == []
    for scale in (0, -1, 1.5, 1e-4, float("nan")):
        with pytest.raises(BadInputError, match="scale must be"):
            full_head(scale=scale)


def test_heads_survive_their_json() -> None:
    for rig in (full_head(), handheld_head(), lidar_head(), tof_head(ideal=True)):
        assert rig_from_json(rig.to_json()) == rig


def test_level_head_looks_ahead_from_its_height() -> None:
    T = Manipulator().T_robot_rig(Joints())
    np.testing.assert_allclose(T[:3, 3], [0.06, 0, 1.1], atol=1e-12)
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 1], [0, 0, -1], atol=1e-12)


def test_joints_turn_left_and_down() -> None:
    left = Manipulator().T_robot_rig(Joints(pan_rad=math.pi / 2))
    np.testing.assert_allclose(left[:3, 2], [0, 1, 0], atol=1e-12)
    down = Manipulator().T_robot_rig(Joints(tilt_rad=math.radians(30)))
    np.testing.assert_allclose(down[:3, 2], [math.cos(math.radians(30)), 0, -0.5], atol=1e-12)
    leaning = Manipulator().T_robot_rig(Joints(arm_rad=math.radians(20)))
    assert leaning[0, 3] > 0.06 and leaning[2, 3] < 1.1


def test_thirty_six_poses_look_all_around_and_move_as_little_as_a_head_can() -> None:
    joints = measurement_joints()
    assert len(set(joints)) == len(joints) == 36
    poses = [Manipulator().T_robot_rig(j) for j in joints]
    rays = tof_head()[RANGE_CAMERA].camera.rays().reshape(-1, 3)
    around = np.concatenate([rays @ check_transform(T)[:3, :3].T for T in poses])
    assert around[:, 2].max() > 0.95 and around[:, 2].min() < -0.95
    azimuths = np.degrees(np.arctan2(around[:, 1], around[:, 0]))
    assert np.unique(azimuths // 5).size == 72
    pans = np.array([j.pan_rad for j in joints])
    assert np.abs(np.diff(pans)).max() == pytest.approx(math.pi / 6)
    with pytest.raises(BadInputError, match="at least one"):
        measurement_joints(0, 3)


def test_backlash_stops_half_a_gap_short_on_the_side_of_arrival() -> None:
    rng = np.random.default_rng(1)
    told = [Joints(pan_rad=p) for p in (0.0, 0.5, 1.0, 0.5, 0.5)]
    true = with_backlash(told, gap_rad=0.02, sigma_rad=0.0, rng=rng)
    np.testing.assert_allclose([j.pan_rad for j in true], [-0.01, 0.49, 0.99, 0.51, 0.51])
    shaken = with_backlash(told * 2000, gap_rad=0.0, sigma_rad=0.01, rng=rng)
    errors = np.array([t.pan_rad - j.pan_rad for t, j in zip(shaken, told * 2000, strict=True)])
    assert errors.std() == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize("scene_name", SHIPPED)
def test_stops_and_drives_are_clear_of_everything_but_the_ground(scene_name: str) -> None:
    scene = load_scene(scene_name)
    assert path_names(scene_name)
    for path in PATHS[scene_name]:
        standing = stops(scene, path)
        driving = drive(scene, path, speed_m_s=0.5, rate_hz=5)
        assert len(driving) > len(standing)
        # Above the deck, which is as high as the body is wide.
        for height_m in np.linspace(BODY_M + 0.05, 1.1, 6):
            at = np.array([(T @ [0, 0, height_m, 1])[:3] for T in [*standing, *driving]])
            assert scene.distance_m(at).min() > BODY_M, (path, height_m)
        for T in standing:
            check_transform(T)
            assert scene.distance_m(T[:3, 3]) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("scene_name", [name for name in SHIPPED if load_scene(name).moving])
def test_what_moves_keeps_clear_of_all_paths_at_all_times(scene_name: str) -> None:
    scene = load_scene(scene_name)
    poses = [T for path in PATHS[scene_name] for T in drive(scene, path, speed_m_s=0.5, rate_hz=5)]
    heights_m = np.linspace(BODY_M + 0.05, 1.1, 6)
    at = np.array([(T @ [0, 0, height_m, 1])[:3] for T in poses for height_m in heights_m])
    keyframes_s = {key.time_s for each in scene.moving for key in each.movement.keyframes}
    times_s = sorted(keyframes_s | {float(s) for s in range(24)} | {1801.0, 1802.0, 1803.0, 3601.0, 3602.0})
    # While nothing moves it is the very same scene, asked once.
    for now, after_s in {scene.at(CLOCK_START_S + after_s): after_s for after_s in times_s}.items():
        assert now.distance_m(at).min() > BODY_M - 0.05, after_s


def test_the_papers_experiment_has_its_54_stops_as_far_apart_as_printed() -> None:
    scene = load_scene("building")
    experiment, labs, corridors = (stops(scene, name) for name in ("experiment", "labs", "corridors"))
    assert (len(labs), len(corridors), len(experiment)) == (26, 28, 54)
    for line, mean_m, spread_m in ((labs, 0.7, 0.1), (corridors, 1.4, 0.4)):
        at = np.array([T[:3, 3] for T in line])
        steps_m = np.linalg.norm(np.diff(at, axis=0), axis=1)
        assert steps_m.mean() == pytest.approx(mean_m, abs=0.05)
        assert np.abs(steps_m - mean_m).max() <= spread_m + 0.01
    ahead = [T[:3, 0] for T in (labs[0], corridors[0])]
    assert abs(float(ahead[0] @ ahead[1])) < 1e-9
    assert len(experiment) * ROBOTS["orpheus"].scans_per_stop == 1944


def test_a_robot_on_a_slope_stands_square_to_it() -> None:
    yard = load_scene("yard")
    tilts = [math.degrees(math.acos(T[2, 2])) for T in stops(yard, "loop")]
    assert max(tilts) == pytest.approx(6, abs=1)


def test_what_does_not_exist_is_refused_with_what_does() -> None:
    scene = load_scene("small-room")
    with pytest.raises(BadInputError, match="west, doorway, east"):
        stops(scene, "roof")
    with pytest.raises(BadInputError, match="speed and a rate above 0"):
        drive(scene, "west", speed_m_s=0, rate_hz=5)
    with pytest.raises(BadInputError, match="orpheus, tof, lidar, handheld"):
        robot_named("dog")


def test_without_errors_a_robot_believes_the_truth() -> None:
    true = stops(load_scene("small-room"), "west")
    np.testing.assert_array_equal(believed(true, PoseErrors(), np.random.default_rng(1)), true)


@pytest.mark.slow
def test_pose_errors_have_their_sigmas_and_drift_grows_with_the_way() -> None:
    true = [np.eye(4)] * 4000
    shaken = np.array(believed(true, PoseErrors(sigma_m=0.02, sigma_rad=0.01), np.random.default_rng(1)))
    assert shaken[:, :3, 3].std(axis=0) == pytest.approx([0.02] * 3, rel=0.05)
    assert shaken[:, 1, 0].std() == pytest.approx(0.01, rel=0.05)
    line = []
    for metres in range(26):
        T = np.eye(4)
        T[0, 3] = metres
        line.append(T)
    ends = np.array([believed(line, PoseErrors(drift=0.01), np.random.default_rng(n))[-1][:3, 3] for n in range(400)])
    assert ends.std(axis=0) == pytest.approx([0.05] * 3, rel=0.15)
    turned = np.array([believed(line, PoseErrors(drift_rad=0.01), np.random.default_rng(n))[-1] for n in range(400)])
    assert np.arctan2(turned[:, 1, 0], turned[:, 0, 0]).std() == pytest.approx(0.05, rel=0.15)
    for T in turned[:5]:
        check_transform(T)
