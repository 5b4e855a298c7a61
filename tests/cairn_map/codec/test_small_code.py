"""Modelled streams, profile small: against a twin written from the page, and their laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.lengths import length
from tests.fixtures.map.made import (
    DOSE,
    GEOMETRIES,
    KEY,
    MIDDLE,
    PLAIN,
    SMALL,
    any_evidence,
    as_dict,
    header_of,
    surface_evidence,
)
from tests.fixtures.map.stored import GROUPS, bodies_of, recoded, with_streams
from tests.fixtures.map.strategies import RANDOM, SIXTEEN, SMOOTH, WARM, Made
from tests.naive import cell_code as naive_cell_code

from cairn_map.codec.cell_code import Profile, decode_canonical_cell, decode_cell, encode_cell, recompressed_cell
from cairn_map.codec.octree.streams import MODELLED
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.channels import INTENSITY
from cairn_map.evidence.evidence import COUNT_MAX, SUM_MAX, Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.grid import Geometry

CELL = (-1, 0, 2)
DEEP = Geometry(depth=8, channels=(INTENSITY, DOSE))
ALL = (*GEOMETRIES, SIXTEEN, WARM, DEEP)
EXTREME = st.sampled_from(ALL).flatmap(lambda geometry: st.tuples(any_evidence(geometry), st.just(geometry)))


def full_evidence(geometry: Geometry) -> Evidence:
    """Every voxel was hit and has samples."""
    V, rng = 8**geometry.depth, np.random.default_rng(3)
    counts = rng.integers(1, 4, (V, 2))
    samples = rng.integers(1, 9, (V, geometry.plane_count)) * 20
    return packed_evidence(np.arange(V, dtype=np.uint32), counts, samples, geometry)


# --- The twin ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=length(25, long=50))
@given(st.one_of(RANDOM, SMOOTH))
def test_the_twin_reads_and_writes_the_same_bytes(made: Made) -> None:
    evidence, geometry = made
    encoded = encode_cell(KEY, evidence, geometry, profile=Profile.SMALL)
    header, voxels = naive_cell_code.decode_cell(encoded.data)
    assert voxels == as_dict(evidence)
    assert header["digest"] == encoded.digest
    groups = naive_cell_code.modelled_groups(header_of(geometry, CELL), as_dict(evidence))
    for number, stream in bodies_of(encoded.data).items():
        if stream.coding == MODELLED:
            assert stream.body == groups.get(number, b"")


@pytest.mark.slow
@settings(max_examples=length(25, long=50))
@given(st.one_of(EXTREME, RANDOM))
def test_what_the_twin_writes_of_anything_is_read(made: Made) -> None:
    """Evidence with extremes, which the real encoder finds no shorter than they are and leaves raw."""
    evidence, geometry = made
    data, digest = naive_cell_code.encode_modelled_cell(header_of(geometry, CELL), as_dict(evidence))
    decoded = decode_canonical_cell(data)
    assert decoded.evidence == evidence
    assert decoded.digest == digest == encode_cell(KEY, evidence, geometry).digest
    assert naive_cell_code.decode_cell(data)[1] == as_dict(evidence)


@pytest.mark.slow
def test_the_twin_agrees_on_a_larger_surface() -> None:
    evidence = surface_evidence(5, MIDDLE)
    encoded = encode_cell(KEY, evidence, MIDDLE, profile=Profile.SMALL)
    assert naive_cell_code.encode_modelled_cell(header_of(MIDDLE, CELL), as_dict(evidence)) == (
        encoded.data,
        encoded.digest,
    )
    assert naive_cell_code.decode_cell(encoded.data)[1] == as_dict(evidence)


@pytest.mark.parametrize("large", [1, 300, (1 << 16) - 1, 1 << 16, (1 << 40) - 1, 1 << 40, SUM_MAX - 1, SUM_MAX])
def test_the_twin_agrees_beside_large_numbers(large: int) -> None:
    """A few weights and sums at the bounds behind which nothing is guessed, among small ones."""
    rng = np.random.default_rng(large % 1000)
    evidence = surface_evidence(1, SMALL)
    samples, counts = evidence.samples.copy(), evidence.counts.copy()
    samples[rng.random(samples.shape) < 0.1] = large
    samples[rng.random(samples.shape) < 0.1] = 0
    counts[rng.random(counts.shape) < 0.02] = min(large, COUNT_MAX)
    places = evidence.voxels
    full = np.zeros((len(places), SMALL.plane_count), np.int64)
    full[evidence.sampled] = samples
    changed = packed_evidence(places, counts, full, SMALL)
    data, digest = naive_cell_code.encode_modelled_cell(header_of(SMALL, CELL), as_dict(changed))
    decoded = decode_canonical_cell(data)
    assert (decoded.evidence, decoded.digest) == (changed, digest)
    groups = naive_cell_code.modelled_groups(header_of(SMALL, CELL), as_dict(changed))
    modelled = [s for s in bodies_of(encode_cell(KEY, changed, SMALL, profile=Profile.SMALL).data).values() if s.body]
    assert all(stream.body == groups[stream.number] for stream in modelled if stream.coding == MODELLED)


# --- Laws -------------------------------------------------------------------------------------------------------


@given(st.one_of(RANDOM, SMOOTH, EXTREME))
def test_decoding_undoes_encoding_and_the_digest_is_that_of_the_fast_profile(made: Made) -> None:
    evidence, geometry = made
    small = encode_cell(KEY, evidence, geometry, profile=Profile.SMALL)
    fast = encode_cell(KEY, evidence, geometry)
    decoded = decode_canonical_cell(small.data)
    assert (decoded.evidence, decoded.key, decoded.geometry) == (evidence, KEY, geometry)
    assert decoded.digest == small.digest == fast.digest
    assert len(small.data) <= len(fast.data)


@given(st.one_of(RANDOM, SMOOTH, EXTREME))
def test_a_cell_compressed_anew_is_the_cell_that_was(made: Made) -> None:
    evidence, geometry = made
    small, fast = (
        encode_cell(KEY, evidence, geometry, profile=profile).data for profile in (Profile.SMALL, Profile.FAST)
    )
    assert recompressed_cell(fast, profile=Profile.SMALL) == small
    assert recompressed_cell(small, profile=Profile.FAST) == fast
    assert recompressed_cell(small, profile=Profile.SMALL) == small


@pytest.mark.parametrize("geometry", [SMALL, PLAIN, MIDDLE, WARM, SIXTEEN])
def test_a_surface_is_modelled_throughout_and_smaller(geometry: Geometry) -> None:
    evidence = surface_evidence(2, geometry)
    small = encode_cell(KEY, evidence, geometry, profile=Profile.SMALL).data
    assert {stream.coding for stream in bodies_of(small).values()} == {MODELLED}
    assert len(small) < 0.75 * len(encode_cell(KEY, evidence, geometry).data)
    assert decode_cell(small).evidence == evidence


@pytest.mark.parametrize("geometry", [SMALL, PLAIN, Geometry(depth=4), SIXTEEN])
def test_a_full_cell_comes_back(geometry: Geometry) -> None:
    evidence = full_evidence(geometry)
    small = encode_cell(KEY, evidence, geometry, profile=Profile.SMALL).data
    assert {stream.coding for stream in bodies_of(small).values()} >= {MODELLED}
    assert decode_canonical_cell(small).evidence == evidence


@pytest.mark.parametrize("geometry", ALL)
@pytest.mark.parametrize("place", ["first", "last"])
def test_one_voxel_comes_back(geometry: Geometry, place: str) -> None:
    at = np.array([0 if place == "first" else 8**geometry.depth - 1], np.uint32)
    evidence = packed_evidence(at, np.array([[1, 2]]), np.full((1, geometry.plane_count), 7), geometry)
    data, _ = naive_cell_code.encode_modelled_cell(header_of(geometry, CELL), as_dict(evidence))
    for cell in (data, encode_cell(KEY, evidence, geometry, profile=Profile.SMALL).data):
        assert decode_canonical_cell(cell).evidence == evidence


@pytest.mark.parametrize("geometry", ALL)
def test_an_empty_cell_comes_back(geometry: Geometry) -> None:
    nothing = empty_evidence(geometry)
    modelled, _ = naive_cell_code.encode_modelled_cell(header_of(geometry, CELL), {})
    for cell in (modelled, encode_cell(KEY, nothing, geometry, profile=Profile.SMALL).data):
        assert decode_canonical_cell(cell).evidence == nothing


def test_a_deep_cell_is_modelled() -> None:
    """2^24 places, leaves of every size, surfaces far apart."""
    part = surface_evidence(4, Geometry(depth=5, channels=DEEP.channels))
    cube = np.arange(64**3, dtype=np.uint32) + np.uint32(3 * 64**3)
    places = np.concatenate([part.voxels, part.voxels + np.uint32(8**8 - 8**5), cube])
    counts = np.concatenate([part.counts, part.counts, np.tile([[0, 4]], (len(cube), 1))])
    samples = np.zeros((len(places), DEEP.plane_count), np.int64)
    samples[part.sampled] = samples[part.sampled + np.uint32(len(part))] = part.samples
    evidence = packed_evidence(places, counts, samples, DEEP)
    small = encode_cell(KEY, evidence, DEEP, profile=Profile.SMALL)
    assert {stream.coding for stream in bodies_of(small.data).values()} == {MODELLED}
    assert decode_canonical_cell(small.data).evidence == evidence


# --- Signed cells -----------------------------------------------------------------------------------------------


@given(any_evidence(SMALL, low=-SUM_MAX))
def test_a_signed_cell_is_never_modelled(evidence: Evidence) -> None:
    cell = encode_cell(KEY, evidence, SMALL, profile=Profile.SMALL)
    if evidence.is_signed:
        assert cell == encode_cell(KEY, evidence, SMALL)
        assert MODELLED not in {stream.coding for stream in bodies_of(cell.data).values()}


def test_a_signed_realistic_cell_is_not_modelled_either() -> None:
    made = surface_evidence(1, SMALL)
    signed = Evidence(made.voxels, -made.counts, made.sampled, -made.samples)
    cell = encode_cell(KEY, signed, SMALL, profile=Profile.SMALL).data
    assert MODELLED not in {stream.coding for stream in bodies_of(cell).values()}
    assert decode_cell(cell).evidence == signed


@pytest.mark.parametrize("first", GROUPS)
def test_a_modelled_signed_cell_is_refused(first: int) -> None:
    """Each group alone: what is not modelled is raw, so nothing else is wrong with it."""
    evidence = surface_evidence(1, SMALL)
    small, raw = (
        encode_cell(KEY, evidence, SMALL, profile=Profile.SMALL).data,
        recoded(encode_cell(KEY, evidence, SMALL).data, level=None),
    )
    mixed = bytearray(with_streams(raw, *(bodies_of(small)[number] for number in GROUPS[first])))
    assert decode_cell(bytes(mixed)).evidence == evidence
    mixed[7] |= 1
    with pytest.raises(DamagedDataError, match="modelled in part, or in a signed cell"):
        decode_cell(bytes(mixed))
