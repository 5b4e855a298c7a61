"""Packed evidence has one form only."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import MIDDLE, PLAIN, SMALL, as_dict, random_evidence

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import (
    COUNT_MAX,
    SUM_MAX,
    Evidence,
    empty_evidence,
    every_sum_has_weight,
    largest,
    packed_evidence,
)
from cairn_map.evidence.evidence_kernels import bounds_of_counts, channel_above, sums_without_weight

I64_MIN = -(1 << 63)


def packed(places: list[int], counts: list[list[int]], samples: list[list[int]]) -> Evidence:
    width = SMALL.plane_count
    rows = np.array([row + [0] * (width - len(row)) for row in samples], np.int64).reshape(-1, width)
    return packed_evidence(np.array(places, np.int64), np.array(counts, np.int64).reshape(-1, 2), rows, SMALL)


@given(st.permutations(range(5)))
def test_the_order_of_rows_does_not_matter(order: list[int]) -> None:
    places, counts, samples = [9, 3, 5, 1, 7], [[1, 0], [0, 0], [0, 2], [0, 0], [3, 3]], [[], [], [], [4], [5]]
    one = packed([places[n] for n in order], [counts[n] for n in order], [samples[n] for n in order])
    assert one == packed(places, counts, samples)
    assert one.voxels.tolist() == [1, 5, 7, 9]
    assert one.sampled.tolist() == [0, 2]


def test_zeros_are_left_out() -> None:
    assert packed([4, 5], [[0, 0], [0, 0]], [[], []]) == empty_evidence(SMALL)


@pytest.mark.parametrize("places", [[3, 3], [0, 512], [-1, 2]])
def test_places_twice_or_outside_the_cell_are_refused(places: list[int]) -> None:
    with pytest.raises(BadInputError, match="places must be different"):
        packed(places, [[1, 0], [1, 0]], [[], []])


@pytest.mark.parametrize("count", [COUNT_MAX + 1, -COUNT_MAX - 1, I64_MIN])
def test_counts_beyond_their_range_are_refused(count: int) -> None:
    with pytest.raises(BadInputError, match="counts are at most"):
        packed([0], [[count, 0]], [[]])


@pytest.mark.parametrize("value", [SUM_MAX + 1, -SUM_MAX - 1, I64_MIN])
def test_sums_beyond_their_range_are_refused(value: int) -> None:
    with pytest.raises(BadInputError, match="sums at most"):
        packed([0], [[0, 0]], [[value]])


def test_arrays_of_other_shapes_are_refused() -> None:
    with pytest.raises(BadInputError, match="expected counts"):
        packed_evidence(np.zeros(2, np.uint32), np.zeros((2, 2), np.int64), np.zeros((2, 1), np.int64), PLAIN)


@pytest.mark.parametrize(
    ("voxels", "counts", "sampled", "samples"),
    [
        (np.zeros(1, np.int64), np.zeros((1, 2), np.int32), np.zeros(0, np.uint32), np.zeros((0, 3), np.int64)),
        (np.zeros(1, np.uint32), np.zeros((2, 2), np.int32), np.zeros(0, np.uint32), np.zeros((0, 3), np.int64)),
        (np.zeros(1, np.uint32), np.zeros((1, 2), np.int32), np.zeros(1, np.uint32), np.zeros((0, 3), np.int64)),
        (np.zeros(1, np.uint32), np.zeros((1, 2), np.int32), np.zeros(0, np.uint32), np.zeros(0, np.int64)),
    ],
    ids=["dtype", "counts", "samples", "dimensions"],
)
def test_evidence_of_arrays_that_do_not_fit_cannot_exist(voxels, counts, sampled, samples) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadInputError, match="arrays do not fit"):
        Evidence(voxels, counts, sampled, samples)


def test_equal_evidence_has_equal_hashes() -> None:
    one, other = random_evidence(1, SMALL), random_evidence(1, SMALL)
    assert one == other
    assert hash(one) == hash(other)
    assert one != random_evidence(2, SMALL)
    assert one != "evidence"


def test_largest_is_the_largest_of_each_plane() -> None:
    evidence = packed([1, 2], [[5, 1], [2, 9]], [[7, 1], [3, 8]])
    assert largest(evidence.counts, evidence.samples).tolist() == [5, 9, 7, 8] + [0] * (SMALL.plane_count - 2)
    nothing = empty_evidence(SMALL)
    assert not largest(nothing.counts, nothing.samples).any()


def test_a_sum_without_weight_is_noticed() -> None:
    assert every_sum_has_weight(random_evidence(1, SMALL).samples, SMALL)
    assert every_sum_has_weight(packed([0], [[0, 0]], [[9, 9, 9, 1]]).samples, SMALL)
    assert not every_sum_has_weight(packed([0], [[0, 0]], [[9, 9, 9, 0]]).samples, SMALL)


def test_size_is_that_of_the_arrays() -> None:
    evidence = random_evidence(1, SMALL)
    assert evidence.size_bytes == 12 * len(evidence) + (4 + 8 * SMALL.plane_count) * len(evidence.sampled)
    assert len(as_dict(evidence)) == len(evidence)


def test_bricks_are_counted_once() -> None:
    for seed in range(5):
        evidence = random_evidence(seed, MIDDLE)
        assert evidence.brick_count == len({place // 512 for place in as_dict(evidence)})
    assert empty_evidence(MIDDLE).brick_count == 0


@given(st.integers(0, 2**32 - 1), st.integers(0, 6))
def test_bounds_of_counts_are_those_of_every_row(seed: int, rows: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.choice([-COUNT_MAX, -1, 0, 1, 7, COUNT_MAX], (rows, 2)).astype(np.int32)
    pairs = [(int(hits), int(misses)) for hits, misses in counts]
    assert bounds_of_counts(counts) == (
        min([0, *(n for pair in pairs for n in pair)]),
        max([0, *(hits for hits, _ in pairs)]),
        max([0, *(misses for _, misses in pairs)]),
        max([0, *(sum(pair) for pair in pairs)]),
    )


SPEC = np.array([[2, 0, 0], [3, 1, 0]])
SPEC_OF_CLASSES = np.array([[2, 0, 0], [3, 0, 1]])
"""Two channels: a sum and a weight; a sum, a square sum and a weight."""


@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_a_sum_without_weight_is_found_in_any_row(seed: int, rows: int) -> None:
    samples = np.random.default_rng(seed).choice([0, 0, 1, -1, 1 << 62], (rows, 5), p=[0.4, 0.3, 0.1, 0.1, 0.1])
    expected = any((w == 0 and s != 0) or (v == 0 and (t or q)) for s, w, t, q, v in samples.tolist())
    assert sums_without_weight(samples, SPEC) == expected
    # Of classes the votes for the named ones are no more than all.
    more = any((v == 0 and (t or q)) or (v != 0 and (t > v or t + q > v)) for _, _, t, q, v in samples.tolist())
    first = any(w == 0 and s != 0 for s, w, *_ in samples.tolist())
    assert sums_without_weight(samples, SPEC_OF_CLASSES) == (first or more)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_largest_of_samples_is_that_of_every_row(seed: int, rows: int) -> None:
    samples = np.random.default_rng(seed).choice([0, 1, 7, 1 << 62], (rows, 5))
    assert largest(np.zeros((0, 2), np.int32), samples).tolist() == [0, 0, *samples.max(axis=0, initial=0).tolist()]


@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_a_mean_beyond_the_limit_is_found_in_any_row(seed: int, rows: int) -> None:
    samples = np.random.default_rng(seed).choice([0, 1, 10, 11, 100, 101], (rows, 5), p=[0.1, 0.5, 0.1, 0.1, 0.1, 0.1])
    above = [[s > 10 * w, t > 10 * v or q > 100 * v] for s, w, t, q, v in samples.tolist()]
    expected = next((c for c in range(2) if any(row[c] for row in above)), -1)
    assert channel_above(samples, SPEC, 10) == expected
