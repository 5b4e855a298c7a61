"""The reading of a whole map: cells that did not change are not read again, and what was frozen does not change."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import change, epoch_map, random_history
from tests.fixtures.map.made import KEY, SMALL, random_evidence

from cairn_map.codec.layer_code import encode_layer_cell, row_bodies
from cairn_map.epochs import cell_reading
from cairn_map.epochs.cell_history import NOTHING, cell_history
from cairn_map.epochs.cell_history import merged as sum_of_histories
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.map_reading import BlockTimes, CompactReading, MapReading
from cairn_map.epochs.present import present
from cairn_map.evidence.brick_cell import reading_cell
from cairn_map.evidence.compact_cell import sums_of
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel

MODEL = SensorModel()
OTHER = cell_key((4, 0, 0))
DEEP = Geometry(voxel_edge_um=50_000, depth=6, channels=())


def two_cells() -> HistoryMap:
    rows = epoch_map()
    for n, key in enumerate((KEY, OTHER)):
        for epoch in (BASE, Epoch(1), Epoch(2)):
            change(rows, epoch, random_evidence(10 * n + epoch % 7, SMALL), key=key)
    return rows


def add(rows: HistoryMap, reading: MapReading, epoch: int, seed: int) -> None:
    diff = random_evidence(seed, SMALL)
    change(rows, Epoch(epoch), diff)
    reading.note({KEY: diff}, epoch=Epoch(epoch), sign=1)


def test_cells_are_read_as_their_rows_are() -> None:
    rows = two_cells()
    for at in (None, Epoch(1), BASE):
        for key, cell in MapReading(rows, at=at).frozen_cells(MODEL).items():
            reading = present(rows.history(key), SMALL, MODEL, at=at).evidence
            assert cell.packed() == reading_cell(SMALL, reading, MODEL).packed()


def test_only_cells_that_changed_are_read_again() -> None:
    rows = two_cells()
    reading = MapReading(rows)
    before = reading.frozen_cells(MODEL)
    packed = {key: cell.packed() for key, cell in before.items()}
    add(rows, reading, 2, 99)
    after = reading.frozen_cells(MODEL)
    same = {key: all(a is b for a, b in zip(sums_of(before[key]), sums_of(after[key]), strict=True)) for key in before}
    assert same == {KEY: False, OTHER: True}
    assert {key: cell.packed() for key, cell in before.items()} == packed
    assert after[KEY].packed() == MapReading(rows).frozen_cells(MODEL)[KEY].packed() != packed[KEY]


def test_cells_that_are_forgotten_or_gone_are_read_again() -> None:
    rows = two_cells()
    reading = MapReading(rows)
    reading.frozen_cells(MODEL)
    change(rows, BASE, random_evidence(5, SMALL))
    reading.forget([KEY])
    assert reading.frozen_cells(MODEL)[KEY].packed() == MapReading(rows).frozen_cells(MODEL)[KEY].packed()
    rows.replace(KEY, NOTHING)
    assert list(reading.frozen_cells(MODEL)) == [OTHER]
    change(rows, BASE, random_evidence(6, SMALL))
    assert reading.frozen_cells(MODEL)[KEY].packed() == MapReading(rows).frozen_cells(MODEL)[KEY].packed()


def test_another_sensor_model_reads_all_cells_again() -> None:
    rows, other = two_cells(), SensorModel(p_hit=0.9)
    reading = MapReading(rows)
    reading.frozen_cells(MODEL)
    assert reading.frozen_cells(other)[KEY].packed() == MapReading(rows).frozen_cells(other)[KEY].packed()


def test_times_are_those_of_the_moment_of_freezing() -> None:
    rows = two_cells()
    reading = MapReading(rows)
    times = reading.frozen_times()
    assert times is not None
    places = np.arange(8**SMALL.depth, dtype=np.uint32)
    before, measured = times.seen(KEY, places), times.measured(KEY, places, MODEL)
    add(rows, reading, 9, 99)
    assert np.array_equal(times.seen(KEY, places), before, equal_nan=True)
    assert np.array_equal(times.measured(KEY, places, MODEL), measured, equal_nan=True)
    assert np.nanmax(before) == np.nanmax(measured) == 2 * 120
    then, until = reading.frozen_times(), MapReading(rows, at=Epoch(1)).frozen_times()
    assert then is not None and until is not None
    assert np.nanmax(then.seen(KEY, places)) == np.nanmax(then.measured(KEY, places, MODEL)) == 9 * 120
    assert np.nanmax(until.seen(KEY, places)) == np.nanmax(until.measured(KEY, places, MODEL)) == 120


@given(st.integers(0, 10**6), st.sampled_from([None, BASE, Epoch(1), Epoch(8)]))
def test_a_block_has_the_time_of_the_newest_evidence_in_it(seed: int, at: Epoch | None) -> None:
    rows, history = epoch_map(), random_history(seed)
    for epoch, row in history.rows.items():
        change(rows, epoch, row)
    times, expected = BlockTimes(rows, at=at), {}
    for epoch in sorted(history):
        if epoch != BASE and (at is None or epoch <= at):
            expected |= dict.fromkeys((history.rows[epoch].voxels >> np.uint32(6)).tolist(), epoch * 120.0)
    change(rows, Epoch(99), random_evidence(seed, SMALL))
    assert list(times) == [KEY]
    found = times[KEY]
    assert len(found) == 8 ** (SMALL.depth - 2)
    assert {block: time_s for block, time_s in enumerate(found.tolist()) if time_s == time_s} == expected


def test_a_cell_of_few_bytes_is_not_held_as_a_reading() -> None:
    rows = epoch_map(DEEP)
    places = np.arange(8**DEEP.depth, dtype=np.uint32)
    air, one = (
        packed_evidence(it, np.tile([0, 1], (len(it), 1)), np.zeros((len(it), DEEP.plane_count), np.int64), DEEP)
        for it in (places, places[:1])
    )
    for epoch, diff in ((0, air), (1, air), (2, one)):
        change(rows, Epoch(epoch), diff)
    reading = MapReading(rows)
    cell = reading.frozen_cells(MODEL)[KEY]
    assert isinstance(cell, CompactReading)
    assert reading.size_bytes == 0
    expected = reading_cell(DEEP, present(rows.history(KEY), DEEP, MODEL).evidence, MODEL)
    assert cell.opened().packed() == expected.packed()
    assert cell.size_bytes < expected.size_bytes / 10
    # It does not change, and is the same one until its rows do.
    assert sums_of(reading.frozen_cells(MODEL)[KEY]) == sums_of(cell)
    change(rows, Epoch(2), one)
    reading.note({KEY: one}, epoch=Epoch(2), sign=1)
    assert cell.opened().packed() == expected.packed()
    assert reading.frozen_cells(MODEL)[KEY].packed().counts.sum() == 2 * len(places) + 2


def come(rows: HistoryMap, epoch: Epoch, seed: int) -> None:
    """The cell comes again from a server, with more in one row."""
    grown = sum_of_histories([rows.history(KEY), cell_history({epoch: random_evidence(seed, SMALL, voxels=20)})], SMALL)
    data = encode_layer_cell(KEY, grown, rows.layer).data
    rows.replace(KEY, grown, bodies=row_bodies(data, KEY, rows.layer), came_bytes=len(data))


def test_a_cell_that_grows_at_its_newest_row_is_not_read_from_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = epoch_map()
    change(rows, Epoch(0), random_evidence(0, SMALL))
    for epoch in (1, 1, 2, 3):
        come(rows, Epoch(epoch), epoch)
    rows.frozen_cells(MODEL)
    old = rows.rows(KEY)
    with monkeypatch.context() as patch:
        patch.setattr(cell_reading, "present", None)  # who reads all rows now fails
        for epoch in (3, 3, 4):
            come(rows, Epoch(epoch), 10 + epoch)
            rows.frozen_cells(MODEL)
    assert all(rows.rows(KEY)[epoch] is old[epoch] for epoch in (Epoch(0), Epoch(1), Epoch(2)))
    found, fresh = rows.frozen_cells(MODEL)[KEY], MapReading(rows.copy()).frozen_cells(MODEL)[KEY]
    assert found.packed() == fresh.packed()


@given(st.integers(0, 10**6))
def test_a_map_reads_as_one_made_afresh_whatever_was_done_to_it(seed: int) -> None:
    rng, rows = random.Random(seed), epoch_map()
    merged: list[tuple[Epoch, Diff]] = []
    for n in range(8):
        kind = rng.random()
        if merged and kind < 0.2:
            epoch, diff = merged.pop(rng.randrange(len(merged)))
            rows.unmerge(diff, epoch=epoch)
        elif merged and kind < 0.3:
            rows.replace(KEY, random_history(rng.randrange(10**6)))
            merged = []
        elif kind < 0.5 and KEY in rows:
            come(rows, rng.choice([Epoch(n), max(rows.history(KEY), default=BASE)]), rng.randrange(10**6))
        elif 0.5 <= kind < 0.52:
            rows.clear()
            merged = []
        else:
            epoch = Epoch(rng.choice([n // 3, n // 3, n // 4]))
            keys = rng.choice([[KEY], [OTHER], [KEY, OTHER]])
            merged.append((epoch, {key: random_evidence(rng.randrange(10**6), SMALL, voxels=20) for key in keys}))
            rows.merge(merged[-1][1], epoch=epoch)
        found, fresh = rows.frozen_cells(MODEL), MapReading(rows.copy()).frozen_cells(MODEL)
        assert {key: cell.packed() for key, cell in found.items()} == {key: it.packed() for key, it in fresh.items()}


def test_a_map_without_epochs_is_frozen_as_its_sums() -> None:
    rows = HistoryMap(MapLayer(geometry=SMALL))
    rows.merge({KEY: random_evidence(1, SMALL)})
    frozen = rows.frozen_cells(MODEL)
    rows.merge({KEY: random_evidence(2, SMALL)})
    assert frozen[KEY].packed() == random_evidence(1, SMALL)
    assert rows.frozen_times() is None
    assert rows.reading_bytes == 0
