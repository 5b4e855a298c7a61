"""The law: merging is integer addition, in any order, and nothing else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests import naive
from tests.cairn_map.made import GEOMETRIES, KEY, MIDDLE, SMALL, any_evidence, as_dict, random_evidence

from cairn_map.brick_cell import BrickCell, brick_cell, difference, sum_evidence
from cairn_map.cell_code import encode_cell
from cairn_map.errors import BadInputError
from cairn_map.evidence import COUNT_MAX, SUM_MAX, Evidence, empty_evidence, packed_evidence
from cairn_map.fingerprint import fingerprint
from cairn_map.grid import Geometry

SIGNED = any_evidence(SMALL, low=-(1 << 60), high=1 << 60)
SMALL_DIFFS = any_evidence(SMALL, high=1 << 20)


def one_voxel(hits: int, *sums: int, geometry: Geometry = SMALL, place: int = 3) -> Evidence:
    samples = np.zeros((1, geometry.plane_count), np.int64)
    samples[0, : len(sums)] = sums
    return packed_evidence(np.array([place], np.uint32), np.array([[hits, 0]]), samples, geometry)


@given(SIGNED, SIGNED)
def test_merging_is_what_its_twin_says(a: Evidence, b: Evidence) -> None:
    expected = naive.merged(as_dict(a), as_dict(b))
    if all(abs(hits) <= COUNT_MAX and abs(misses) <= COUNT_MAX for hits, misses, _ in expected.values()):
        assert as_dict(sum_evidence([a, b], SMALL)) == expected


@given(SIGNED, SIGNED)
def test_differences_are_what_their_twin_says(a: Evidence, b: Evidence) -> None:
    expected = naive.merged(as_dict(a), as_dict(b), sign=-1)
    if all(abs(hits) <= COUNT_MAX and abs(misses) <= COUNT_MAX for hits, misses, _ in expected.values()):
        assert as_dict(difference(a, b, SMALL)) == expected


@given(st.lists(st.integers(0, 1000), max_size=6), st.randoms(), st.sampled_from(GEOMETRIES))
def test_every_order_and_grouping_gives_the_same_bytes(seeds: list[int], random: object, geometry: Geometry) -> None:
    diffs = [random_evidence(seed, geometry) for seed in seeds]
    shuffled = diffs.copy()
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    middle = len(diffs) // 2
    groups = [sum_evidence(shuffled[:middle], geometry), sum_evidence(shuffled[middle:], geometry)]
    sums = [sum_evidence(diffs, geometry), sum_evidence(shuffled, geometry), sum_evidence(groups, geometry)]
    assert len({encode_cell(KEY, total, geometry).data for total in sums}) == 1
    assert len({fingerprint(total, KEY) for total in sums}) == 1


@given(st.integers(0, 1000), st.integers(0, 1000), st.integers(0, 1000))
def test_merging_is_associative(a: int, b: int, c: int) -> None:
    x, y, z = (random_evidence(seed, MIDDLE) for seed in (a, b, c))
    left = sum_evidence([sum_evidence([x, y], MIDDLE), z], MIDDLE)
    assert left == sum_evidence([x, sum_evidence([y, z], MIDDLE)], MIDDLE)


@given(SIGNED)
def test_no_evidence_is_the_zero_of_merging(a: Evidence) -> None:
    assert sum_evidence([a, empty_evidence(SMALL)], SMALL) == a == sum_evidence([empty_evidence(SMALL), a], SMALL)


@given(st.lists(SMALL_DIFFS, max_size=3), SMALL_DIFFS, st.lists(SMALL_DIFFS, max_size=2))
def test_unmerging_undoes_a_merge_whatever_came_between(
    before: list[Evidence], target: Evidence, after: list[Evidence]
) -> None:
    try:
        cell = brick_cell(SMALL, [*before, target, *after])
        cell.unmerge(target)
    except BadInputError:
        return  # counts of up to 2^31 - 1 need not fit twice
    assert cell.packed() == sum_evidence([*before, *after], SMALL)


def test_what_is_taken_out_may_come_later() -> None:
    cell = BrickCell(MIDDLE)
    diff = random_evidence(1, MIDDLE)
    cell.unmerge(diff)
    assert cell.packed().is_signed
    cell.merge(diff)
    assert len(cell.packed()) == 0


def test_merging_changes_no_argument() -> None:
    diff = random_evidence(2, MIDDLE)
    copy = Evidence(diff.voxels.copy(), diff.counts.copy(), diff.sampled.copy(), diff.samples.copy())
    brick_cell(MIDDLE, [diff, diff]).unmerge(diff)
    assert diff == copy


@pytest.mark.parametrize("diff", [one_voxel(1), one_voxel(0, 1), one_voxel(0, 0, 0, 0, SUM_MAX)])
def test_a_sum_that_would_overflow_is_refused_and_nothing_changes(diff: Evidence) -> None:
    full = one_voxel(COUNT_MAX, *[SUM_MAX] * SMALL.plane_count)
    cell = brick_cell(SMALL, [full, random_evidence(3, SMALL, voxels=0)])
    before = cell.packed()
    late = sum_evidence([one_voxel(1, place=100), one_voxel(0, 7, place=101), diff], SMALL)
    with pytest.raises(BadInputError) as refused:
        cell.merge(late)
    assert refused.value.kind == "evidence_overflow"
    assert cell.packed() == before


def test_a_sum_that_would_overflow_downwards_is_refused_and_nothing_changes() -> None:
    cell = BrickCell(SMALL)
    cell.unmerge(one_voxel(COUNT_MAX, SUM_MAX))
    before = cell.packed()
    for diff in (one_voxel(1), one_voxel(0, SUM_MAX)):
        with pytest.raises(BadInputError):
            cell.unmerge(diff)
    assert cell.packed() == before


@pytest.mark.parametrize(
    "stranger",
    [
        one_voxel(1, geometry=Geometry(depth=8, channels=SMALL.channels), place=8**8 - 1),
        one_voxel(1, geometry=MIDDLE, place=4),
        Evidence(
            np.zeros(1, np.uint32),
            np.ones((1, 2), np.int32),
            np.array([1], np.uint32),
            np.ones((1, SMALL.plane_count), np.int64),
        ),
    ],
    ids=["voxels outside the cell", "other planes", "samples without a voxel"],
)
def test_evidence_of_another_geometry_never_reaches_the_kernels(stranger: Evidence) -> None:
    cell = brick_cell(SMALL, [one_voxel(1)])
    for change in (cell.merge, cell.unmerge):
        with pytest.raises(BadInputError) as refused:
            change(stranger)
        assert refused.value.kind == "bad_evidence"
    assert cell.packed() == one_voxel(1)
