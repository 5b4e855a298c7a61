"""The reading of a history: what it forgets, what it keeps, and that no order of arrival matters."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import HISTORIES, as_naive, random_history
from tests.fixtures.map.made import SMALL, random_evidence
from tests.naive import history as naive_history

from cairn_map.epochs.cell_history import CellHistory, cell_history, merged
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.present import Present, present
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds

MODEL = SensorModel()
HIT, MISS, LOW, HIGH = (log_odds(p) for p in (MODEL.p_hit, MODEL.p_miss, MODEL.p_min, MODEL.p_max))
PLACE = 7
LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=3, channels=(HEIGHT_OFFSET,))
COLOUR, INTENSITY, TEMPERATURE, DOSE = (SMALL.planes_of(channel.name) for channel in SMALL.channels)
"""Columns of the channels of `SMALL`."""


def seen(hits: int, misses: int) -> Evidence:
    """One voxel's counts."""
    return packed_evidence(
        np.array([PLACE], np.uint32), np.array([[hits, misses]]), np.zeros((1, SMALL.plane_count), np.int64), SMALL
    )


def warm(samples: int, kelvin: float, *, hits: int = 1, misses: int = 0) -> Evidence:
    """One voxel with samples of one temperature."""
    value = round(kelvin / 0.05)
    row = np.zeros((1, SMALL.plane_count), np.int64)
    row[0, TEMPERATURE] = [value * samples, value**2 * samples, samples]
    return packed_evidence(np.array([PLACE], np.uint32), np.array([[hits, misses]]), row, SMALL)


def read(rows: dict[int, Evidence], *, at: int | None = None) -> Present:
    history = cell_history({Epoch(epoch): row for epoch, row in rows.items()})
    return present(history, SMALL, MODEL, at=None if at is None else Epoch(at))


def kelvin(reading: Present) -> tuple[float, int]:
    """Temperature and count of samples that the voxel shows."""
    total, _, weight = reading.samples[0, TEMPERATURE]
    return total / weight * 0.05, int(weight)


@given(HISTORIES)
def test_every_voxel_reads_as_the_twin_says(history: CellHistory) -> None:
    reading, naive = present(history, SMALL, MODEL), as_naive(history)
    assert reading.voxels.tolist() == sorted(naive_history.total(naive))
    for place, odds, known in zip(reading.voxels.tolist(), reading.log_odds, reading.known, strict=True):
        expected = naive_history.log_odds(naive, place, (HIT, MISS, LOW, HIGH))
        assert odds == (expected or 0.0)
        assert known == (expected is not None)


@given(st.integers(0, 10**6), st.sampled_from([BASE, Epoch(5)]))
def test_a_history_of_one_row_reads_as_a_map_without_epochs(seed: int, epoch: Epoch) -> None:
    row = random_evidence(seed, SMALL)
    reading = present(cell_history({epoch: row}), SMALL, MODEL)
    assert reading.voxels.tolist() == row.voxels.tolist()
    assert reading.counts.tolist() == row.counts.tolist()
    assert reading.log_odds.tolist() == MODEL.log_odds(row.counts).tolist()
    assert reading.occupied(MODEL).tolist() == MODEL.occupied(row.counts).tolist()


@given(st.integers(0, 10**6), st.randoms(use_true_random=False))
def test_no_order_of_arrival_changes_the_reading(seed: int, order: random.Random) -> None:
    commits = [random_history(seed + n, rows=2) for n in range(4)]
    readings = []
    for _ in range(2):
        reading = present(merged(commits, SMALL), SMALL, MODEL)
        readings.append((reading.log_odds.tolist(), reading.samples.tolist(), reading.newest.tolist()))
        order.shuffle(commits)
    assert readings[0] == readings[1]


def test_a_wall_that_vanished_is_free_after_as_many_misses_as_octomap_needs() -> None:
    wall = seen(200, 0)
    odds, needed = HIGH, 0
    while odds > 0:  # OctoMap, which clamps after each measurement
        odds, needed = max(odds + MISS, LOW), needed + 1
    is_there = [bool(read({0: wall, 1: seen(0, misses)}).occupied(MODEL)[0]) for misses in (needed - 1, needed)]
    assert is_there == [True, False]
    assert needed == 9


