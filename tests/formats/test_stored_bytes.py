"""Bytes that were once written must decode for ever to what they meant; `make_formats.py` made them."""

import json

import pytest
from tests.formats.make_formats import (
    CELLS,
    CLASS_CELL,
    CLASSED,
    EPOCH_CELLS,
    FOLDER,
    GEOMETRY,
    KEY,
    LAYER,
    LAYER_CELLS,
    LAYER_EPOCH_CELLS,
    classes,
    evidence,
    found,
    found_of_layers,
    found_with_attachments,
    found_with_classes,
    found_with_epochs,
    found_with_layer,
    found_with_marks,
    history,
    layer_evidence,
    layer_histories,
    wall,
)
from tests.naive import cell_code as naive_cell_code
from tests.naive import history as naive_history

from cairn_map.codec.cell_code import decode_canonical_cell, decode_cell, encode_cell
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.history_code import check_canonical_history, decode_history, encode_history
from cairn_map.codec.octree.streams import MODELLED


def test_stored_bytes_still_mean_what_they_meant() -> None:
    assert found() == json.loads((FOLDER / "v1.json").read_text())


@pytest.mark.parametrize(("name", "sign"), [(CELLS[0], 1), (CELLS[1], -1)])
def test_stored_cells_hold_the_evidence_that_was_put_in(name: str, sign: int) -> None:
    decoded = decode_canonical_cell((FOLDER / name).read_bytes())
    assert decoded.evidence == evidence(sign)
    assert (decoded.key, decoded.geometry) == (KEY, GEOMETRY)


def test_the_stored_modelled_cell_holds_its_evidence_in_modelled_streams_alone() -> None:
    data = (FOLDER / "v1-small.cell").read_bytes()
    assert {stream.coding for stream in cell_reader(data).stored.values()} == {MODELLED}
    assert decode_canonical_cell(data).evidence == wall()


@pytest.mark.parametrize("name", CELLS)
def test_evidence_of_stored_cells_still_gives_their_digest(name: str) -> None:
    decoded = decode_cell((FOLDER / name).read_bytes())
    assert encode_cell(decoded.key, decoded.evidence, decoded.geometry).digest == decoded.digest


@pytest.mark.parametrize("name", CELLS)
def test_the_second_decoder_reads_stored_cells_too(name: str) -> None:
    data = (FOLDER / name).read_bytes()
    assert naive_cell_code.decode_cell(data)[0]["digest"] == decode_cell(data).digest


def test_stored_bytes_with_epochs_still_mean_what_they_meant() -> None:
    assert found_with_epochs() == json.loads((FOLDER / "v2.json").read_text())


@pytest.mark.parametrize("name", EPOCH_CELLS)
def test_stored_cells_with_epochs_hold_their_rows_for_both_decoders(name: str) -> None:
    data = (FOLDER / name).read_bytes()
    check_canonical_history(data)
    decoded = decode_history(data)
    assert (decoded.key, decoded.layer, decoded.history) == (KEY, LAYER, history())
    assert naive_history.decode_history(data)[0]["digest"] == decoded.digest


def test_stored_bytes_with_marks_still_mean_what_they_meant() -> None:
    assert found_with_marks() == json.loads((FOLDER / "v3.json").read_text())
    assert found_with_attachments() == json.loads((FOLDER / "v3-attachment.json").read_text())


def test_the_stored_definition_of_a_layer_still_means_what_it_meant() -> None:
    assert found_with_layer() == json.loads((FOLDER / "v4.json").read_text())


def test_the_stored_cell_of_classes_still_means_what_it_meant() -> None:
    assert found_with_classes() == json.loads((FOLDER / "v1-classes.json").read_text())
    decoded = decode_canonical_cell((FOLDER / CLASS_CELL).read_bytes())
    assert (decoded.key, decoded.geometry, decoded.evidence) == (KEY, CLASSED, classes())
    assert encode_cell(KEY, classes(), CLASSED).digest == decoded.digest


def test_the_stored_cells_of_levels_and_classes_still_mean_what_they_meant() -> None:
    assert found_of_layers() == json.loads((FOLDER / "layer-cells.json").read_text())


@pytest.mark.parametrize("name", LAYER_CELLS)
def test_stored_cells_of_levels_and_classes_hold_what_was_put_in(name: str) -> None:
    evidence, geometry = layer_evidence()[name]
    decoded = decode_canonical_cell((FOLDER / name).read_bytes())
    assert (decoded.key, decoded.geometry, decoded.evidence) == (KEY, geometry, evidence)
    assert encode_cell(KEY, evidence, geometry).digest == decoded.digest


@pytest.mark.parametrize("name", LAYER_EPOCH_CELLS)
def test_stored_rows_of_levels_and_classes_hold_what_was_put_in(name: str) -> None:
    rows, layer = layer_histories()[name]
    data = (FOLDER / name).read_bytes()
    check_canonical_history(data)
    decoded = decode_history(data)
    assert (decoded.key, decoded.layer, decoded.history) == (KEY, layer, rows)
    assert encode_history(KEY, rows, layer).digest == decoded.digest
