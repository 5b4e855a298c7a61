"""The paper's octree with pointers: what goes in comes out, and what goes in is what the evidence says."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.made import KEY, MIDDLE, PLAIN, SMALL, as_dict, random_evidence

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.evidence import empty_evidence
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel, log_odds
from cairn_sim.experiment.pointer_octree import (
    FIELDS,
    HEAD,
    NO_TEMPERATURE,
    NODE,
    OccupiedVoxels,
    decode_pointer_octree,
    encode_pointer_octree,
    occupied_voxels,
)

MODEL = SensorModel()


def made_voxels(depth: int, places: list[int], seed: int) -> OccupiedVoxels:
    rng = np.random.default_rng(seed)
    fields = np.frombuffer(rng.bytes(FIELDS.itemsize * len(places)), FIELDS)
    return OccupiedVoxels(depth, np.array(sorted(places), np.uint32), fields)


def assert_equal(one: OccupiedVoxels, other: OccupiedVoxels) -> None:
    assert one.depth == other.depth
    assert np.array_equal(one.places, other.places)
    assert one.fields.tobytes() == other.fields.tobytes()


@st.composite
def any_voxels(draw: st.DrawFn) -> OccupiedVoxels:
    depth = draw(st.integers(1, 8))
    places = draw(st.lists(st.integers(0, 8**depth - 1), unique=True, max_size=60))
    run = draw(st.integers(0, 8 ** (depth - 1) - 1))
    return made_voxels(
        depth, sorted({*places, *range(8 * run, 8 * run + draw(st.integers(0, 8)))}), draw(st.integers(0, 9))
    )


@settings(deadline=None)
@given(any_voxels())
def test_decode_undoes_encode(voxels: OccupiedVoxels) -> None:
    assert_equal(decode_pointer_octree(encode_pointer_octree(voxels)), voxels)


@pytest.mark.parametrize("geometry", [SMALL, MIDDLE, PLAIN], ids=["small", "middle", "plain"])
@pytest.mark.parametrize("seed", range(3))
def test_fields_are_what_the_counts_and_sums_mean(geometry: Geometry, seed: int) -> None:
    evidence = random_evidence(seed, geometry, voxels=300)
    voxels = occupied_voxels(KEY, evidence, geometry, MODEL)
    expected: dict[int, tuple[int, tuple[int, ...], int]] = {}
    for place, (hits, misses, sums) in as_dict(evidence).items():
        p = hits * log_odds(0.7) + misses * log_odds(0.4)
        if p > 0:
            p = min(max(p, log_odds(0.12)), log_odds(0.97))
            expected[place] = (round(1000 * p), (0, 0, 0), NO_TEMPERATURE)
            if geometry.plane_count:
                red, green, blue, weight = sums[geometry.planes_of("colour")]
                rgb = tuple(min(255, round(value / weight)) for value in (red, green, blue)) if weight else (0, 0, 0)
                total, _, heat_weight = sums[geometry.planes_of("temperature")]
                kelvin = total / heat_weight * 0.05 if heat_weight else None
                centi_c = NO_TEMPERATURE if kelvin is None else round((kelvin - 273.15) * 100)
                expected[place] = (expected[place][0], rgb, centi_c)
    assert len(expected) > 5
    assert voxels.places.tolist() == sorted(expected)
    for place, row in zip(voxels.places.tolist(), voxels.fields, strict=True):
        p_steps, rgb, centi_c = expected[place]
        assert abs(int(row["log_odds"]) - p_steps) <= 1
        assert tuple(row["rgb"].tolist()) == rgb
        assert abs(int(row["temperature"]) - centi_c) <= 1
        assert row["pad"] == 0


def test_records_have_the_sizes_that_the_module_states() -> None:
    assert (FIELDS.itemsize, NODE.itemsize) == (8, 5)
    one = zlib.decompress(encode_pointer_octree(made_voxels(7, [12345], 0)))
    assert len(one) == HEAD.size + 7 * 5 + 8
    brick = zlib.decompress(encode_pointer_octree(made_voxels(7, list(range(512)), 0)))
    assert len(brick) == HEAD.size + (4 + 1 + 8 + 64) * 5 + 512 * 8


def test_a_reader_that_follows_the_pointers_finds_the_same_voxels() -> None:
    voxels = made_voxels(4, [0, 1, 9, 700, 701, 4095], 1)
    raw = zlib.decompress(encode_pointer_octree(voxels))
    _, depth, nodes, _ = HEAD.unpack_from(raw)

    def walk(node: int, place: int, left: int) -> list[tuple[int, bytes]]:
        if left == 0:
            at = HEAD.size + 5 * nodes + 8 * (node - nodes)
            return [(place, raw[at : at + 8])]
        mask, child = struct.unpack_from("<BI", raw, HEAD.size + 5 * node)
        found = []
        for octant in range(8):
            if mask >> octant & 1:
                found += walk(child, 8 * place + octant, left - 1)
                child += 1
        return found

    expected = [(int(place), row.tobytes()) for place, row in zip(voxels.places, voxels.fields, strict=True)]
    assert walk(0, 0, depth) == expected


def test_a_cell_without_obstacles_has_no_node() -> None:
    voxels = occupied_voxels(KEY, empty_evidence(MIDDLE), MIDDLE, MODEL)
    data = encode_pointer_octree(voxels)
    assert len(zlib.decompress(data)) == HEAD.size
    assert_equal(decode_pointer_octree(data), voxels)


def test_damaged_bytes_are_refused() -> None:
    data = encode_pointer_octree(made_voxels(5, [3, 4, 999, 20_000], 2))
    raw = zlib.decompress(data)
    for cut in range(len(data)):
        with pytest.raises(DamagedDataError):
            decode_pointer_octree(data[:cut])
    with pytest.raises(DamagedDataError):
        decode_pointer_octree(data + b"x")
    nodes = HEAD.unpack_from(raw)[2]
    for at in range(HEAD.size + NODE.itemsize * nodes):  # in leaves every pattern of bits is a voxel
        for bit in (1, 16, 128):
            flipped = bytearray(raw)
            flipped[at] ^= bit
            with pytest.raises(DamagedDataError):
                decode_pointer_octree(zlib.compress(bytes(flipped)))
