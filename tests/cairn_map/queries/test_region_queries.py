"""Layers, height maps, the frontier, the hottest and boxes of voxels, against the twins."""

import math
from itertools import product

import numpy as np
import pytest
from tests.fixtures.map.made import MIDDLE, PLAIN, SMALL
from tests.fixtures.map.worlds import random_map, snapshot_with, world_of
from tests.naive import queries as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels
from cairn_map.queries import point_queries, region_queries
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of

DEEPER = Geometry(voxel_edge_um=50_000, depth=4, channels=())
BOX_M = [[-0.31, -0.2, -math.inf], [0.26, math.inf, 0.3]]
"""Voxels -6 to 4 along x (the centre of -7 is at -0.325, that of 5 at 0.275), from -4 on along y, below 6 along z."""
LOW, HIGH = (-6, -4, -math.inf), (4, math.inf, 5)


def in_box(voxel: tuple[int, int, int]) -> bool:
    return all(low <= v <= high for low, v, high in zip(LOW, voxel, HIGH, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [PLAIN, DEEPER, MIDDLE])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_frontier_is_that_of_the_twin(geometry: Geometry, seed: int) -> None:
    whole = random_map(seed, geometry)
    expected = naive.frontier(world_of(whole))
    snapshot = snapshot_of(whole)
    found = [tuple(voxel) for voxel in snapshot.frontier().tolist()]
    assert len(found) == len(set(found))
    assert set(found) == expected
    cells = snapshot.frontier_cells()
    assert sum(cells.values()) == len(expected)
    assert set(cells) == {tuple(v >> geometry.depth for v in voxel) for voxel in expected}


def test_the_frontier_of_a_box_is_a_part_of_it() -> None:
    whole = random_map(1, PLAIN)
    snapshot = snapshot_of(whole)
    found = {tuple(voxel) for voxel in snapshot.frontier(box_m=BOX_M).tolist()}
    assert found == {voxel for voxel in naive.frontier(world_of(whole)) if in_box(voxel)} != set()
    assert sum(snapshot.frontier_cells(box_m=BOX_M).values()) == len(found)


@pytest.mark.parametrize("box_m", [None, BOX_M])
@pytest.mark.parametrize("geometry", [PLAIN, DEEPER])
def test_the_height_map_is_that_of_the_twin(geometry: Geometry, box_m: list[list[float]] | None) -> None:
    whole = random_map(2, geometry)
    world = {voxel: counts for voxel, counts in world_of(whole).items() if box_m is None or in_box(voxel)}
    image = snapshot_of(whole).height_map(box_m=box_m)
    column, row = np.rint(np.array(image.origin_m) / 0.05 - 0.5).astype(int)
    heights = {
        (column + x, row + y): round(image.values[y, x] / 0.05) - 1 for y, x in np.argwhere(~np.isnan(image.values))
    }
    assert heights == naive.tops(world) != {}
    assert image.edge_m == 0.05
    if box_m:
        assert image.values.shape[1] == 11
        assert image.origin_m == pytest.approx((-5.5 * 0.05, -3.5 * 0.05))


@pytest.mark.parametrize("box_m", [None, BOX_M])
def test_a_layer_is_what_its_points_say(monkeypatch: pytest.MonkeyPatch, box_m: list[list[float]] | None) -> None:
    monkeypatch.setattr(point_queries, "CHUNK", 100)
    snapshot = snapshot_of(random_map(1, SMALL))
    for what, ask in (
        ("state", snapshot.state_at),
        ("probability", snapshot.probability_at),
        ("log_odds", snapshot.log_odds_at),
        ("temperature", lambda p: snapshot.temperature_at(p).mean),
        ("colour", lambda p: snapshot.colour_at(p).mean),
    ):
        image = snapshot.layer_at(0.12, what, box_m=box_m)
        H, W = image.values.shape[:2]
        y, x = np.mgrid[:H, :W]
        points = np.stack([image.origin_m[0] + x * 0.05, image.origin_m[1] + y * 0.05, np.full((H, W), 0.12)], axis=-1)
        expected = ask(points.reshape(-1, 3))  # type: ignore[no-untyped-call]
        np.testing.assert_array_equal(image.values.reshape(expected.shape), expected)
        assert box_m or not (np.isnan(image.values).all() or (image.values == 0).all())


@pytest.mark.parametrize("occupied_only", [False, True])
@pytest.mark.parametrize("box_m", [None, BOX_M])
def test_a_box_holds_the_voxels_whose_centres_it_holds(box_m: list[list[float]] | None, occupied_only: bool) -> None:
    whole = random_map(1, SMALL)
    snapshot = snapshot_of(whole)
    world = {voxel: counts for voxel, counts in world_of(whole).items() if box_m is None or in_box(voxel)}
    if occupied_only:
        world = {voxel: counts for voxel, counts in world.items() if naive.state(world, voxel) == naive.OCCUPIED}
    found = snapshot.occupied_in(box_m) if occupied_only else snapshot.voxels_in(box_m)
    voxels = [tuple(voxel) for voxel in found.numbers.tolist()]
    assert dict(zip(voxels, map(tuple, found.counts.tolist()), strict=True)) == {v: c[:2] for v, c in world.items()}
    reading = snapshot.temperature_at(found.centres_m)
    for mine, others in (
        (found.readings["temperature"].mean, reading.mean),
        (found.readings["temperature"].weight, reading.weight),
    ):
        np.testing.assert_array_equal(mine, others)
    assert (reading.weight > 0).any()


@pytest.mark.parametrize("min_probability", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("n", [0, 1, 7, 10_000])
def test_the_hottest_are_those_of_the_whole_map_sorted(n: int, min_probability: float) -> None:
    snapshot = snapshot_of(random_map(1, SMALL))
    every = snapshot.voxels_in()
    kelvin = every.readings["temperature"].mean
    occupied = {tuple(voxel) for voxel in snapshot.occupied_in().numbers.tolist()}
    groups: tuple[list[float], list[float]] = ([], [])
    for row in np.nonzero(~np.isnan(kelvin) & (every.probability >= min_probability))[0].tolist():
        around = [tuple(every.numbers[row] + step) for step in product((-1, 0, 1), repeat=3) if any(step)]
        is_sure = every.counts[row, 0] > 1 or sum(voxel in occupied for voxel in around) >= 3
        groups[0 if is_sure else 1].append(kelvin[row])
    assert groups[0]
    assert groups[1] or min_probability > 0.7  # that of one hit
    expected = [kelvin for group in groups for kelvin in sorted(group, reverse=True)][:n]
    found = snapshot.hottest(n, min_probability=min_probability)
    np.testing.assert_array_equal(found.readings["temperature"].mean, expected)
    assert (found.probability >= min_probability).all()
    np.testing.assert_array_equal(snapshot.temperature_at(found.centres_m).mean, expected)
    np.testing.assert_array_equal(found.readings["colour"].weight, snapshot.colour_at(found.centres_m).weight)


def with_kelvin(
    counts: dict[tuple[int, int, int], tuple[int, int]], hot: dict[tuple[int, int, int], float]
) -> MapSnapshot:
    """A map of voxels of which some have a temperature, one sample each."""
    whole = EvidenceMap(SMALL)
    planes = SMALL.planes_of("temperature")
    channel = SMALL.channel("temperature")
    assert channel is not None
    for voxel, seen in counts.items():
        samples = np.zeros((1, SMALL.plane_count), np.int64)
        if voxel in hot:
            value = int(channel.quantise(np.array([hot[voxel]]))[0])
            samples[0, planes] = (value, value**2, 1)
        cells, places = split_voxels(np.array([voxel]), SMALL)
        whole.merge({CellKey(int(cells[0])): packed_evidence(places, np.array([seen]), samples, SMALL)})
    return snapshot_of(whole)


def test_a_ghost_behind_a_surface_is_not_the_hottest() -> None:
    table = {(x, y, 8): (1, 0) for x in range(-3, 4) for y in range(-3, 4)}
    ghost, streak = (0, 0, 3), {(20, 0, z): (1, 0) for z in range(3)}
    snapshot = with_kelvin(
        {**table, ghost: (1, 0), **streak, (0, 9, 0): (3, 1)},
        {(1, 1, 8): 320.0, (3, 3, 8): 315.0, ghost: 360.0, (20, 0, 1): 350.0, (0, 9, 0): 310.0},
    )
    found = snapshot.hottest(5)
    assert found.numbers.tolist() == [[1, 1, 8], [3, 3, 8], [0, 9, 0], [0, 0, 3], [20, 0, 1]]
    assert snapshot.hottest(1).numbers.tolist() == [[1, 1, 8]]


def test_what_was_measured_once_is_as_uncertain_as_the_camera() -> None:
    reading = with_kelvin({(0, 0, 0): (1, 0)}, {(0, 0, 0): 320.0}).hottest(1).readings["temperature"]
    assert reading.spread is not None
    assert reading.sigma is not None
    assert reading.spread[0] == pytest.approx(0, abs=1e-4)
    assert reading.sigma[0] == pytest.approx(1.0, abs=1e-4)


def test_the_hottest_of_a_box_lie_in_it() -> None:
    snapshot = snapshot_of(random_map(1, SMALL))
    found = snapshot.hottest(5, box_m=BOX_M)
    assert len(found) > 0
    assert all(in_box(voxel) for voxel in map(tuple, found.numbers.tolist()))


@pytest.mark.parametrize("geometry", [SMALL, PLAIN])
def test_an_empty_map_has_nothing_of_interest(geometry: Geometry) -> None:
    snapshot = snapshot_of(EvidenceMap(geometry))
    assert snapshot.frontier().shape == (0, 3)
    assert snapshot.frontier_cells() == {}
    assert snapshot.height_map().values.shape == (0, 0)
    assert snapshot.layer_at(0).values.shape == (0, 0)
    assert len(snapshot.voxels_in()) == len(snapshot.occupied_in(BOX_M)) == 0
    if geometry.channels:
        assert len(snapshot.hottest(3)) == 0


def test_a_box_beside_the_map_holds_nothing() -> None:
    snapshot = snapshot_of(random_map(1, SMALL))
    away = [[500, 500, 500], [501, 501, 501]]
    assert snapshot.height_map(box_m=away).values.size == 0
    assert snapshot.layer_at(500.5, box_m=away).values.size == 0
    assert (
        len(snapshot.voxels_in(away)) == len(snapshot.frontier(box_m=away)) == len(snapshot.hottest(3, box_m=away)) == 0
    )


@pytest.mark.parametrize("box_m", [[0, 0, 0], [[0, 0, 0], [1, -1, 1]], [[0, 0, math.nan], [1, 1, 1]], [[0, 0], [1, 1]]])
def test_boxes_that_are_none_are_refused(box_m: list[list[float]]) -> None:
    snapshot = snapshot_of(random_map(1, PLAIN))
    for ask in (snapshot.voxels_in, lambda box: snapshot.height_map(box_m=box)):
        with pytest.raises(BadInputError) as refused:
            ask(box_m)  # type: ignore[no-untyped-call]
        assert refused.value.kind == "bad_box"


def test_images_as_large_as_a_country_are_refused() -> None:
    snapshot = snapshot_with(PLAIN, {(0, 0, 0): (1, 0), (1_000_000, 1_000_000, 0): (1, 0)})
    for ask in (snapshot.height_map, lambda: snapshot.layer_at(0)):
        with pytest.raises(BadInputError) as refused:
            ask()  # type: ignore[no-untyped-call]
        assert refused.value.kind == "too_large"
    assert snapshot.height_map(box_m=[[49_999, 49_999, -1], [50_001, 50_001, 1]]).values.shape == (28, 28)
    assert region_queries.PIXELS_MAX >= 28 * 28


def test_other_nonsense_is_refused() -> None:
    snapshot = snapshot_of(random_map(1, SMALL))
    with pytest.raises(BadInputError, match="channel 'smell'"):
        snapshot.layer_at(0, "smell")
    with pytest.raises(BadInputError, match="height"):
        snapshot.layer_at(math.nan)
    with pytest.raises(BadInputError, match="n must be"):
        snapshot.hottest(-1)
    with pytest.raises(BadInputError, match="no channel of kind temperature"):
        snapshot_of(random_map(1, PLAIN)).hottest(1)
