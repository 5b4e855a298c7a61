"""Heads as the paper prints them, and stops where a robot can stand."""

from itertools import pairwise

import numpy as np
import pytest

from cairn_calib.poses import checked_transform
from cairn_calib.rig import Spectrum, rig_from_json
from cairn_map.errors import BadInputError
from cairn_sim.drive import CLEARANCE_M, HEAD_HEIGHT_M, PATHS, head_poses, stops
from cairn_sim.heads import RANGE_CAMERA, colour_and_tof_head, full_head, thermal_and_tof_head, tof_head
from cairn_sim.room import small_room


@pytest.mark.parametrize("path", list(PATHS))
def test_stops_and_the_way_between_them_are_clear_from_deck_to_head(path: str) -> None:
    room, at = small_room(), stops(path)
    between = np.concatenate([np.linspace(a, b, 20) for a, b in pairwise(at)])
    # The deck is as far above the floor as the clearance asks.
    for height_m in np.linspace(CLEARANCE_M + 0.01, HEAD_HEIGHT_M, 15):
        standing, driving = at.copy(), between.copy()
        standing[:, 2] = driving[:, 2] = height_m
        assert room.distance_m(standing).min() >= CLEARANCE_M
        assert room.distance_m(driving).min() >= 0.3
    assert (room.solid_at(at) == -1).all()


def test_stops_are_about_as_far_apart_as_the_papers() -> None:
    for path in PATHS:
        steps = np.linalg.norm(np.diff(stops(path), axis=0), axis=1)
        assert steps.min() > 0.5
        assert steps.max() < 1.0


def test_unknown_path_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(BadInputError, match="west, doorway, east"):
        stops("roof")


def test_thirty_six_poses_share_the_position_and_look_all_around() -> None:
    at = stops("west")[0]
    poses = head_poses(at, n_yaw=12, n_pitch=3)
    assert len(poses) == 36
    forward = np.array([T[:3, 2] for T in poses])
    for T in poses:
        np.testing.assert_allclose(checked_transform(T), T, atol=1e-12)
        np.testing.assert_array_equal(T[:3, 3], at)
        assert abs(T[2, 0]) < 1e-12 and T[2, 1] < 0
    np.testing.assert_allclose(forward.mean(axis=0), 0, atol=1e-12)
    rays = tof_head()[RANGE_CAMERA].camera.rays().reshape(-1, 3)
    up = np.concatenate([(rays @ T[:3, :3].T)[:, 2] for T in poses])
    assert up.max() > 0.95 and up.min() < -0.95


def test_head_pose_counts_below_one_are_refused() -> None:
    assert len(head_poses(stops("west")[0], n_yaw=1, n_pitch=1)) == 1
    with pytest.raises(BadInputError, match="at least one"):
        head_poses(stops("west")[0], n_yaw=0, n_pitch=3)


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


def test_scale_keeps_the_view_and_lesser_heads_keep_the_places() -> None:
    full, quarter = full_head(), full_head(scale=0.25)
    assert (quarter["colour_left"].camera.width, quarter["thermal_left"].camera.height) == (320, 128)
    assert quarter["colour_left"].camera.focal_px[0] == pytest.approx(full["colour_left"].camera.focal_px[0] / 4)
    assert quarter[RANGE_CAMERA] == full[RANGE_CAMERA]
    assert colour_and_tof_head()["colour_left"] == full["colour_left"]
    assert thermal_and_tof_head()["thermal_left"] == full["thermal_left"]
    assert tof_head().of_spectrum(Spectrum.COLOUR) == []
    for scale in (0, -1, 1.5, 1e-4, float("nan")):
        with pytest.raises(BadInputError, match="scale must be"):
            full_head(scale=scale)


def test_heads_survive_their_json() -> None:
    for rig in (full_head(), colour_and_tof_head(scale=0.25), thermal_and_tof_head(), tof_head()):
        assert rig_from_json(rig.to_json()) == rig
