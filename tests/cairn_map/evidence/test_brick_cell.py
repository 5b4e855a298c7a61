"""The law: merging is integer addition, in any order, and nothing else."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.lengths import length
from tests.fixtures.map.made import DOSE, GEOMETRIES, KEY, MIDDLE, PLAIN, SMALL, any_evidence, as_dict, random_evidence
from tests.naive import evidence as naive_evidence

from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell, brick_cell, difference, sum_evidence
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX, Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Geometry

TWO_CHANNELS = Geometry(voxel_edge_um=50_000, depth=4, channels=(TEMPERATURE, DOSE))
"""Eight bricks."""
SIGNED = any_evidence(SMALL, low=-(1 << 60), high=1 << 60)
SMALL_DIFFS = any_evidence(SMALL, high=1 << 20)


def one_voxel(hits: int, *sums: int, geometry: Geometry = SMALL, place: int = 3) -> Evidence:
    samples = np.zeros((1, geometry.plane_count), np.int64)
    samples[0, : len(sums)] = sums
    return packed_evidence(np.array([place], np.uint32), np.array([[hits, 0]]), samples, geometry)


def voxels_as_given(voxels: list[int], *, sampled: list[int] | None = None) -> Evidence:
    rows = np.array(sampled or [], np.uint32)
    samples = np.ones((len(rows), SMALL.plane_count), np.int64)
    return Evidence(np.array(voxels, np.uint32), np.ones((len(voxels), 2), np.int32), rows, samples)


def edges(limit: int) -> st.SearchStrategy[int]:
    """Numbers next to those where 15, 16, 31 and 62 bits end, of either sign, within a limit."""
    tops = [1 << bits for bits in (0, 14, 15, 16, 30, 31, 61, 62)]
    near = sorted({sign * (top + step) for top in tops for sign in (1, -1) for step in (-1, 0, 1)})
    return st.sampled_from([number for number in near if abs(number) <= limit])


@st.composite
def edge_evidence(draw: st.DrawFn) -> Evidence:
    """One voxel with samples, one without, and perhaps a brick of voxels all alike."""
    geometry, counts, sums = TWO_CHANNELS, edges(COUNT_MAX), edges(SUM_MAX)
    voxels = {1: (draw(counts), draw(counts)), draw(st.sampled_from([2, 600])): (draw(counts), 0)}
    voxels |= dict.fromkeys(range(1024, 1536), (draw(counts), 0)) if draw(st.booleans()) else {}
    samples = np.zeros((len(voxels), geometry.plane_count), np.int64)
    samples[draw(st.integers(0, 1))] = [draw(sums) for _ in range(geometry.plane_count)]
    return packed_evidence(np.array(list(voxels), np.uint32), np.array(list(voxels.values())), samples, geometry)


@given(st.lists(edge_evidence(), max_size=2), edge_evidence(), st.booleans())
def test_a_copy_and_its_cell_do_not_see_what_the_other_merges(
    before: list[Evidence], diff: Evidence, into_copy: bool
) -> None:
    cell = BrickCell(TWO_CHANNELS)
    with suppress(BadInputError):
        for evidence in before:
            cell.merge(evidence)
    copied, held = cell.copy(), cell.packed()
    assert copied.packed() == held
    changed, other = (copied, cell) if into_copy else (cell, copied)
    alone = brick_cell(TWO_CHANNELS, [held])
    with suppress(BadInputError):
        changed.merge(diff)
    with suppress(BadInputError):
        alone.merge(diff)
    assert other.packed() == held
    assert changed.packed() == alone.packed()
    with suppress(BadInputError):
        other.merge(diff)
    assert other.packed() == alone.packed()


@given(st.lists(st.tuples(edge_evidence(), st.sampled_from([1, -1])), min_size=1, max_size=6))
def test_numbers_of_any_size_are_summed_or_refused_as_the_twin_says(steps: list[tuple[Evidence, int]]) -> None:
    cell, total = BrickCell(TWO_CHANNELS), naive_evidence.Evidence()
    for diff, sign in steps:
        expected = naive_evidence.merged(total, as_dict(diff), sign=sign)
        change = cell.merge if sign == 1 else cell.unmerge
        if naive_evidence.fits(expected):
            change(diff)
            total = expected
        else:
            with pytest.raises(BadInputError) as refused:
                change(diff)
            assert refused.value.kind == "evidence_overflow"
        assert as_dict(cell.packed()) == total


@pytest.mark.slow
@settings(max_examples=length(25, long=50))
@given(st.lists(st.tuples(st.integers(0, 1000), st.sampled_from([1, -1])), max_size=5))
def test_bricks_and_runs_and_rows_are_summed_as_the_twin_says(steps: list[tuple[int, int]]) -> None:
    cell, total = BrickCell(MIDDLE), naive_evidence.Evidence()
    for seed, sign in steps:
        diff = random_evidence(seed, MIDDLE, voxels=400, air=4)
        (cell.merge if sign == 1 else cell.unmerge)(diff)
        total = naive_evidence.merged(total, as_dict(diff), sign=sign)
    assert as_dict(cell.packed()) == total


@pytest.mark.parametrize(("count", "bits"), [(1 << 14, 16), (1 << 15, 32), (COUNT_MAX, 32)])
def test_counts_take_the_bits_that_they_need(count: int, bits: int) -> None:
    empty, cell = BrickCell(PLAIN), brick_cell(PLAIN, [one_voxel(count - 1, geometry=PLAIN)])
    cell.merge(one_voxel(1, geometry=PLAIN))
    assert cell.size_bytes - empty.size_bytes == 512 * 2 * bits // 8


@pytest.mark.parametrize(("sums", "wide"), [((1 << 30, 5), 0), ((1 << 31, 5), 1), ((5, SUM_MAX, 1 << 40), 2)])
def test_planes_take_the_bits_that_they_need(sums: tuple[int, ...], wide: int) -> None:
    without, cell = brick_cell(SMALL, [one_voxel(1)]), brick_cell(SMALL, [one_voxel(1)])
    cell.merge(one_voxel(0, *sums))
    assert cell.size_bytes - without.size_bytes == 4 + 4 + 4 * SMALL.plane_count + 8 * wide


@given(SIGNED, SIGNED)
def test_merging_is_what_its_twin_says(a: Evidence, b: Evidence) -> None:
    expected = naive_evidence.merged(as_dict(a), as_dict(b))
    if all(abs(hits) <= COUNT_MAX and abs(misses) <= COUNT_MAX for hits, misses, _ in expected.values()):
        assert as_dict(sum_evidence([a, b], SMALL)) == expected


@given(SIGNED, SIGNED)
def test_differences_are_what_their_twin_says(a: Evidence, b: Evidence) -> None:
    expected = naive_evidence.merged(as_dict(a), as_dict(b), sign=-1)
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


def test_arrays_may_lie_in_memory_as_they_like() -> None:
    diff = random_evidence(4, MIDDLE)
    columns = Evidence(
        np.repeat(diff.voxels, 2)[::2],
        np.asfortranarray(diff.counts),
        np.repeat(diff.sampled, 2)[::2],
        np.asfortranarray(diff.samples),
    )
    assert sum_evidence([columns, diff], MIDDLE) == sum_evidence([diff, diff], MIDDLE)


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
        voxels_as_given([600, 3]),
        voxels_as_given([3, 3]),
        voxels_as_given([3, 4], sampled=[1, 0]),
    ],
    ids=[
        "voxels outside the cell",
        "other planes",
        "samples without a voxel",
        "voxels that fall, from outside",
        "a voxel twice",
        "samples that fall",
    ],
)
def test_evidence_of_another_geometry_never_reaches_the_kernels(stranger: Evidence) -> None:
    cell = brick_cell(SMALL, [one_voxel(1)])
    for change in (cell.merge, cell.unmerge):
        with pytest.raises(BadInputError) as refused:
            change(stranger)
        assert refused.value.kind == "bad_evidence"
    assert cell.packed() == one_voxel(1)
