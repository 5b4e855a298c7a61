"""The law: samples separated by channel and joined again are the same, and no other sums come out of it."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL

from cairn_map.codec.octree.channel_streams import ChannelRows, join_samples, split_samples
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import SUM_MAX

LEAVES = 20
Ints = npt.NDArray[np.int64]


def rows_of(leaves: list[int], sums: list[list[int]]) -> ChannelRows:
    return ChannelRows(np.array(leaves, np.int64), np.array(sums, np.int64).reshape(len(leaves), -1))


def joined(dose: ChannelRows, *, signed: bool = False) -> tuple[Ints, Ints]:
    """With other channels, all of which have something to say of leaf 3."""
    others = [rows_of([3], [[7] * len(channel.planes)]) for channel in SMALL.channels[:-1]]
    return join_samples([*others, dose], SMALL, leaves=LEAVES, signed=signed, sampled_max=LEAVES)


@given(st.sets(st.tuples(st.integers(0, LEAVES - 1), st.integers(0, len(SMALL.channels) - 1))), st.integers(0, 99))
def test_joining_undoes_splitting(said: set[tuple[int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    dense = np.zeros((LEAVES, SMALL.plane_count), np.int64)
    for leaf, c in said:
        planes = SMALL.planes_of(SMALL.channels[c].name)
        dense[leaf, planes] = rng.integers(1, 99, len(range(SMALL.plane_count)[planes]))
    sampled = np.nonzero(dense.any(axis=1))[0]
    channels = split_samples(sampled, dense[sampled], SMALL)
    found, samples = join_samples(channels, SMALL, leaves=LEAVES, signed=False, sampled_max=LEAVES)
    assert np.array_equal(found, sampled)
    assert np.array_equal(samples, dense[sampled])


def test_a_channel_joins_others_at_its_own_leaves() -> None:
    sampled, samples = joined(rows_of([1, 3, 9], [[5, 1], [6, 2], [0, 3]]))
    assert sampled.tolist() == [1, 3, 9]
    assert samples[:, SMALL.planes_of("dose")].tolist() == [[5, 1], [6, 2], [0, 3]]
    assert samples[[0, 2]].sum() == 9


@pytest.mark.parametrize("at", [0, 1, 2])
@pytest.mark.parametrize("sums", [[0, 0], [-1, 1], [1, -1], [SUM_MAX + 1, 1], [1, SUM_MAX + 1]])
def test_a_sum_that_cannot_be_is_refused_wherever_it_stands(sums: list[int], at: int) -> None:
    rows = [[1, 1], [1, 1], [1, 1]]
    rows[at] = sums
    with pytest.raises(DamagedDataError) as refused:
        joined(rows_of([1, 3, 9], rows))
    assert refused.value.kind == "bad_stream"
    assert "dose" in str(refused.value)


@pytest.mark.parametrize("sums", [[-1, 0], [0, -SUM_MAX], [SUM_MAX, -1]])
def test_differences_may_be_negative(sums: list[int]) -> None:
    _, samples = joined(rows_of([1], [sums]), signed=True)
    assert samples[0, SMALL.planes_of("dose")].tolist() == sums


def test_differences_have_their_range_too() -> None:
    with pytest.raises(DamagedDataError):
        joined(rows_of([1], [[-SUM_MAX - 1, 1]]), signed=True)
