"""Cells with epochs to bytes and back, against the slow second codec."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import HISTORIES, LAYER, SIGNED_HISTORIES, as_naive, random_history
from tests.fixtures.map.made import KEY, PLAIN, SMALL, random_evidence
from tests.naive import history as naive_history

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.codec.history_code import (
    FIXED_PART,
    ROW_HEAD,
    HistoryFile,
    check_canonical_history,
    decode_history,
    encode_history,
    join_history,
    split_history,
)
from cairn_map.epochs.cell_history import NOTHING, CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.evidence.grid import cell_key

CELL = encode_history(KEY, random_history(1), LAYER).data
HEAD_BYTES = len(encode_history(KEY, NOTHING, LAYER).data)


@given(st.one_of(HISTORIES, SIGNED_HISTORIES), st.sampled_from(Profile))
def test_decoding_undoes_encoding(history: CellHistory, profile: Profile) -> None:
    encoded = encode_history(KEY, history, LAYER, profile=profile)
    decoded = decode_history(encoded.data)
    assert decoded.history == history
    assert (decoded.key, decoded.layer, decoded.digest) == (KEY, LAYER, encoded.digest)
    check_canonical_history(encoded.data)


@given(st.one_of(HISTORIES, SIGNED_HISTORIES))
def test_a_second_decoder_agrees(history: CellHistory) -> None:
    encoded = encode_history(KEY, history, LAYER)
    header, rows = naive_history.decode_history(encoded.data)
    assert rows == as_naive(history)
    assert header == {"layer": "evidence", "epoch_s": 120, "cell": (-1, 0, 2), "digest": encoded.digest}


@given(st.integers(0, 10**6))
def test_the_digest_is_the_same_in_both_profiles(seed: int) -> None:
    history = random_history(seed)
    fast, small = (encode_history(KEY, history, LAYER, profile=profile) for profile in Profile)
    assert fast.digest == small.digest
    assert fast.data != small.data


def test_digests_differ_by_layer_epoch_and_cell() -> None:
    row = random_evidence(1, SMALL)
    histories = [cell_history({Epoch(n): row}) for n in (BASE, 0, 1)]
    layers = [LAYER, MapLayer(geometry=SMALL, epoch_s=60), MapLayer(geometry=SMALL, epoch_s=120, name="radar")]
    digests = {
        encode_history(key, history, layer).digest
        for history in histories
        for layer in layers
        for key in (KEY, cell_key((0, 0, 0)))
    }
    assert len(digests) == 18


def test_rows_are_split_off_as_cells_of_version_1_and_joined_again() -> None:
    history = random_history(3)
    data = encode_history(KEY, history, LAYER).data
    file = split_history(data)
    assert {epoch: decode_cell(row).evidence for epoch, row in file.rows.items()} == dict(history.rows)
    assert join_history(file) == data
    assert all(row == encode_cell(KEY, history.rows[epoch], SMALL).data for epoch, row in file.rows.items())


def test_a_row_of_another_cell_or_geometry_is_not_joined() -> None:
    for row in (
        encode_cell(cell_key((0, 0, 0)), random_evidence(1, SMALL), SMALL).data,
        encode_cell(KEY, random_evidence(1, PLAIN), PLAIN).data,
    ):
        with pytest.raises(BadInputError, match="another cell or geometry"):
            join_history(HistoryFile(KEY, LAYER, {BASE: row}))


def test_a_layer_without_epochs_is_not_written_in_version_2() -> None:
    with pytest.raises(BadInputError, match="format version 1"):
        encode_history(KEY, NOTHING, MapLayer(geometry=SMALL))


@given(st.integers(0, len(CELL) - 1), st.integers(0, 7))
def test_flipped_bits_raise_or_read_otherwise(at: int, bit: int) -> None:
    flipped = bytearray(CELL)
    flipped[at] ^= 1 << bit
    try:
        decoded = decode_history(bytes(flipped))
    except CairnError:
        return
    assert decoded.digest != decode_history(CELL).digest or decoded.history == decode_history(CELL).history


@given(st.integers(0, len(CELL) - 1))
def test_cut_bytes_are_refused(size: int) -> None:
    with pytest.raises(DamagedDataError):
        decode_history(CELL[:size])


def _with_row(*fields: int) -> bytes:
    return CELL[:HEAD_BYTES] + ROW_HEAD.pack(*fields) + CELL[HEAD_BYTES + ROW_HEAD.size :]


@pytest.mark.parametrize(
    "data",
    [
        CELL + b"\0",
        _with_row(1 << 62, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[1:]),
        _with_row(-(1 << 62), *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[1:]),
        _with_row(1000, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[1:]),
        _with_row(BASE, 0, 0, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[3:]),
        _with_row(BASE, 600, 600, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[3:]),
        _with_row(BASE, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[1:3], 2, *ROW_HEAD.unpack_from(CELL, HEAD_BYTES)[4:]),
        CELL[:7] + b"\2" + CELL[8:],
    ],
    ids=["left over", "epoch 2^62", "epoch -2^62", "out of order", "empty", "too many voxels", "row flag", "head flag"],
)
def test_rows_that_contradict_are_refused(data: bytes) -> None:
    with pytest.raises(DamagedDataError) as caught:
        decode_history(data)
    assert caught.value.kind == "bad_cell"


def test_more_rows_than_allowed_are_refused_by_the_head_alone() -> None:
    head = [*FIXED_PART.unpack_from(CELL)]
    head[10] = (1 << 16) + 1
    with pytest.raises(BadInputError, match="65536 rows"):
        decode_history(FIXED_PART.pack(*head) + CELL[FIXED_PART.size :])


@pytest.mark.parametrize("version", [1, 3])
def test_other_versions_are_unknown(version: int) -> None:
    with pytest.raises(BadInputError) as caught:
        decode_history(CELL[:4] + struct.pack("B", version) + CELL[5:])
    assert caught.value.kind == "unknown_version"


def test_a_version_1_reader_refuses_a_cell_with_epochs() -> None:
    with pytest.raises(BadInputError) as caught:
        decode_cell(CELL)
    assert caught.value.kind == "unknown_version"


def test_all_rows_share_one_bound_of_memory() -> None:
    one = cell_history({Epoch(0): random_evidence(1, SMALL)})
    two = cell_history({Epoch(n): random_evidence(1, SMALL) for n in range(2)})
    bound = one.size_bytes * 3 // 2
    assert decode_history(encode_history(KEY, one, LAYER).data, evidence_bytes_max=bound).history == one
    with pytest.raises(BadInputError) as caught:
        decode_history(encode_history(KEY, two, LAYER).data, evidence_bytes_max=bound)
    assert caught.value.kind == "too_large"


def test_what_is_reserved_for_maps_that_let_old_rows_go_is_of_an_unknown_version() -> None:
    data = bytearray(encode_history(KEY, random_history(1), LAYER).data)
    data[7] |= 1
    with pytest.raises(BadInputError) as caught:
        split_history(bytes(data))
    assert caught.value.kind == "unknown_version"
