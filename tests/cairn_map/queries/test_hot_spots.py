"""Hot spots against a flood fill over the whole map, and their heights over the floor."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.changing import GEOMETRY, MODEL
from tests.fixtures.map.made import PLAIN
from tests.naive import hot_spots as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_key, split_voxels
from cairn_map.queries import hot_spots
from cairn_map.queries.hot_spots import (
    NO_SPOTS,
    CellPieces,
    Spots,
    joined_spots,
    over_floor_m,
    pieces_of_cell,
    ranked_spots,
)
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of

SIDE = GEOMETRY.side
EDGE_M = GEOMETRY.voxel_edge_m
STEP_K = 0.05
World = dict[naive.Number, naive.Warm]


def map_with(world: World) -> EvidenceMap:
    """A map of occupied voxels, each of so many hits and of one temperature."""
    whole = EvidenceMap(GEOMETRY)
    if not world:
        return whole
    keys, places = split_voxels(np.array(list(world)), GEOMETRY)
    hits = np.array([warm.hits for warm in world.values()])
    values = np.array([round(warm.kelvin / STEP_K) for warm in world.values()])
    for key in np.unique(keys):
        here = keys == key
        counts = np.stack([hits[here], np.zeros_like(hits[here])], axis=1)
        samples = np.stack([values[here] * hits[here], values[here] ** 2 * hits[here], hits[here]], axis=1)
        whole.merge({CellKey(int(key)): packed_evidence(places[here], counts, samples, GEOMETRY)})
    return whole


def snapshot_with(world: World) -> MapSnapshot:
    return snapshot_of(map_with(world), MODEL)


def pieces_in(world: World, over_k: float) -> dict[CellKey, CellPieces]:
    packed = map_with(world).packed()
    return {key: pieces_of_cell(key, evidence, GEOMETRY, MODEL, over_k) for key, evidence in packed.items()}


def as_naive(spots: Spots) -> list[naive.Spot]:
    columns = zip(spots.peaks, spots.voxels, spots.low, spots.high, spots.confirmed, strict=True)
    return [
        naive.Spot(tuple(peak.tolist()), int(voxels), tuple(low.tolist()), tuple(high.tolist()), bool(confirmed))
        for peak, voxels, low, high, confirmed in columns
    ]


@st.composite
def crawling(draw: st.DrawFn) -> World:
    """Crawls of warm voxels that cross borders of cells, far apart and close together, and single ones."""
    world: World = {}
    far = st.sampled_from([0, 0, 0, 40, -1_000_000])
    for _ in range(draw(st.integers(0, 4))):
        at = [draw(far) + draw(st.integers(SIDE - 3, SIDE + 2)) for _ in range(3)]
        for step in draw(st.lists(st.sampled_from([(x, y, z) for x, y, z in naive.STEPS]), max_size=30)):
            kelvin = STEP_K * draw(st.integers(5900, 6300))
            world[at[0], at[1], at[2]] = naive.Warm(kelvin, draw(st.sampled_from([1, 1, 2])))
            at = [place + part for place, part in zip(at, step, strict=True)]
    return world


@given(crawling(), st.integers(1, 5))
def test_spots_are_those_of_a_flood_over_the_whole_map_whatever_cells_they_cross(world: World, least: int) -> None:
    # The mean of equal samples is rounded as the sums are.
    world = {voxel: naive.Warm(STEP_K * round(warm.kelvin / STEP_K), warm.hits) for voxel, warm in world.items()}
    over_k = 305.01
    spots = joined_spots(pieces_in(world, over_k).values())
    found = ranked_spots(spots, GEOMETRY, voxels_min=least, box_m=None)
    assert as_naive(found) == naive.hot_spots(world, over_k, least)


def test_a_spot_across_eight_cells_is_one() -> None:
    world = {voxel: naive.Warm(320.0, 1) for voxel in itertools.product((-1, 0), repeat=3)}
    snapshot = snapshot_with(world | {(SIDE, SIDE, SIDE): naive.Warm(350.0, 2)})
    spot, other = as_naive(snapshot.hot_spots(voxels_min=1))
    assert (spot.peak, spot.voxels) == ((SIDE, SIDE, SIDE), 1)
    assert (other.voxels, other.low, other.high) == (8, (-1, -1, -1), (0, 0, 0))
    box_m = [[-1.0, -1.0, -1.0], [0.1, 0.1, 0.1]]
    assert as_naive(snapshot.hot_spots(voxels_min=1, box_m=box_m)) == [other]


def test_a_lukewarm_bridge_leaves_two_spots_and_a_warm_one_makes_one() -> None:
    ends = {(x, 0, 0): naive.Warm(330.0, 2) for x in (SIDE - 1, SIDE + 1)}
    for kelvin, count in ((303.0, 2), (304.0, 1)):
        bridged = snapshot_with(ends | {(SIDE, 0, 0): naive.Warm(kelvin, 2)})
        assert len(bridged.hot_spots(voxels_min=1)) == count


def test_what_has_no_temperature_has_no_hot_spots() -> None:
    assert len(snapshot_of(EvidenceMap(GEOMETRY), MODEL).hot_spots()) == len(NO_SPOTS) == 0
    with pytest.raises(BadInputError) as caught:
        snapshot_of(EvidenceMap(PLAIN)).hot_spots()
    assert caught.value.kind == "unknown_channel"


def test_more_at_borders_than_is_joined_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hot_spots, "BORDER_MAX", 3)
    world = {(0, y, 0): naive.Warm(320.0, 1) for y in range(4)}
    with pytest.raises(BadInputError, match="higher temperature") as caught:
        snapshot_with(world).hot_spots()
    assert caught.value.kind == "too_costly"


def test_the_height_is_over_the_floor_below_and_not_over_tables_or_the_storey_above() -> None:
    room = itertools.product(range(SIDE), range(SIDE))
    floor = {(x, y, -10): naive.Warm(290.0, 2) for x, y in room}
    table = {(x, y, 4): naive.Warm(290.0, 2) for x, y in itertools.product(range(5), range(5))}
    ceiling = {(x, y, 14): naive.Warm(290.0, 2) for x, y in itertools.product(range(SIDE), range(SIDE))}
    stove = {(2, 2, 5): naive.Warm(340.0, 2)}
    cells = pieces_in(floor | table | ceiling | stove, 303.15)
    spots = joined_spots(cells.values())
    assert spots.peaks.tolist() == [[2, 2, 5]]
    peak = (2, 2, 5)
    surfaces = {}
    for cell in hot_spots.cells_over_floor(peak, GEOMETRY):
        if cell_key(cell) in cells:
            surfaces[cell] = cells[cell_key(cell)].surfaces
    # The floor's upper face is the border of layers -10 and -9.
    assert over_floor_m(peak, surfaces, GEOMETRY) == pytest.approx((5.5 + 9) * EDGE_M)
    assert over_floor_m(peak, {}, GEOMETRY) is None
