"""Rotation vectors against the power series that define them: of any length, and near where formulas break."""

from math import factorial, pi

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.pose_vectors import (
    SERIES_BELOW_RAD,
    cross_matrix,
    left_jacobian,
    moved_points,
    rotation_from_vector,
    transform_from_vector,
    vector_from_transform,
)

Floats = npt.NDArray[np.float64]
law = settings(max_examples=60, deadline=None, database=None)
directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda d: np.linalg.norm(d) > 0.1)
lengths = st.floats(0, 3.1) | st.sampled_from(
    [0.0, 1e-300, 1e-9, SERIES_BELOW_RAD * (1 - 1e-9), SERIES_BELOW_RAD, SERIES_BELOW_RAD * (1 + 1e-9), pi - 1e-6]
)
vectors = st.builds(lambda d, w: w * d / np.linalg.norm(d), directions, lengths)


def series(r: Floats, *, first: int) -> Floats:
    """The slow twin: sum of [r]^n / (n + first)!, which is exp for `first` = 0 and the left Jacobian for 1."""
    total, power = np.zeros((3, 3)), np.eye(3)
    for n in range(60):
        total += power / float(factorial(n + first))
        power = power @ cross_matrix(r)
    return total


@law
@given(vectors)
def test_rotations_and_their_jacobians_are_the_sums_of_their_series(r: Floats) -> None:
    np.testing.assert_allclose(rotation_from_vector(r), series(r, first=0), rtol=0, atol=1e-13)
    np.testing.assert_allclose(left_jacobian(r), series(r, first=1), rtol=0, atol=1e-13)


@law
@given(vectors)
def test_a_rotation_is_orthonormal_undone_by_its_negative_and_leaves_its_axis_alone(r: Floats) -> None:
    R = rotation_from_vector(r)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R @ rotation_from_vector(-r), np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R @ r, r, atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1)


@law
@given(vectors)
def test_the_jacobian_of_the_other_side_differs_by_the_rotation(r: Floats) -> None:
    # J_l(r) = exp(r) J_l(-r), for J_l(-r) is the right Jacobian.
    np.testing.assert_allclose(left_jacobian(r), rotation_from_vector(r) @ left_jacobian(-r), atol=1e-13)


@law
@given(vectors, directions)
def test_a_small_change_turns_the_frame_by_the_jacobian(r: Floats, change: Floats) -> None:
    h = 1e-6
    ahead, behind = (rotation_from_vector(r + sign * h * change) for sign in (1, -1))
    turned = (ahead - behind) / (2 * h) @ rotation_from_vector(r).T
    np.testing.assert_allclose(turned, cross_matrix(left_jacobian(r) @ change), atol=1e-8)


@law
@given(vectors, st.tuples(*[st.floats(-10, 10)] * 3))
def test_a_vector_comes_back_from_its_transform(r: Floats, t: tuple[float, ...]) -> None:
    v = np.array([*r, *t])
    again = vector_from_transform(transform_from_vector(v))
    assert np.linalg.norm(again[:3]) <= pi + 1e-12
    # Near half a turn the quaternion's w goes to 0, and with it digits of the angle.
    np.testing.assert_allclose(again, v, atol=1e-9)


@pytest.mark.parametrize("axis", [*np.eye(3).tolist(), [0.6, 0.0, -0.8]])
def test_half_a_turn_has_one_of_its_two_vectors(axis: list[float]) -> None:
    T = transform_from_vector([*(pi * np.array(axis)), 0, 0, 0])
    v = vector_from_transform(T)
    assert np.linalg.norm(v[:3]) == pytest.approx(pi)
    np.testing.assert_allclose(transform_from_vector(v), T, atol=1e-12)


@law
@given(vectors)
def test_a_turn_more_is_the_same_rotation_with_a_shorter_vector(r: Floats) -> None:
    length = float(np.linalg.norm(r))
    if length < 0.1:
        return
    T = transform_from_vector([*(r * (1 + 2 * pi / length)), 0, 0, 0])
    np.testing.assert_allclose(vector_from_transform(T)[:3], r, atol=1e-9)


def test_many_poses_move_many_points_as_each_moves_its_own() -> None:
    rng = np.random.default_rng(4)
    poses, points = rng.normal(size=(3, 6)), rng.normal(size=(3, 5, 3))
    moved, by_pose = moved_points(poses, points)
    assert moved.shape == (3, 5, 3) and by_pose.shape == (3, 5, 3, 6)
    for n in range(3):
        T = transform_from_vector(poses[n])
        np.testing.assert_allclose(moved[n], points[n] @ T[:3, :3].T + T[:3, 3], atol=1e-12)
        np.testing.assert_array_equal(by_pose[n], moved_points(poses[n], points[n])[1])
