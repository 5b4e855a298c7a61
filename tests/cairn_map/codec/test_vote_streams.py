"""Votes for classes as bytes: lossless, canonical, as FORMAT.md says, and refused where they contradict themselves."""

import struct

import numpy as np
import pytest
from tests.fixtures.map.classed import CLASSED, MANY, classed_evidence

from cairn_map.codec.cell_code import Profile, decode_canonical_cell, decode_cell, encode_cell
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.history_code import decode_history, encode_history
from cairn_map.codec.octree.streams import StoredStream, join_streams
from cairn_map.codec.octree.vote_streams import decode_votes_into, encode_votes
from cairn_map.epochs.cell_history import cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.brick_cell import difference
from cairn_map.evidence.grid import Geometry, cell_key

KEY = cell_key((-1, 0, 2))
PAIRS, CLASSES, VOTES = 18, 19, 20


@pytest.mark.parametrize("geometry", [CLASSED, MANY], ids=["four", "64"])
@pytest.mark.parametrize("profile", Profile)
def test_decoding_undoes_encoding(geometry: Geometry, profile: Profile) -> None:
    for seed in range(5):
        evidence = classed_evidence(seed, geometry, voxels=1 + 20 * seed)
        encoded = encode_cell(KEY, evidence, geometry, profile=profile)
        found = decode_canonical_cell(encoded.data)
        assert (found.geometry, found.evidence, found.digest) == (geometry, evidence, encoded.digest)
        change = difference(evidence, classed_evidence(seed + 9, geometry), geometry)
        assert decode_canonical_cell(encode_cell(KEY, change, geometry).data).evidence == change


def test_rows_of_epochs_hold_their_votes() -> None:
    layer = MapLayer(geometry=CLASSED, epoch_s=120)
    history = cell_history({BASE: classed_evidence(1, CLASSED), Epoch(3): classed_evidence(2, CLASSED)})
    found = decode_history(encode_history(KEY, history, layer).data)
    assert (found.layer, found.history) == (layer, history)


def test_only_votes_that_are_there_are_written() -> None:
    sums = np.array([[0, 3, 0], [0, 0, 0], [300, 0, 1]])
    streams = encode_votes(PAIRS, sums, signed=False)
    assert streams == {
        PAIRS: bytes([1, 1, 0, 2]),
        CLASSES: bytes([1, 1, 0, 2]),
        VOTES: bytes([2, 3, 300 & 255, 1, 0, 300 >> 8, 0]),
    }
    # The first rows alone, as a part of a cell is read.
    part = np.zeros((2, 3), np.int64)
    decode_votes_into(part, PAIRS, streams, rows=3, signed=False)
    assert part.tolist() == sums[:2].tolist()


def test_the_head_states_the_names() -> None:
    data = encode_cell(KEY, classed_evidence(1, CLASSED), CLASSED).data
    text = b"\x04\x04wall\x05floor\x05chair\x05other"
    assert struct.pack("<BBB", 5, 7, 0) + b"classes" + struct.pack("<dd", 1.0, 0.0) + text in data
    for wrong in (b"\x05" + text[1:], text.replace(b"wall", b"Wall"), text.replace(b"\x05chair", b"\xffchair")):
        with pytest.raises(DamagedDataError):
            decode_cell(data.replace(text, wrong))


@pytest.mark.parametrize(
    "streams",
    [
        {PAIRS: bytes([1, 4, 0, 0]), CLASSES: bytes([1, 0, 1, 2, 3]), VOTES: bytes([1, 1, 1, 1, 1])},
        {PAIRS: bytes([1, 1, 0, 0]), CLASSES: bytes([1, 3]), VOTES: bytes([1, 1])},
        {PAIRS: bytes([1, 2, 0, 0]), CLASSES: bytes([1, 1, 1]), VOTES: bytes([1, 1, 1])},
        {PAIRS: bytes([1, 2, 0, 0]), CLASSES: bytes([1, 2, 1]), VOTES: bytes([1, 1, 1])},
        {PAIRS: bytes([1, 1, 0, 0]), CLASSES: bytes([0]), VOTES: bytes([1, 0])},
        {PAIRS: bytes([1, 1, 0, 0]), CLASSES: bytes([0]), VOTES: bytes([8, *[255] * 8])},
        {PAIRS: bytes([1, 1, 0, 0]), CLASSES: bytes([0]), VOTES: bytes([0, 0])},
        {PAIRS: bytes([2, 1, 0, 0, 0, 0, 0]), CLASSES: bytes([0]), VOTES: bytes([1, 1])},
        {PAIRS: bytes([1, 1, 0]), CLASSES: bytes([0]), VOTES: bytes([1, 1])},
        {PAIRS: bytes([1, 1, 0, 0]), VOTES: bytes([1, 1])},
    ],
)
@pytest.mark.parametrize("signed", [False, True])
def test_votes_that_cannot_be_are_refused(streams: dict[int, bytes], signed: bool) -> None:
    with pytest.raises(DamagedDataError):
        decode_votes_into(np.zeros((3, 3), np.int64), PAIRS, streams, rows=3, signed=signed)


def test_votes_have_no_model_and_no_byte_can_be_cut_off_or_flipped_unseen() -> None:
    data = encode_cell(KEY, classed_evidence(1, CLASSED), CLASSED).data
    reader = cell_reader(data)
    modelled = {16: b"." * 200}
    group = {n: StoredStream(n, 2, s.raw_bytes, modelled.get(n, b"")) for n, s in reader.stored.items() if n >= 16}
    with pytest.raises(DamagedDataError, match="no model"):
        decode_cell(reader.head_bytes + join_streams([*(reader.stored | group).values()]))
    whole = decode_canonical_cell(data)
    for at in range(len(reader.head_bytes), len(data)):
        with pytest.raises((DamagedDataError, BadInputError)):
            decode_cell(data[:at])
        try:
            flipped = decode_canonical_cell(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        except (DamagedDataError, BadInputError):
            continue
        assert (flipped.digest == whole.digest) == (flipped.evidence == whole.evidence)
