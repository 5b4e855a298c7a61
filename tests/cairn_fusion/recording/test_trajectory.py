from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.poses import Transform, transform_from_quaternion
from cairn_fusion.recording.trajectory import interpolate_pose, read_trajectory, trajectory_line
from cairn_map.errors import BadInputError

QUARTER = np.sqrt(0.5)


def random_pose(seed: int) -> Transform:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    return transform_from_quaternion(rng.normal(size=3) * 100, q / np.linalg.norm(q))


def file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    return path


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=50, deadline=None)
@given(seed=seeds)
def test_a_written_pose_reads_back(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    T = random_pose(seed)
    time_s = 1.7e9 + seed / 7
    path = file(tmp_path_factory.mktemp("t"), trajectory_line(time_s, T))
    read = read_trajectory(path)
    assert read.poses.times_s[0] == time_s
    np.testing.assert_allclose(read.pose_at(time_s, max_gap_s=0), T, atol=1e-14, rtol=0)


@settings(max_examples=50)
@given(seed=seeds, fraction=st.floats(0, 1))
def test_interpolation_turns_at_constant_speed(seed: int, fraction: float) -> None:
    start, end = random_pose(seed), random_pose(seed + 1)
    part = interpolate_pose(start, end, fraction)

    def angle_rad(T: Transform) -> float:
        return float(np.arccos(np.clip((np.trace(start[:3, :3].T @ T[:3, :3]) - 1) / 2, -1, 1)))

    assert angle_rad(part) == pytest.approx(fraction * angle_rad(end), abs=1e-6)
    np.testing.assert_allclose(part[:3, 3], start[:3, 3] + fraction * (end - start)[:3, 3], atol=1e-9)


@settings(max_examples=50)
@given(seed=seeds, fraction=st.floats(0, 1))
def test_interpolation_is_the_same_from_either_end(seed: int, fraction: float) -> None:
    start, end = random_pose(seed), random_pose(seed + 1)
    np.testing.assert_allclose(
        interpolate_pose(start, end, fraction), interpolate_pose(end, start, 1 - fraction), atol=1e-9, rtol=0
    )


def test_interpolation_between_equal_poses_is_that_pose() -> None:
    T = random_pose(3)
    np.testing.assert_allclose(interpolate_pose(T, T, 0.3), T, atol=1e-12)


def test_a_pose_between_two_lines_is_halfway(tmp_path: Path) -> None:
    path = file(tmp_path, f"# a comment\n10 0 0 0 0 0 0 1\n\n11 2 0 0 0 0 {QUARTER} {QUARTER}\n")
    T = read_trajectory(path).pose_at(10.5, max_gap_s=1.0)
    eighth = np.pi / 8
    expected = transform_from_quaternion((1, 0, 0), (0, 0, np.sin(eighth), np.cos(eighth)))
    np.testing.assert_allclose(T, expected, atol=1e-12)


def test_the_sign_of_a_quaternion_does_not_matter(tmp_path: Path) -> None:
    plus = read_trajectory(file(tmp_path, "0 0 0 0 0 0 0 1\n1 0 0 0 0 0.1 0 0.99\n")).pose_at(0.4, max_gap_s=1)
    minus = read_trajectory(file(tmp_path, "0 0 0 0 0 0 0 -1\n1 0 0 0 0 0.1 0 0.99\n")).pose_at(0.4, max_gap_s=1)
    np.testing.assert_allclose(plus, minus, atol=1e-12)


@pytest.mark.parametrize("time_s", [9.999, 12.001])
def test_nothing_is_extrapolated(tmp_path: Path, time_s: float) -> None:
    trajectory = read_trajectory(file(tmp_path, "10 0 0 0 0 0 0 1\n12 0 0 0 0 0 0 1\n"))
    with pytest.raises(BadInputError) as caught:
        trajectory.pose_at(time_s, max_gap_s=100)
    assert caught.value.kind == "no_pose"


def test_neighbours_too_far_apart_give_no_pose(tmp_path: Path) -> None:
    trajectory = read_trajectory(file(tmp_path, "10 0 0 0 0 0 0 1\n12 0 0 0 0 0 0 1\n"))
    with pytest.raises(BadInputError, match="2 s apart, 1 s are allowed"):
        trajectory.pose_at(11, max_gap_s=1)


def test_an_empty_trajectory_has_no_pose(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        read_trajectory(file(tmp_path, "# nothing\n")).pose_at(0, max_gap_s=1)
    assert caught.value.kind == "no_pose"


@pytest.mark.parametrize(
    "line",
    [
        "2 0 0 0 0 0 0",  # a number short
        "2 0 0 0 0 0 0 1 5",  # one too many
        "2 nan 0 0 0 0 0 1",
        "2 0 0 0 nan 0 0 1",
        "nan 0 0 0 0 0 0 1",
        "2 inf 0 0 0 0 0 1",
        "2 0 0 0 0 0 0 0",  # no rotation
        "2 x 0 0 0 0 0 1",
        "2 1_0 0 0 0 0 0 1",
        "1 0 0 0 0 0 0 1",  # the time of the line before
        "0.5 0 0 0 0 0 0 1",
        "2",
    ],
)
def test_a_line_that_is_no_pose_is_named_by_file_and_number(tmp_path: Path, line: str) -> None:
    path = file(tmp_path, f"# head\n1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(BadInputError, match=r"trajectory\.txt:3: ") as caught:
        read_trajectory(path)
    assert caught.value.kind == "bad_recording"


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.txt"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInputError, match="UTF-8"):
        read_trajectory(path)
