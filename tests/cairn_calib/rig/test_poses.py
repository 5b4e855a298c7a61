"""Rigid transforms: quaternions and back, inverses, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cairn_calib.rig.poses import (
    Transform,
    check_transform,
    inverse,
    look_at,
    quaternion_from_transform,
    quaternions_from_transforms,
    transform_from_quaternion,
    transform_points,
)
from cairn_map.errors import BadInputError

law = settings(max_examples=50, deadline=None, database=None)
part = st.floats(-1, 1)
quaternions = (
    st.tuples(part, part, part, part).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.1)
    | st.sampled_from([np.roll([0.0, 0, 0, 1], n) for n in range(4)])  # half turns: w is 0
).map(lambda q: q / np.linalg.norm(q))
places = st.tuples(*[st.floats(-1e4, 1e4)] * 3)
transforms = st.builds(transform_from_quaternion, places, quaternions)


@law
@given(places, quaternions)
def test_a_quaternion_comes_back_from_its_transform(t: tuple[float, ...], q: np.ndarray) -> None:  # type: ignore[type-arg]
    T = transform_from_quaternion(t, q)
    again = quaternion_from_transform(T)
    assert again[3] >= 0
    assert abs(abs(again @ q) - 1) < 1e-12
    np.testing.assert_allclose(transform_from_quaternion(t, again), T, atol=1e-12)
    assert tuple(T[:3, 3]) == t


@law
@given(st.lists(transforms, max_size=5))
def test_quaternions_of_many_transforms_are_those_of_each_to_the_last_bit(every: list[Transform]) -> None:
    together = quaternions_from_transforms(np.array(every).reshape(-1, 4, 4))
    assert together.tolist() == [quaternion_from_transform(T).tolist() for T in every]


def test_a_quaternion_turns_as_it_says() -> None:
    quarter = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # 90 degrees about z
    T = transform_from_quaternion((1, 2, 3), quarter)
    np.testing.assert_allclose(transform_points(T, np.array([1.0, 0, 0])), [1, 3, 3], atol=1e-12)


@law
@given(transforms)
def test_the_inverse_undoes(T: Transform) -> None:
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(inverse(inverse(T)), T, atol=1e-9)


@law
@given(transforms, transforms)
def test_points_go_through_a_product_as_through_its_factors(T_a_b: Transform, T_b_c: Transform) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (7, 3))
    np.testing.assert_allclose(
        transform_points(T_a_b @ T_b_c, points), transform_points(T_a_b, transform_points(T_b_c, points)), atol=1e-8
    )


def test_a_point_that_is_none_stays_none() -> None:
    assert np.isnan(transform_points(np.eye(4), np.array([np.nan, np.nan, np.nan]))).all()


def test_rounding_in_a_text_file_is_taken_out_of_a_rotation() -> None:
    exact = transform_from_quaternion((1, 2, 3), np.array([0.1, 0.2, 0.3, 0.9]))
    checked = check_transform(exact.round(5))
    np.testing.assert_allclose(checked[:3, :3] @ checked[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(checked, exact, atol=2e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1, -1, 1]),  # a mirror
        np.diag([2.0, 2, 2, 1]),  # a scale
        np.diag([1.0, 1, 1, 2]),
        np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0.01,  # a perspective row
        np.eye(4) + np.diag([0.001, 0, 0], 1),  # a shear
        np.block(
            [[1e200 * np.array([[1.0, -1], [1, 1]]), np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]]
        ),  # inf - inf
    ],
)
def test_what_is_not_rigid_is_refused(wrong: np.ndarray) -> None:  # type: ignore[type-arg]
    with pytest.raises(BadInputError):
        check_transform(wrong)


@pytest.mark.parametrize("wrong", [(0, 0, 0, 0), (0, 0, 0, 2), (0, 0, 1), (np.nan, 0, 0, 1)])
def test_what_is_no_unit_quaternion_is_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(BadInputError):
        transform_from_quaternion((0, 0, 0), wrong)


def test_a_camera_looks_where_it_is_told_with_its_top_up() -> None:
    T = look_at((1, 2, 3), (4, 6, 3))
    np.testing.assert_allclose(transform_points(inverse(T), np.array([4.0, 6, 3])), [0, 0, 5], atol=1e-12)
    above = transform_points(inverse(T), np.array([4.0, 6, 4]))
    assert above[1] < 0  # y is down
    np.testing.assert_allclose(check_transform(T), T, atol=1e-12)
