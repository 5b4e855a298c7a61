"""Cells that are readings: they give back what they were made of, and nothing is added to them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import random_history
from tests.fixtures.map.made import GEOMETRIES, KEY, SMALL, random_evidence

from cairn_map.codec.cell_code import encode_cell
from cairn_map.epochs.present import present
from cairn_map.errors import BadInputError
from cairn_map.evidence.blocks import blocks_of, of_blocks, without_blocks
from cairn_map.evidence.brick_cell import BrickCell, brick_cell, reading_cell
from cairn_map.evidence.compact_cell import sums_of
from cairn_map.evidence.evidence import Evidence, check_fits
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel

MODEL = SensorModel()


def read(seed: int, geometry: Geometry = SMALL, model: SensorModel = MODEL) -> Evidence:
    """Reading of a random history."""
    return present(random_history(seed, geometry), geometry, model).evidence


@given(st.integers(0, 10**6), st.sampled_from(GEOMETRIES), st.sampled_from([0.3, 0.5, 0.7]))
def test_a_reading_comes_back_from_bricks_with_every_state(seed: int, geometry: Geometry, p_occupied: float) -> None:
    model = SensorModel(p_occupied=p_occupied)
    reading = read(seed, geometry, model)
    packed = reading_cell(geometry, reading, model).packed()
    for name in ("voxels", "counts", "sampled", "samples"):
        assert np.array_equal(getattr(packed, name), getattr(reading, name)), name
    assert np.array_equal(packed.occupied(model), reading.occupied(model))
    np.testing.assert_allclose(packed.log_odds(model), reading.log_odds(model), rtol=0, atol=LOG_ODDS_STEP)
    assert reading_cell(geometry, packed, model).packed() == packed


@given(st.integers(0, 10**6), st.integers(0, 10**6))
def test_a_revised_reading_is_the_one_made_afresh(before: int, after: int) -> None:
    first, then = read(before), read(after)
    cell = reading_cell(SMALL, first, MODEL)
    held = cell.copy()
    # All voxels of both, and by how much they are more than before.
    everywhere = np.arange(8**SMALL.depth, dtype=np.uint32)
    was, now = (brick_cell(SMALL, [without_odds(it)]).of_voxels(everywhere) for it in (first, then))
    samples = np.zeros((len(everywhere), SMALL.plane_count), np.int64)
    samples[now.sampled] += now.samples
    samples[was.sampled] -= was.samples
    odds = np.zeros(len(everywhere))
    odds[then.voxels] = then.log_odds(MODEL)
    cell.revise(Evidence(everywhere, now.counts - was.counts, everywhere, samples, odds))
    assert cell.packed() == reading_cell(SMALL, then, MODEL).packed()
    assert held.packed() == reading_cell(SMALL, first, MODEL).packed()
    assert all(mine is not its for mine, its in zip(sums_of(cell), sums_of(held), strict=True))


def without_odds(reading: Evidence) -> Evidence:
    return Evidence(reading.voxels, reading.counts, reading.sampled, reading.samples)


@given(st.integers(0, 10**6), st.lists(st.integers(0, 8**3 - 1), unique=True))
def test_sums_of_some_voxels_are_those_of_the_cell(seed: int, places: list[int]) -> None:
    evidence = random_evidence(seed, SMALL)
    voxels = np.array(sorted(places), np.uint32)
    found = brick_cell(SMALL, [evidence]).of_voxels(voxels)
    chosen = evidence.where(np.isin(evidence.voxels, voxels))
    has_any = (found.counts != 0).any(axis=1)
    has_any[found.sampled] = True
    assert found.where(has_any) == chosen


def test_a_copy_of_a_reading_is_a_reading_and_shares_its_arrays() -> None:
    cell = reading_cell(SMALL, read(1), MODEL)
    copied = cell.copy()
    assert copied.packed() == cell.packed()
    assert sums_of(copied) == sums_of(cell)
    assert copied.size_bytes == cell.size_bytes == brick_cell(SMALL, [without_odds(read(1))]).size_bytes + 2 * 512


@pytest.mark.parametrize("change", [BrickCell.merge, BrickCell.unmerge])
def test_evidence_is_not_added_to_a_reading(change: object) -> None:
    cell = reading_cell(SMALL, read(2), MODEL)
    with pytest.raises(BadInputError, match="not to a reading") as refused:
        change(cell, random_evidence(3, SMALL))  # type: ignore[operator]
    assert refused.value.kind == "bad_evidence"
    assert cell.packed() == reading_cell(SMALL, read(2), MODEL).packed()


def test_a_reading_is_neither_added_nor_encoded() -> None:
    for refuse in (
        lambda: check_fits(read(2), SMALL),
        lambda: brick_cell(SMALL, [read(2)]),
        lambda: encode_cell(KEY, read(2), SMALL),
    ):
        with pytest.raises(BadInputError, match="got a reading"):
            refuse()


def test_sums_are_not_revised_and_no_reading_without_log_odds() -> None:
    for cell, change in ((BrickCell(SMALL), read(1)), (reading_cell(SMALL, read(1), MODEL), without_odds(read(1)))):
        with pytest.raises(BadInputError, match="only a reading is revised"):
            cell.revise(change)


def test_log_odds_must_fit_the_voxels_and_tell_readings_apart() -> None:
    reading = read(4)
    with pytest.raises(BadInputError, match="odds must be"):
        Evidence(reading.voxels, reading.counts, reading.sampled, reading.samples, np.zeros(len(reading) + 1))
    odds = reading.log_odds(MODEL) + 1
    assert reading != Evidence(reading.voxels, reading.counts, reading.sampled, reading.samples, odds)
    assert reading != without_odds(reading) != reading
    assert reading.size_bytes == without_odds(reading).size_bytes + 8 * len(reading)


def test_parts_of_a_reading_are_readings() -> None:
    reading = read(5)
    blocks = blocks_of(reading)[::2]
    for part in (of_blocks(reading, blocks), without_blocks(reading, blocks)):
        rows = np.searchsorted(reading.voxels, part.voxels)
        assert np.array_equal(part.log_odds(MODEL), reading.log_odds(MODEL)[rows])
