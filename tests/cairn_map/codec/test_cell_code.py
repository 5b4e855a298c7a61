"""A cell's evidence to bytes and back, against the slow second codec."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import (
    GEOMETRIES,
    KEY,
    MIDDLE,
    PLAIN,
    SMALL,
    any_evidence,
    as_dict,
    header_of,
    random_evidence,
)
from tests.fixtures.map.stored import recoded
from tests.naive import cell_code as naive_cell_code

from cairn_map.codec.cell_code import decode_canonical_cell, decode_cell, decode_met, encode_cell
from cairn_map.codec.octree.octree import build_octree
from cairn_map.codec.octree.streams import HEAD
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.brick_cell import difference
from cairn_map.evidence.evidence import SUM_MAX, Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key

CELLS = st.tuples(*[st.integers(-(1 << 20), (1 << 20) - 1)] * 3)
MADE = st.builds(
    lambda seed, geometry: (random_evidence(seed, geometry), geometry),
    st.integers(0, 10**6),
    st.sampled_from(GEOMETRIES),
)
SIGNED = any_evidence(SMALL, low=-SUM_MAX)


@given(MADE, CELLS)
def test_decoding_undoes_encoding(made: tuple[Evidence, Geometry], cell: tuple[int, int, int]) -> None:
    evidence, geometry = made
    encoded = encode_cell(cell_key(cell), evidence, geometry)
    decoded = decode_cell(encoded.data)
    assert decoded.evidence == evidence
    assert (decoded.key, decoded.geometry, decoded.digest) == (cell_key(cell), geometry, encoded.digest)


@given(MADE)
def test_what_was_met_is_all_that_was_hit_or_sampled(made: tuple[Evidence, Geometry]) -> None:
    evidence, geometry = made
    encoded = encode_cell(KEY, evidence, geometry)
    met = decode_met(encoded.data)
    is_sampled = np.isin(np.arange(len(evidence)), evidence.sampled)
    rows = np.nonzero((evidence.counts[:, 0] != 0) | is_sampled)[0]
    assert met.digest == encoded.digest
    assert met.evidence.voxels.tolist() == evidence.voxels[rows].tolist()
    assert met.evidence.counts.tolist() == evidence.counts[rows].tolist()
    assert rows[met.evidence.sampled].tolist() == evidence.sampled.tolist()
    assert met.evidence.samples.tolist() == evidence.samples.tolist()


@given(SIGNED)
def test_numbers_of_any_size_and_sign_come_back(evidence: Evidence) -> None:
    assert decode_canonical_cell(encode_cell(KEY, evidence, SMALL).data).evidence == evidence


@given(st.integers(0, 1000), st.integers(0, 1000))
def test_differences_come_back(a: int, b: int) -> None:
    signed = difference(random_evidence(a, MIDDLE), random_evidence(b, MIDDLE), MIDDLE)
    assert decode_cell(encode_cell(KEY, signed, MIDDLE).data).evidence == signed


@given(st.one_of(MADE, st.tuples(SIGNED, st.just(SMALL))))
def test_the_second_decoder_agrees(made: tuple[Evidence, Geometry]) -> None:
    evidence, geometry = made
    encoded = encode_cell(KEY, evidence, geometry)
    header, voxels = naive_cell_code.decode_cell(encoded.data)
    assert voxels == as_dict(evidence)
    assert header["digest"] == encoded.digest
    assert header | header_of(geometry, (-1, 0, 2)) == header
    assert header["signed"] == evidence.is_signed


@given(st.one_of(MADE, st.tuples(SIGNED, st.just(SMALL))))
def test_the_second_encoder_agrees(made: tuple[Evidence, Geometry]) -> None:
    evidence, geometry = made
    data, digest = naive_cell_code.encode_cell(header_of(geometry, (-1, 0, 2)), as_dict(evidence))
    assert digest == encode_cell(KEY, evidence, geometry).digest
    assert data == recoded(encode_cell(KEY, evidence, geometry).data, level=None)


@pytest.mark.parametrize("level", [None, 1, 9, 19])
def test_bytes_compressed_anew_keep_their_digest(level: int | None) -> None:
    encoded = encode_cell(KEY, random_evidence(4, MIDDLE, voxels=2000), MIDDLE)
    other = recoded(encoded.data, level=level)
    assert other != encoded.data
    assert decode_canonical_cell(other).digest == encoded.digest


def test_an_empty_cell_is_a_cell() -> None:
    for geometry in GEOMETRIES:
        decoded = decode_canonical_cell(encode_cell(KEY, empty_evidence(geometry), geometry).data)
        assert decoded.evidence == empty_evidence(geometry)


def test_a_full_cell_of_equal_air_is_eight_leaves() -> None:
    counts = np.tile(np.array([0, 1]), (512, 1))
    evidence = packed_evidence(np.arange(512, dtype=np.uint32), counts, np.zeros((512, 0), np.int64), PLAIN)
    octree, rows = build_octree(evidence, depth=3)
    assert octree.child_masks.tolist() == [255]
    assert rows.tolist() == list(range(0, 512, 64))
    assert decode_cell(encode_cell(KEY, evidence, PLAIN).data).evidence == evidence


def test_a_voxel_with_samples_never_collapses() -> None:
    samples = np.zeros((8, SMALL.plane_count), np.int64)
    samples[5, 3] = 1
    evidence = packed_evidence(np.arange(8, dtype=np.uint32), np.ones((8, 2), np.int64), samples, SMALL)
    assert len(build_octree(evidence, depth=3)[1]) == 8


def test_the_cell_number_and_the_geometry_are_part_of_the_digest() -> None:
    evidence = random_evidence(1, PLAIN)
    other = Geometry(voxel_edge_um=50_001, depth=3, channels=())
    digests = {encode_cell(KEY, evidence, PLAIN).digest, encode_cell(KEY, evidence, other).digest}
    assert len(digests | {encode_cell(cell_key((0, 0, 0)), evidence, PLAIN).digest}) == 3


def uncollapsed_air() -> bytes:
    """Eight equal leaves where one would do: sound, and not canonical."""
    head = struct.pack("<4sBBBBIiiiIIBB", b"CRNC", 1, 1, 3, 0, 50_000, 0, 0, 0, 8, 8, 0, 4)
    streams = {1: b"\x01\x01\xff", 2: b"\x00\x00", 3: b"\x00", 4: b"\x01" + b"\x01" * 8}
    return head + b"".join(HEAD.pack(number, 0, len(raw), len(raw)) + raw for number, raw in streams.items())


def wide_column() -> bytes:
    """A column with one plane more than it needs."""
    data = encode_cell(KEY, random_evidence(1, PLAIN, voxels=1, air=0), PLAIN).data
    at = data.rindex(HEAD.pack(4, 0, 2, 2))
    return data[:at] + HEAD.pack(4, 0, 3, 3) + b"\x02" + data[-1:] + b"\x00"


@pytest.mark.parametrize("data", [uncollapsed_air(), wide_column()], ids=["uncollapsed", "wide column"])
def test_bytes_that_are_not_canonical_decode_but_are_refused_where_it_matters(data: bytes) -> None:
    assert len(decode_cell(data).evidence)
    with pytest.raises(DamagedDataError) as refused:
        decode_canonical_cell(data)
    assert refused.value.kind == "not_canonical"


def test_evidence_of_another_geometry_is_not_encoded() -> None:
    with pytest.raises(BadInputError, match="does not fit"):
        encode_cell(KEY, random_evidence(1, MIDDLE), SMALL)
    with pytest.raises(BadInputError, match="does not fit"):
        encode_cell(KEY, random_evidence(1, Geometry(depth=6, channels=())), PLAIN)


@pytest.mark.parametrize(("at", "value"), [(4, 0), (4, 2), (5, 0), (5, 2), (5, 4), (5, 5), (5, 255)])
def test_other_versions_and_reserved_kinds_are_refused_as_unknown(at: int, value: int) -> None:
    data = bytearray(encode_cell(KEY, random_evidence(1, PLAIN), PLAIN).data)
    data[at] = value
    with pytest.raises(BadInputError) as refused:
        decode_cell(bytes(data))
    assert refused.value.kind == "unknown_version"


def test_a_reader_may_set_how_much_evidence_it_takes() -> None:
    evidence = random_evidence(1, SMALL)
    data = encode_cell(KEY, evidence, SMALL).data
    assert decode_cell(data, evidence_bytes_max=evidence.size_bytes).evidence == evidence
    for limit in (evidence.size_bytes - 1, 12 * len(evidence) - 1, 0):
        with pytest.raises(BadInputError) as refused:
            decode_cell(data, evidence_bytes_max=limit)
        assert refused.value.kind == "too_large"
