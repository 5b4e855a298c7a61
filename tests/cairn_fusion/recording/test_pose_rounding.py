"""Poses as people publish them: rotations and quaternions off by rounding are made exact and told, others refused."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_calib.rig.poses import Transform, rotation_deviation, transform_from_quaternion
from cairn_fusion.recording.pose_rounding import EXACT, ROUNDED, PoseRounding
from cairn_map.errors import BadInputError

PARTS = st.floats(-1, 1)
QUATERNIONS = st.tuples(PARTS, PARTS, PARTS, PARTS).map(np.array).filter(lambda q: bool(np.linalg.norm(q) > 0.1))


def turned(q: np.ndarray) -> Transform:  # type: ignore[type-arg]
    return transform_from_quaternion((1, -2, 3), q / np.linalg.norm(q))


@given(QUATERNIONS, st.integers(3, 9))
def test_a_matrix_rounded_to_three_digits_or_more_gives_the_rotation_that_was_meant(
    q: np.ndarray,  # type: ignore[type-arg]
    digits: int,
) -> None:
    """The result is a rotation to float precision, no further from the true one than the rounding itself."""
    T, rounding = turned(q), PoseRounding()
    found = rounding.transform(np.round(T, digits), name="pose 7")
    assert rotation_deviation(found[:3, :3]) < 1e-12
    assert np.abs(found - T).max() < 3 * 10.0**-digits
    assert (rounding.poses, rounding.rounded) == (1, int(rounding.largest > EXACT))


@given(QUATERNIONS, st.floats(1 - ROUNDED / 2, 1 + ROUNDED / 2))
def test_a_quaternion_that_is_nearly_of_length_1_is_noted(q: np.ndarray, length: float) -> None:  # type: ignore[type-arg]
    rounding = PoseRounding()
    rounding.check_quaternion(q / np.linalg.norm(q) * length, name="t.txt:3")
    assert rounding.largest == pytest.approx(abs(length - 1), abs=1e-12)


@pytest.mark.parametrize(
    "R",
    [1.01 * np.eye(3), np.diag([1.0, 1, -1]), np.eye(3) + 0.02 * np.eye(3)[[1, 0, 2]], np.zeros((3, 3))],
    ids=["scale", "mirror", "shear", "zero"],
)
def test_what_no_rounding_explains_is_refused_with_its_place(R: np.ndarray) -> None:  # type: ignore[type-arg]
    T = np.eye(4)
    T[:3, :3] = R
    with pytest.raises(BadInputError, match=r"frame-7\.txt"):
        PoseRounding().transform(T, name="frame-7.txt")


@pytest.mark.parametrize("length", [0.0, 0.5, 0.98, 1.02, 1.5, np.inf, np.nan])
def test_a_quaternion_of_another_length_is_refused_with_its_place(length: float) -> None:
    with pytest.raises(BadInputError, match=re.escape("poses.txt:12: a quaternion has length 1")):
        PoseRounding().check_quaternion(np.array([0.0, 0.0, 0.0, length]), name="poses.txt:12")


def test_the_largest_change_is_told_with_its_place_and_exact_poses_are_not() -> None:
    rounding = PoseRounding()
    for n, scale in enumerate((1.0, 1 + 1e-8, 1.0004, 1.0001)):
        T = np.eye(4)
        T[:3, :3] *= scale
        rounding.transform(T, name=f"frame-{n}")
        assert (rounding.text() is None) == (n < 2)
    text = rounding.text()
    assert text is not None
    assert text.startswith("2 of 4 poses were no exact rotations")
    assert text.endswith("off by 8.0e-04 at most, in frame-2")