def test_free_space_is_occupied_after_as_many_hits_as_octomap_needs() -> None:
    reading = [bool(read({0: seen(0, 200), 1: seen(hits, 0)}).occupied(MODEL)[0]) for hits in (2, 3)]
    assert reading == [False, True]


def test_old_news_that_comes_late_does_not_bring_the_wall_back() -> None:
    now = read({5: seen(0, 30)})
    late = read({1: seen(60, 0), 5: seen(0, 30)})
    assert not late.occupied(MODEL)[0]
    assert late.log_odds[0] == now.log_odds[0] == LOW


def test_evidence_without_a_time_is_older_than_all_other() -> None:
    assert not read({BASE: seen(200, 0), -(10**6): seen(0, 9)}).occupied(MODEL)[0]


def test_as_it_was_at_a_time_later_rows_are_not_read() -> None:
    rows = {0: seen(200, 0), 7: seen(0, 20)}
    assert read(rows, at=6).occupied(MODEL)[0]
    assert not read(rows, at=7).occupied(MODEL)[0]
    assert len(read(rows, at=-1)) == 0


def test_the_age_of_a_voxel_is_its_newest_epoch_with_counts() -> None:
    reading = read({2: warm(4, 300.0), 5: warm(1, 300.0, hits=0)})
    assert reading.newest.tolist() == [2]
    assert reading.sampled_in[0].tolist() == [BASE, BASE, 5, BASE]


def test_an_empty_history_reads_as_nothing() -> None:
    reading = read({3: empty_evidence(SMALL)})
    assert len(reading) == len(reading.sampled) == 0


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ({1: warm(40, 290.0), 2: warm(3, 310.0)}, (310.0, 3)),
        ({1: warm(40, 290.0), 2: warm(2, 310.0)}, (310.0, 2)),
        ({1: warm(40, 290.0), 2: warm(2, 290.5)}, (290 + 0.5 * 2 / 42, 42)),
        ({0: warm(9, 280.0), 1: warm(6, 290.0), 2: warm(2, 290.0)}, (290.0, 8)),
        ({0: warm(9, 290.0), 1: warm(6, 310.0), 2: warm(2, 290.0)}, (290.0, 2)),
    ],
    ids=["newest alone", "too few, but unlike", "too few, alike", "joined up to 8", "none beyond one that differs"],
)
def test_samples_are_the_newest_and_older_ones_that_agree(
    rows: dict[int, Evidence], expected: tuple[float, int]
) -> None:
    found = kelvin(read(rows))
    assert found[1] == expected[1]
    assert found[0] == pytest.approx(expected[0], abs=1e-9)


def test_samples_from_before_the_voxel_read_free_are_not_shown() -> None:
    crate_came_and_went = {1: warm(5, 310.0, hits=5), 2: seen(0, 20), 3: seen(9, 0)}
    reading = read(crate_came_and_went)
    assert reading.occupied(MODEL)[0]
    assert len(reading.sampled) == 0


@given(st.integers(0, 10**6), st.integers(2, 5))
def test_votes_of_a_level_count_in_all_epochs_unless_they_were_seen_through_since(seed: int, count: int) -> None:
    # Many votes in one epoch, few in another, of other heights: a column is read from the shares of its bins.
    rng = np.random.default_rng(seed)
    rows = {}
    for epoch in range(count):
        places = np.flatnonzero(rng.random(30) < 0.5).astype(np.uint32)
        votes = rng.integers(1, 20, len(places))
        samples = np.stack([rng.integers(0, 10 * votes), votes], axis=1)
        rows[Epoch(epoch)] = packed_evidence(places, np.stack([votes, 0 * votes], axis=1), samples, LEVEL)
    whole = present(cell_history(rows), LEVEL, MODEL)
    total = BrickCell(LEVEL)
    for row in rows.values():
        total.merge(row)
    assert whole.samples.tolist() == total.packed().samples.tolist()
    seen_through = total.packed().voxels[:1]
    misses = packed_evidence(seen_through, np.array([[0, 60]]), np.zeros((1, 2), np.int64), LEVEL)
    later = present(cell_history(rows | {Epoch(count): misses}), LEVEL, MODEL)
    assert later.samples.tolist() == total.packed().samples.tolist()[1:]
