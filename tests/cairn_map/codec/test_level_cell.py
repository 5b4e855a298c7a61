"""Cells of flat voxels: bytes of kind 3, with epochs and without; cubes keep the bytes and digests that they had."""

import json
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import random_evidence

from cairn_map.codec.cell_code import (
    Profile,
    decode_canonical_cell,
    decode_cell,
    encode_cell,
    encode_empty_cell,
    recompressed_cell,
)
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.history_code import check_canonical_history, decode_history, encode_history
from cairn_map.codec.octree.cell_head import HEIGHT_STEP
from cairn_map.codec.octree.streams import MODELLED, join_streams, stored_streams
from cairn_map.codec.plain_cell import plain_bytes
from cairn_map.epochs.cell_history import cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.errors import CairnError
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Geometry, cell_key, geometry_for, level_geometry

LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=3, channels=(HEIGHT_OFFSET,))
CUBES = Geometry(voxel_edge_um=200_000, depth=3, channels=(HEIGHT_OFFSET,))
KEY = cell_key((-1, 0, 2))


@pytest.mark.parametrize("profile", Profile)
def test_a_cell_is_read_as_it_was_written_and_is_longer_than_one_of_cubes_by_the_height(profile: Profile) -> None:
    evidence = random_evidence(1, LEVEL)
    flat, cubes = (encode_cell(KEY, evidence, grid, profile=profile) for grid in (LEVEL, CUBES))
    found = decode_canonical_cell(flat.data)
    assert (found.key, found.geometry, found.evidence, found.digest) == (KEY, LEVEL, evidence, flat.digest)
    assert flat.data[:5] + b"\1" + flat.data[6:34] == cubes.data[:34]
    assert flat.data[34:38] == HEIGHT_STEP.pack(50_000)
    raw, raw_of_cubes = (
        {number: stream.raw() for number, stream in cell_reader(cell.data).stored.items() if stream.coding != MODELLED}
        for cell in (flat, cubes)
    )
    assert raw.items() <= raw_of_cubes.items()


def votes(seed: int) -> Evidence:
    """Votes as scans give them: of nearly all voxels the weight is the hits."""
    rng = np.random.default_rng(seed)
    hits = rng.integers(1, 9, 300)
    weights = np.where(rng.random(300) < 0.1, 0, hits)
    samples = np.stack([rng.integers(0, 10 * weights + 1), weights], axis=1)
    places = np.sort(rng.choice(8**LEVEL.depth, 300, replace=False))
    counts = np.stack([hits, rng.integers(0, 2, 300)], axis=1).astype(np.int32)
    return packed_evidence(places, counts, samples, LEVEL)


def test_votes_are_modelled_in_both_profiles_and_bytes_from_before_are_read() -> None:
    evidence = votes(3)
    plain = plain_bytes(KEY, evidence, LEVEL)
    assert plain is not None
    before = bytes(plain.head) + join_streams(stored_streams(plain.streams))
    fast, small = (encode_cell(KEY, evidence, LEVEL, profile=profile) for profile in Profile)
    assert len(small.data) < len(fast.data) < len(before)
    codings = {number: stream.coding == MODELLED for number, stream in cell_reader(fast.data).stored.items()}
    assert codings == {1: False, 2: False, 3: False, 4: False, 16: True, 17: True, 18: True}
    for data in (before, fast.data, small.data):
        found = decode_canonical_cell(data)
        assert (found.evidence, found.digest) == (evidence, fast.digest)
    assert recompressed_cell(before, profile=Profile.FAST) == fast.data
    cubes = encode_cell(KEY, evidence, CUBES)
    assert not any(stream.coding == MODELLED for stream in cell_reader(cubes.data).stored.values())


def test_differences_and_empty_cells_are_not_modelled() -> None:
    evidence = votes(3)
    signed = replace(evidence, counts=-evidence.counts, samples=-evidence.samples)
    coded = encode_cell(KEY, signed, LEVEL)
    assert not any(stream.coding == MODELLED for stream in cell_reader(coded.data).stored.values())
    assert decode_cell(coded.data).evidence == signed
    assert encode_empty_cell(KEY, LEVEL) == encode_cell(KEY, empty_evidence(LEVEL), LEVEL).data


