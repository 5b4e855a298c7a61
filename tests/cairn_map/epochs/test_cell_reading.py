"""The reading of a cell as its rows change: bit for bit that of all rows, whatever changed in whatever order."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import change, epoch_map
from tests.fixtures.map.made import KEY, SMALL, random_evidence

from cairn_map.epochs.cell_reading import CellReading, _Samples, voxel_times_s
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import reading_cell
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import COUNT_MAX, Evidence, packed_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel

MODEL = SensorModel()
LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=3, channels=(HEIGHT_OFFSET,))
"""Its votes are joined over all epochs."""


def expected(rows: HistoryMap, *, at: Epoch | None = None) -> Evidence:
    """The reading of all rows, as a cell gives it back."""
    reading = present(rows.history(KEY), rows.geometry, MODEL, at=at).evidence
    return reading_cell(rows.geometry, reading, MODEL).packed()


def alike(seed: int, geometry: Geometry = SMALL) -> Evidence:
    """Evidence of the same few voxels, with samples so few and so alike that rows are often joined."""
    rng = np.random.default_rng(seed)
    places = np.flatnonzero(rng.random(40) < 0.6).astype(np.uint32)
    samples = np.zeros((len(places), geometry.plane_count), np.int64)
    for channel in geometry.channels:
        weights = rng.integers(0, 4, len(places))
        values = 100 + rng.integers(0, 2, (len(places), channel.value_count)) * rng.choice([1, 60], p=[0.9, 0.1])
        columns = [values[:, n] * weights for n in range(channel.value_count)]
        columns += [values[:, 0] ** 2 * weights] if "square_sum" in channel.planes else []
        samples[:, geometry.planes_of(channel.name)] = np.stack([*columns, weights], axis=1)
    return packed_evidence(places, rng.integers(0, 3, (len(places), 2)), samples, geometry)


@given(st.integers(0, 10**6), st.sampled_from([None, 2, 3]), st.sampled_from([SMALL, LEVEL]))
def test_whatever_changes_the_reading_is_that_of_all_rows(seed: int, at: int | None, geometry: Geometry) -> None:
    rng, until = random.Random(seed), None if at is None else Epoch(at)
    rows = epoch_map(geometry)
    reading = CellReading(geometry, MODEL, lambda: rows.rows(KEY), at=until)
    commits: list[tuple[Epoch, Evidence]] = []
    for n in range(14):
        # Mostly the newest epoch grows; at times old news comes, a commit is taken back, or a new epoch begins.
        kind = rng.random()
        if commits and kind < 0.25:
            (epoch, diff), sign = commits.pop(rng.randrange(len(commits))), -1
        else:
            epoch = Epoch(n // 4) if kind < 0.8 else rng.choice([BASE, Epoch(0), Epoch(n // 5)])
            make = rng.choice([alike, lambda seed, grid: random_evidence(seed, grid, voxels=20)])
            diff, sign = make(rng.randrange(10**6), geometry), 1
            commits.append((epoch, diff))
        change(rows, epoch, diff, sign=sign)
        reading.note(epoch, diff, sign)
        if rng.random() < 0.2:
            reading.rest()
        if rng.random() < 0.7:
            assert reading.cell().packed() == expected(rows, at=until)
    assert reading.cell().packed() == expected(rows, at=until)


def test_a_row_that_grows_leaves_the_others_as_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = epoch_map()
    for epoch in range(3):
        change(rows, Epoch(epoch), alike(epoch))
    reading = CellReading(SMALL, MODEL, lambda: rows.rows(KEY))
    reading.cell()
    decoded: list[int] = []
    compact = type(rows.rows(KEY)[Epoch(0)])
    packed = compact.packed
    monkeypatch.setattr(compact, "packed", lambda row: decoded.append(1) or packed(row))
    for n in range(5):
        diff = alike(10 + n)
        change(rows, Epoch(2), diff)
        reading.note(Epoch(2), diff, 1)
        reading.cell()
    assert len(decoded) == 2
    assert reading.cell().packed() == expected(rows)


@pytest.mark.parametrize(
    ("low", "high", "plane_bytes"),
    [(0, 255, 1), (-1, 255, 2), (0, 256, 2), (-(2**15), 2**15, 4), (0, 2**31, 4), (-1, 2**31, 8), (0, 2**32, 8)],
)
def test_samples_of_closed_rows_take_few_bytes_and_come_back_as_they_were(
    low: int, high: int, plane_bytes: int
) -> None:
    sums = np.array([[low, 1], [high, 2], [0, 3]], np.int64)
    samples = _Samples.of_sums(np.arange(3, dtype=np.uint32), sums)
    assert samples.size_bytes == 3 * (4 + plane_bytes + 1)
    places = np.array([2, 0, 1])
    np.testing.assert_array_equal(samples.sums(places), sums[places])


def test_a_copy_of_the_reading_does_not_change() -> None:
    rows = epoch_map()
    change(rows, Epoch(1), alike(1))
    reading = CellReading(SMALL, MODEL, lambda: rows.rows(KEY))
    held = reading.cell().copy()
    before = held.packed()
    change(rows, Epoch(1), alike(2))
    reading.note(Epoch(1), alike(2), 1)
    assert reading.cell().packed() == expected(rows) != before
    assert held.packed() == before


def test_counts_beyond_32_bits_end_there_and_are_right_again_later() -> None:
    rows = epoch_map()
    reading = CellReading(SMALL, MODEL, lambda: rows.rows(KEY))
    full, one = (
        packed_evidence(np.array([9]), np.array([[count, 0]]), np.zeros((1, SMALL.plane_count), np.int64), SMALL)
        for count in (COUNT_MAX, 1)
    )
    for epoch, diff, sign in ((0, full, 1), (1, one, 1), (1, one, 1), (0, full, -1), (1, one, -1)):
        change(rows, Epoch(epoch), diff, sign=sign)
        reading.note(Epoch(epoch), diff, sign)
        assert reading.cell().packed() == expected(rows)


def test_changes_that_are_not_asked_for_are_not_kept() -> None:
    rows = epoch_map()
    reading = CellReading(SMALL, MODEL, lambda: rows.rows(KEY))
    change(rows, Epoch(0), alike(0))
    size_bytes = reading.cell().size_bytes
    for n in range(50):
        change(rows, Epoch(0), alike(n))
        reading.note(Epoch(0), alike(n), 1)
        assert reading.size_bytes <= 2 * size_bytes
    assert reading.cell().packed() == expected(rows)


@given(st.integers(0, 10**6), st.lists(st.integers(0, 8**3 - 1), max_size=40))
def test_voxels_were_seen_last_when_the_newest_epoch_says_so(seed: int, places: list[int]) -> None:
    rows = epoch_map()
    for n, epoch in enumerate([BASE, Epoch(-2), Epoch(3), Epoch(7)]):
        change(rows, epoch, random_evidence(seed + n, SMALL, voxels=60))
    reading = present(rows.history(KEY), SMALL, MODEL)
    newest = dict(zip(reading.voxels.tolist(), reading.newest.tolist(), strict=True))
    found = voxel_times_s(rows.rows(KEY), np.array(places, np.uint32), 120)
    for place, time_s in zip(places, found.tolist(), strict=True):
        epoch = newest.get(place, BASE)
        assert np.isnan(time_s) if epoch == BASE else time_s == epoch * 120
