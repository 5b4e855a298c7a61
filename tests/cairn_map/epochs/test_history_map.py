"""Maps and cells with epochs to which commits are added and taken out again: any order, exact inverses, equal bytes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import EPOCHS, HISTORIES, LAYER, random_history
from tests.fixtures.map.made import KEY, SMALL, random_evidence

from cairn_map.codec.cell_code import coding_of, encode_cell
from cairn_map.codec.history_code import encode_history
from cairn_map.codec.layer_code import decode_layer_cell, encode_layer_cell, read_cell, row_coding, row_file, write_cell
from cairn_map.epochs.cell_history import NOTHING, CellHistory, cell_history, history_fingerprint, merged
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.history_cell import HistoryCell
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.brick_cell import sum_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel

MODEL = SensorModel()
PLAIN = MapLayer(geometry=SMALL)
EVIDENCE = st.integers(0, 50).map(lambda seed: random_evidence(seed, SMALL))
"""Evidence whose sums fit."""
COMMITS = st.lists(st.tuples(EPOCHS, EVIDENCE), max_size=6)


def cell_of(history: CellHistory, layer: MapLayer = LAYER) -> HistoryCell:
    """A cell that holds these rows."""
    cell = HistoryCell(KEY, layer, row_coding(layer))
    for epoch, row in history.rows.items():
        cell.merge(epoch, row)
    return cell


@given(COMMITS, st.randoms(use_true_random=False), st.booleans())
def test_every_order_of_commits_gives_the_same_bytes(commits: list, random, rests: bool) -> None:  # type: ignore[no-untyped-def,type-arg]
    shuffled = random.sample(commits, len(commits))
    one, other = (HistoryCell(KEY, LAYER, row_coding(LAYER)) for _ in range(2))
    for epoch, evidence in commits:
        one.merge(epoch, evidence)
    for epoch, evidence in shuffled:
        other.merge(epoch, evidence)
        if rests:
            write_cell(other)
            other.rest()
    written = write_cell(one)
    assert written == write_cell(other)
    expected = merged([cell_history({epoch: evidence}) for epoch, evidence in commits], SMALL)
    assert written.data == encode_history(KEY, expected, LAYER).data
    assert written.digest == encode_history(KEY, expected, LAYER).digest
    assert written.fingerprint == history_fingerprint(expected, KEY, layer_word=LAYER.word)


@given(st.integers(0, 20).map(random_history), EPOCHS, EVIDENCE)
def test_unmerge_undoes_merge(history: CellHistory, epoch: Epoch, evidence) -> None:  # type: ignore[no-untyped-def]
    cell = cell_of(history)
    before = write_cell(cell)
    cell.rest()
    cell.merge(epoch, evidence)
    cell.unmerge(epoch, evidence)
    assert write_cell(cell) == before
    assert cell.history() == history


@given(HISTORIES)
def test_reading_undoes_writing(history: CellHistory) -> None:
    written = write_cell(cell_of(history))
    again = read_cell(written.data, KEY, LAYER)
    assert again.history() == history
    assert write_cell(again) == written
    assert decode_layer_cell(written.data, KEY, LAYER).history == history
    assert decode_layer_cell(written.data, KEY, LAYER).digest == written.digest


@pytest.mark.parametrize("layer", [PLAIN, LAYER], ids=["plain", "epochs"])
@pytest.mark.parametrize("is_written", [True, False], ids=["written", "added"])
def test_a_fingerprint_that_was_added_to_is_that_of_all_voxels(layer: MapLayer, is_written: bool) -> None:
    epoch, merge, unmerge = Epoch(3) if layer.has_epochs else BASE, HistoryCell.merge, HistoryCell.unmerge
    cell = cell_of(cell_history({epoch: random_evidence(1, SMALL, voxels=200)}), layer)
    large, *small = (random_evidence(seed, SMALL, voxels=20, air=3 if seed == 2 else 0) for seed in range(2, 6))
    write_cell(cell)
    steps = [(merge, small[0]), (merge, small[1]), (unmerge, small[0]), (merge, large), (unmerge, large)]
    for step, diff in [*steps, (merge, small[2])]:
        step(cell, epoch, diff)
        if is_written:
            assert write_cell(cell).fingerprint == history_fingerprint(cell.history(), KEY, layer_word=layer.word)
            cell = read_cell(write_cell(cell).data, KEY, layer)
    assert write_cell(cell).fingerprint == history_fingerprint(cell.history(), KEY, layer_word=layer.word)


def test_rows_at_rest_are_copied_and_only_the_changed_one_is_coded(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = read_cell(write_cell(cell_of(random_history(1))).data, KEY, LAYER)
    newest, coded = max(cell), []
    coding = row_coding(LAYER)
    noting = replace(coding, encode=lambda *row: coded.append(row[1]) or coding.encode(*row))
    monkeypatch.setattr(cell, "_coding", noting)
    cell.merge(newest, random_evidence(9, SMALL))
    write_cell(cell)
    assert coded == [newest]


def test_a_map_without_epochs_writes_cells_of_version_1() -> None:
    evidence = random_evidence(3, SMALL)
    history = cell_history({BASE: evidence})
    encoded = encode_cell(KEY, evidence, SMALL)
    assert write_cell(cell_of(history, PLAIN)).data == encoded.data == encode_layer_cell(KEY, history, PLAIN).data
    assert write_cell(cell_of(history, PLAIN)).digest == encoded.digest
    assert row_file(encoded.data, BASE, KEY, PLAIN) == encoded.data
    empty = write_cell(cell_of(NOTHING, PLAIN))
    assert decode_layer_cell(empty.data, KEY, PLAIN).history == NOTHING
    assert empty.digest == decode_layer_cell(empty.data, KEY, PLAIN).digest
    with pytest.raises(BadInputError, match="one row, the base"):
        encode_layer_cell(KEY, cell_history({Epoch(1): evidence}), PLAIN)


def test_cells_of_another_layer_or_number_are_refused() -> None:
    data = write_cell(cell_of(random_history(1))).data
    for key, layer in ((cell_key((7, 7, 7)), LAYER), (KEY, MapLayer(geometry=SMALL, epoch_s=600))):
        with pytest.raises(DamagedDataError, match="expected cell"):
            decode_layer_cell(data, key, layer)
        with pytest.raises(DamagedDataError, match="expected cell"):
            read_cell(data, key, layer)
    plain = encode_cell(KEY, random_evidence(1, SMALL), SMALL).data
    for wrong, layer in ((data, PLAIN), (plain, LAYER)):
        with pytest.raises(BadInputError, match="version"):
            decode_layer_cell(wrong, KEY, layer)


def test_a_row_file_is_a_cell_of_one_row() -> None:
    evidence = random_evidence(4, SMALL)
    data = row_file(encode_cell(KEY, evidence, SMALL).data, Epoch(5), KEY, LAYER)
    assert decode_layer_cell(data, KEY, LAYER).history == cell_history({Epoch(5): evidence})


@given(COMMITS, st.randoms(use_true_random=False))
def test_a_map_is_the_same_in_any_order_and_as_it_was_after_unmerge(commits: list, random) -> None:  # type: ignore[no-untyped-def,type-arg]
    one, other = HistoryMap(LAYER, coding=coding_of(SMALL)), HistoryMap(LAYER)
    for epoch, evidence in commits:
        one.merge({KEY: evidence}, epoch=epoch)
    extra = random_evidence(7, SMALL)
    other.merge({KEY: extra}, epoch=Epoch(2))
    for epoch, evidence in random.sample(commits, len(commits)):
        other.merge({KEY: evidence}, epoch=epoch)
    other.unmerge({KEY: extra}, epoch=Epoch(2))
    assert one == other
    assert one.history(KEY) == other.history(KEY) == merged([cell_history({e: row}) for e, row in commits], SMALL)
    # Rule T5.
    assert one.evidence(KEY) == sum_evidence([evidence for _, evidence in commits], SMALL)


def test_rows_of_older_epochs_rest_as_bytes_and_a_copy_stays_as_it_was() -> None:
    whole = HistoryMap(LAYER, coding=coding_of(SMALL))
    rows = {Epoch(n): random_evidence(n, SMALL) for n in range(3)}
    for epoch, row in rows.items():
        whole.merge({KEY: row}, epoch=epoch)
    sums = EvidenceMap(SMALL)
    sums.merge({KEY: sum_evidence(rows.values(), SMALL)})
    assert whole.size_bytes < 2 * sums.size_bytes
    copied = whole.copy()
    whole.merge({KEY: random_evidence(9, SMALL)}, epoch=Epoch(1))
    assert copied.history(KEY) == cell_history(rows)
    assert copied != whole


@given(st.lists(st.tuples(EPOCHS, EVIDENCE, st.sampled_from(["merge", "unmerge", "rest", "read"])), max_size=9))
def test_a_map_that_rests_now_and_then_is_the_same_and_reads_the_same(steps: list) -> None:  # type: ignore[type-arg]
    resting, other = HistoryMap(LAYER, coding=coding_of(SMALL)), HistoryMap(LAYER)
    merged_ones = []
    for epoch, evidence, step in steps:
        if step == "rest":
            resting.rest()
        elif step == "read":
            read = [{key: cell.packed() for key, cell in each.frozen_cells(MODEL).items()} for each in (resting, other)]
            assert read[0] == read[1]
        elif step == "merge" or not merged_ones:
            merged_ones.append((epoch, evidence))
            for each in (resting, other):
                each.merge({KEY: evidence}, epoch=epoch)
        else:
            epoch, evidence = merged_ones.pop()
            for each in (resting, other):
                each.unmerge({KEY: evidence}, epoch=epoch)
    assert resting == other


def test_cells_that_did_not_change_since_the_last_rest_are_held_as_bytes() -> None:
    whole, other = HistoryMap(LAYER, coding=coding_of(SMALL)), cell_key((3, 0, 0))
    for key in (KEY, other):
        whole.merge({key: random_evidence(1, SMALL)}, epoch=Epoch(1))
    open_bytes = whole.cell_bytes(KEY)
    whole.rest()
    assert whole.cell_bytes(KEY) == open_bytes
    whole.merge({other: random_evidence(2, SMALL)}, epoch=Epoch(1))
    whole.rest()
    assert whole.cell_bytes(KEY) < open_bytes <= whole.cell_bytes(other)
    plain = HistoryMap(PLAIN, coding=coding_of(SMALL))
    plain.merge({KEY: random_evidence(1, SMALL)})
    plain.rest()
    plain.rest()
    assert plain.cell_bytes(KEY) == open_bytes


def test_replacing_a_cell_makes_it_hold_these_rows_alone() -> None:
    whole = HistoryMap(LAYER, coding=coding_of(SMALL))
    whole.merge({KEY: random_evidence(1, SMALL)}, epoch=Epoch(4))
    history = random_history(2)
    whole.replace(KEY, history)
    assert whole.history(KEY) == history
    whole.replace(KEY, NOTHING)
    assert KEY not in whole
    assert len(whole) == 0
    assert whole == HistoryMap(LAYER)


def test_a_map_without_epochs_has_the_digest_of_its_sums() -> None:
    diff: dict[CellKey, object] = {KEY: random_evidence(1, SMALL)}
    plain, sums = HistoryMap(PLAIN), EvidenceMap(SMALL)
    plain.merge(diff)  # type: ignore[arg-type]
    sums.merge(diff)  # type: ignore[arg-type]
    assert plain.digest() == sums.digest()
    assert plain == sums
    assert np.array_equal(plain.packed()[KEY].voxels, sums.packed()[KEY].voxels)