def test_rows_of_epochs_too() -> None:
    layer = MapLayer(geometry=LEVEL, epoch_s=60, name="ground")
    history = cell_history({BASE: random_evidence(1, LEVEL), Epoch(7): random_evidence(2, LEVEL)})
    coded = encode_history(KEY, history, layer)
    check_canonical_history(coded.data)
    found = decode_history(coded.data)
    assert (found.layer, found.history, found.digest) == (layer, history, coded.digest)
    assert coded.data[5] == 3


@settings(deadline=None)
@given(cut=st.integers(0, 400), flip=st.integers(0, 399))
def test_truncated_and_flipped_bytes_are_refused_or_another_cell(cut: int, flip: int) -> None:
    coded = encode_cell(KEY, random_evidence(1, LEVEL, voxels=10), LEVEL)
    with pytest.raises(CairnError):
        decode_cell(coded.data[: min(cut, len(coded.data) - 1)])
    flipped = bytearray(coded.data)
    flipped[flip // 8 % len(flipped)] ^= 1 << flip % 8
    with suppress(CairnError):
        assert decode_cell(bytes(flipped)).digest != coded.digest


def test_cubes_are_stated_as_they_were() -> None:
    cubes = Geometry()
    assert cubes.digest().hex() == "0259bac53f5ad08432742517b20d458add9d771410428966034cbb0daa4a1701"
    assert {*cubes.model_dump()} == {*json.loads(cubes.model_dump_json())} == {"voxel_edge_um", "depth", "channels"}
    assert "height_step_um" not in LayerDefinition(name="fine", geometry=cubes).model_dump_json()
    assert Geometry.model_validate_json(LEVEL.model_dump_json()) == LEVEL
    assert len({grid.digest() for grid in (LEVEL, CUBES, LEVEL.model_copy(update={"height_step_um": 49_000}))}) == 3


def test_the_standard_level_and_what_is_none() -> None:
    level = level_geometry()
    assert (level.depth, level.cell_edges_m) == (6, (12.8, 12.8, 3.2))
    assert str(level) == "voxels of 0.2 m and 0.05 m height, cells of 64^3, channels height"
    assert geometry_for(voxel_edge_m=0.2).depth == 4
    for fields in (
        {"channels": ()},
        {"channels": (HEIGHT_OFFSET.model_copy(update={"step": 1.0}),)},
        {"height_step_um": 200_001},
        {"height_step_um": 999},
    ):
        with pytest.raises(ValueError, match=r"flat voxels|height step|height_step_um"):
            Geometry.model_validate({"voxel_edge_um": 200_000, "height_step_um": 50_000} | fields)
    for edge_m, step_m in ((0.2, 0.3), (2.0, 0.05), (0.2, 0.0)):
        with pytest.raises(CairnError, match="height step"):
            level_geometry(voxel_edge_m=edge_m, height_step_m=step_m)


@settings(deadline=None)  # the first call compiles
@given(order=st.permutations(range(5)), out=st.integers(0, 4))
def test_evidence_adds_in_any_order_and_is_taken_out_exactly(order: list[int], out: int) -> None:
    parts = [{KEY: random_evidence(seed, LEVEL)} for seed in range(5)]
    total, less = EvidenceMap(LEVEL), EvidenceMap(LEVEL)
    for n in order:
        total.merge(parts[n])
    total.merge({KEY: replace(parts[out][KEY], counts=-parts[out][KEY].counts, samples=-parts[out][KEY].samples)})
    for n in range(5):
        if n != out:
            less.merge(parts[n])
    ((_, one),), ((_, other),) = total.packed().items(), less.packed().items()
    assert encode_cell(KEY, one, LEVEL).data == encode_cell(KEY, other, LEVEL).data
    assert fingerprint(one, KEY) == fingerprint(other, KEY)
