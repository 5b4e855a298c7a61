"""Cells held as bytes: a map that holds them is the same map, in memory that the bytes that came pay for."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.costly import air, costly_evidence, dust
from tests.fixtures.map.made import random_evidence
from tests.fixtures.map.worlds import random_points

from cairn_map.codec.cell_code import coding_of, encode_cell
from cairn_map.errors import BadInputError
from cairn_map.evidence.brick_cell import BrickCell
from cairn_map.evidence.channels import COLOUR, TEMPERATURE
from cairn_map.evidence.compact_cell import HELD_PER_BYTE, CompactCell
from cairn_map.evidence.evidence import COUNT_MAX, Evidence, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.render.camera_rays import pinhole
from cairn_map.render.map_render import MapRenderer

GRID = Geometry(voxel_edge_um=50_000, depth=5, channels=(COLOUR, TEMPERATURE))
KEYS = [cell_key((i, 0, -1)) for i in range(3)]
Step = tuple[str, CellKey, Evidence]


def body(key: CellKey, evidence: Evidence) -> bytes:
    return encode_cell(key, evidence, GRID).data


def thrifty() -> EvidenceMap:
    return EvidenceMap(GRID, coding=coding_of(GRID))


steps = st.lists(
    st.tuples(
        st.sampled_from(["merge", "merge with its bytes", "unmerge", "replace", "replace with its bytes"]),
        st.sampled_from(KEYS),
        st.one_of(costly_evidence(GRID), st.builds(lambda seed: random_evidence(seed, GRID), st.integers(0, 99))),
    ),
    max_size=6,
)


def take(whole: EvidenceMap, step: Step) -> None:
    how, key, evidence = step
    match how:
        case "merge":
            whole.merge({key: evidence})
        case "merge with its bytes":
            whole.merge({key: evidence}, bodies={key: body(key, evidence)})
        case "unmerge":
            whole.unmerge({key: evidence})
        case "replace":
            whole.replace(key, evidence)
        case _:
            whole.replace(key, evidence, body=body(key, evidence))


@settings(max_examples=60)
@given(steps)
def test_any_steps_give_the_same_map_within_the_memory_that_was_paid_for(taken: list[Step]) -> None:
    whole, expected, came = thrifty(), EvidenceMap(GRID), dict.fromkeys(KEYS, 0)
    for step in taken:
        earlier, before = whole.copy(), expected.packed()
        take(whole, step)
        take(expected, step)
        assert earlier.packed() == before  # a copy is not touched by what comes later
        assert whole.packed() == expected.packed()
        assert all(whole.evidence(key) == expected.evidence(key) for key in KEYS)
        came[step[1]] += len(body(step[1], step[2]))
        for key in KEYS:
            now = len(body(key, whole.evidence(key)))
            assert whole.cell_bytes(key) <= HELD_PER_BYTE * (came[key] + now)
        assert whole.size_bytes == sum(whole.cell_bytes(key) for key in KEYS)


@pytest.mark.parametrize("evidence", [dust(GRID), air(GRID)])
def test_what_few_bytes_stand_for_is_held_as_bytes(evidence: Evidence) -> None:
    whole = thrifty()
    whole.merge({KEYS[0]: evidence})
    assert isinstance(whole.held(KEYS[0]), CompactCell)
    assert whole.size_bytes == len(body(KEYS[0], evidence))
    sums = whole.cell(KEYS[0])
    assert sums is not None and sums.packed() == evidence


def test_an_honest_cell_is_held_as_sums() -> None:
    whole = thrifty()
    whole.merge({KEYS[0]: random_evidence(1, GRID, voxels=4000)})
    assert isinstance(whole.held(KEYS[0]), BrickCell)


def test_the_size_that_a_map_states_is_the_memory_that_it_takes() -> None:
    diffs = [{cell_key((n, 5, 5)): dust(GRID, first=n)} for n in range(50)]
    bodies = [{key: body(key, evidence) for key, evidence in diff.items()} for diff in diffs]
    for coding, slack in ((None, 1.05), (coding_of(GRID), 12.0)):  # a cell of 150 bytes takes a kB of Python's objects
        tracemalloc.start()
        whole = EvidenceMap(GRID, coding=coding)
        for diff, bytes_of in zip(diffs, bodies, strict=True):
            whole.merge(diff, bodies=bytes_of)
        held_bytes, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert held_bytes <= slack * whole.size_bytes + 50_000


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_a_diff_that_overflows_in_one_cell_changes_none(order: tuple[int, ...]) -> None:
    full = packed_evidence(
        np.array([0], np.uint32), np.array([[0, COUNT_MAX]]), np.zeros((1, GRID.plane_count), np.int64), GRID
    )
    whole = thrifty()
    whole.merge({KEYS[0]: dust(GRID), KEYS[1]: full})
    before, held, size_bytes = whole.packed(), whole.held(KEYS[0]), whole.size_bytes
    with pytest.raises(BadInputError):
        whole.merge({KEYS[n]: (air(GRID), full, dust(GRID))[n] for n in order})
    assert whole.packed() == before
    assert whole.held(KEYS[0]) is held
    assert (list(whole), whole.size_bytes) == (sorted(KEYS[:2]), size_bytes)


def answers(snapshot: MapSnapshot, whole: EvidenceMap) -> list[object]:
    """Answers of every kind of query, and a picture."""
    points = random_points(0, whole, 300)
    sight, renderer = pinhole(48, 32, focal_px=30), MapRenderer()
    pose = np.eye(4)
    pose[:3, 3] = (0.8, 0.8, -0.9)
    seen = renderer.nearest(snapshot, sight, pose, range_max_m=3.0)
    colour, voxels = snapshot.colour_at(points), snapshot.voxels_in()
    return [
        *(snapshot.state_at(points), snapshot.counts_at(points), snapshot.probability_at(points)),
        *(colour.mean, colour.weight, snapshot.layer_at(0.01, "log_odds").values, snapshot.height_map().values),
        *(voxels.numbers, voxels.counts, snapshot.frontier(), snapshot.hottest(3).numbers, seen.range_m),
        *(renderer.colour(snapshot, seen), renderer.temperature(snapshot, seen), renderer.probability(snapshot, seen)),
    ]


def test_every_query_answers_alike_for_cells_held_as_bytes() -> None:
    speck = random_evidence(3, GRID, voxels=6, air=0)
    diff = {KEYS[0]: air(GRID), KEYS[1]: random_evidence(5, GRID, voxels=4000), KEYS[2]: dust(GRID, first=3)}
    whole, expected = thrifty(), EvidenceMap(GRID)
    for each in (whole, expected):
        each.merge(diff)
        each.merge({KEYS[0]: speck, KEYS[2]: speck})
    kinds = [type(whole.held(key)) for key in KEYS]
    assert kinds == [CompactCell, BrickCell, CompactCell]
    snapshot, open_snapshot = snapshot_of(whole), snapshot_of(expected)
    for mine, its in zip(answers(snapshot, whole), answers(open_snapshot, expected), strict=True):
        np.testing.assert_array_equal(mine, its)
    whole.merge({KEYS[0]: dust(GRID)})
    expected.merge({KEYS[0]: dust(GRID)})
    later, open_later = snapshot.refreshed(whole), open_snapshot.refreshed(expected)
    for mine, its in zip(answers(later, whole), answers(open_later, expected), strict=True):
        np.testing.assert_array_equal(mine, its)
