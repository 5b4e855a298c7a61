"""Epochs of times."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cairn_map.epochs.epoch import BASE, EPOCH_MAX, EPOCH_S_MAX, Epoch, begin_s, check_epoch, epoch_of
from cairn_map.errors import BadInputError


@example(-5e-324, 60)
@example(math.nextafter(7.0 * 86400, 0), 7)
@given(st.floats(-4e9, 4e9), st.integers(1, EPOCH_S_MAX))
def test_a_time_lies_in_its_epoch(time_s: float, epoch_s: int) -> None:
    epoch = epoch_of(time_s, epoch_s)
    assert begin_s(epoch, epoch_s) <= time_s < begin_s(Epoch(epoch + 1), epoch_s)


def test_the_base_is_older_than_every_epoch() -> None:
    assert epoch_of(-1e9, 1) > BASE
    assert begin_s(BASE, 120) == -math.inf


@pytest.mark.parametrize("time_s", [math.nan, math.inf, -math.inf, 1e300, EPOCH_MAX * 2.0])
def test_times_without_an_epoch_are_refused(time_s: float) -> None:
    with pytest.raises(BadInputError, match="epochs of 1 s"):
        epoch_of(time_s, 1)


@pytest.mark.parametrize("number", [EPOCH_MAX + 1, -EPOCH_MAX - 1, 1 << 62, -(1 << 62), BASE + 1])
def test_numbers_of_no_epoch_are_refused(number: int) -> None:
    with pytest.raises(BadInputError, match="an epoch is at most"):
        check_epoch(number)
