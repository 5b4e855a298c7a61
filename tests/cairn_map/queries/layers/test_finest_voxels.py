"""Rays, distances, images and sets of voxels of several layers: as slow readers of all their voxels find them."""

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.fixtures.map.made import random_evidence

from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, TEMPERATURE
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_key, level_geometry, split_voxels
from cairn_map.queries.layers.finest_voxels import finest_states, joined_layers
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State

Number = tuple[int, ...]
WORLDS = {"cubes in cubes": (10_000, 40_000, 200_000), "borders apart": (30_000, 70_000), "one edge": (40_000, 40_000)}
CELLS = np.stack(np.meshgrid(*[[-1, 0]] * 3), axis=-1).reshape(-1, 3).tolist()


def layer(geometry: Geometry, seed: int, voxels: int = 60) -> MapSnapshot:
    """A layer whose cell at the origin and seven more are full of anything."""
    whole = HistoryMap(MapLayer(geometry=geometry))
    whole.merge({cell_key(tuple(c)): random_evidence(seed + n, geometry, voxels=voxels) for n, c in enumerate(CELLS)})
    return snapshot_of(whole)


def world(name: str) -> LayeredSnapshot:
    channels = ((COLOUR, TEMPERATURE), (TEMPERATURE,), (COLOUR,))
    return LayeredSnapshot(
        {
            f"at_{n}_{edge_um}": layer(Geometry(voxel_edge_um=edge_um, depth=3, channels=channels[n]), 9 * n)
            for n, edge_um in enumerate(WORLDS[name])
        }
    )


@pytest.fixture(scope="module", params=WORLDS)
def layers(request: pytest.FixtureRequest) -> LayeredSnapshot:
    return world(request.param)


def counted(geometry: Geometry, counts: dict[Number, tuple[int, int]]) -> dict[CellKey, Evidence]:
    """Hits and misses of some voxels of the cells around the origin."""
    cells, places = split_voxels(np.array(list(counts)), geometry)
    found = {}
    for cell in np.unique(cells):
        mine = np.nonzero(cells == cell)[0]
        mine = mine[np.argsort(places[mine])]
        rows = np.array(list(counts.values()))[mine]
        found[CellKey(int(cell))] = packed_evidence(
            places[mine], rows, np.zeros((len(mine), geometry.plane_count), np.int64), geometry
        )
    return found


def states(snapshot: MapSnapshot) -> dict[Number, int]:
    """State of each known voxel, by number."""
    voxels = snapshot.voxels_in()
    found = zip(voxels.numbers.tolist(), snapshot.state_at(voxels.centres_m).tolist(), strict=True)
    return {tuple(number): state for number, state in found if state}


def holder(number: Number, edge_um: int, coarse_um: int) -> Number:
    """Coarser voxel that holds a voxel's centre."""
    return tuple((2 * n + 1) * edge_um // (2 * coarse_um) for n in number)


@cache
def centres_in(i: int, edge_um: int, coarse_um: int) -> int:
    """Finer voxels along one axis whose centres lie in a coarser one, each tried."""
    near = range(i * coarse_um // edge_um - 2, (i + 1) * coarse_um // edge_um + 3)
    return sum(holder((k,), edge_um, coarse_um) == (i,) for k in near)


def naive_finest(layers: LayeredSnapshot) -> dict[str, dict[Number, int]]:
    """Voxels that no finer layer shows: by looking at every voxel of every pair of layers."""
    worlds = {name: states(layers[name]) for name in layers.names}
    found = {}
    for n, name in enumerate(layers.names):
        coarse_um = layers[name].geometry.voxel_edge_um
        stays = dict(worlds[name])
        for finer in layers.names[:n]:
            edge_um = layers[finer].geometry.voxel_edge_um
            inside: dict[Number, list[int]] = {}
            for number, state in worlds[finer].items():
                inside.setdefault(holder(number, edge_um, coarse_um), []).append(state)
            for number, state in worlds[name].items():
                spans = [centres_in(i, edge_um, coarse_um) for i in number]
                seen = inside.get(number, [])
                if (seen and len(seen) == np.prod(spans)) or (state == State.OCCUPIED and State.OCCUPIED in seen):
                    stays.pop(number, None)
        found[name] = stays
    return found


def test_voxels_of_a_coarser_layer_give_way_to_what_finer_ones_show(layers: LayeredSnapshot) -> None:
    expected = naive_finest(layers)
    everything, occupied = layers.voxels_in(), layers.occupied_in()
    assert tuple(everything) == layers.names
    for name, stays in expected.items():
        assert {tuple(number) for number in everything[name].numbers.tolist()} == stays.keys()
        occupied_here = {number for number, state in stays.items() if state == State.OCCUPIED}
        assert {tuple(number) for number in occupied[name].numbers.tolist()} == occupied_here
    assert any(len(stays) < len(states(layers[name])) for name, stays in expected.items())
    # In a box those whose centres it holds; the layers themselves are as before.
    box = [[-0.05, -0.05, -0.05], [0.15, 0.101, 0.12]]
    for name, voxels in layers.voxels_in(box).items():
        inside = ((everything[name].centres_m >= box[0]) & (everything[name].centres_m <= box[1])).all(axis=1)
        assert voxels.numbers.tolist() == everything[name].numbers[inside].tolist()
    assert all(len(layers[name].occupied_in()) >= len(voxels) for name, voxels in occupied.items())


def test_voxels_give_way_to_a_level_s_flat_ones() -> None:
    level = level_geometry(voxel_edge_m=0.1).model_copy(update={"depth": 3})
    assert (level.voxel_edge_um, level.voxel_height_um) == (100_000, 50_000)
    # All 2 x 2 x 4 flat voxels of the first cube are free, all but one of the second; one of the third is occupied.
    corner = [(x, y, z) for x in range(2) for y in range(2) for z in range(4)]
    free = [*corner, *((x + 2, y, z) for x, y, z in corner[:-1])]
    ground = HistoryMap(MapLayer(geometry=level))
    ground.merge(counted(level, dict.fromkeys(free, (0, 5)) | {(4, 0, 3): (5, 0)}))
    cubes = HistoryMap(MapLayer(geometry=Geometry(voxel_edge_um=200_000, depth=3, channels=())))
    cubes.merge(counted(cubes.geometry, {(x, 0, z): (5, 0) for x in range(3) for z in range(2)}))
    layers = LayeredSnapshot({"ground": snapshot_of(ground), "cubes": snapshot_of(cubes)})
    assert layers.occupied_in()["cubes"].numbers.tolist() == [[1, 0, 0], [0, 0, 1], [1, 0, 1], [2, 0, 1]]


@pytest.fixture(scope="module")
def full() -> dict[str, MapSnapshot]:
    """Two layers of one cell, of which each of the 32 768 voxels is free."""
    found = {}
    for edge_um in (20_000, 30_000):
        geometry = Geometry(voxel_edge_um=edge_um, depth=5, channels=())
        whole = HistoryMap(MapLayer(geometry=geometry))
        places = np.arange(8**5, dtype=np.uint32)
        samples = np.empty((len(places), 0), np.int64)
        whole.merge(
            {cell_key((0, 0, 0)): packed_evidence(places, np.tile([0, 1], (len(places), 1)), samples, geometry)}
        )
        found[f"at_{edge_um}"] = snapshot_of(whole)
    return found


def test_finest_voxels_take_less_memory_than_a_byte_for_each_voxel(full: dict[str, MapSnapshot]) -> None:
    LayeredSnapshot(full).nearest_occupied(np.zeros((1, 3)), radius_m=0.1)  # kernels may be compiled now
    tracemalloc.start()
    LayeredSnapshot(full).nearest_occupied(np.zeros((1, 3)), radius_m=0.1)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 2 * 8**5


def test_voxels_out_of_a_box_are_not_looked_at(full: dict[str, MapSnapshot]) -> None:
    box = [[0.3, 0.3, 0.3], [0.4, 0.4, 0.4]]
    frozen = {name: layer.frozen for name, layer in full.items()}
    before, after, whole = (
        finest["at_30000"].grid.words for finest in (frozen, finest_states(frozen, box), finest_states(frozen, None))
    )
    changed = (after != before).any(axis=(1, 2))
    # Voxels 10 to 12 along each axis lie in the second of four bricks. That with its neighbours is known finer whole.
    assert np.unique(frozen["at_30000"].brick_corners()[changed], axis=0).tolist() == [[8, 8, 8]]
    np.testing.assert_array_equal(after[changed], whole[changed])
    assert ((whole != before).any(axis=(1, 2))).sum() > 1


def test_no_obstacle_vanishes(layers: LayeredSnapshot) -> None:
    occupied = {name: voxels.numbers.tolist() for name, voxels in layers.occupied_in().items()}
    for n, name in enumerate(layers.names):
        coarse_um = layers[name].geometry.voxel_edge_um
        shown = {
            holder(tuple(number), layers[finer].geometry.voxel_edge_um, coarse_um)
            for finer in layers.names[: n + 1]
            for number in states(layers[finer])
            if layers[finer].state_at([(np.array(number) + 0.5) * layers[finer].geometry.voxel_edge_m])[0] == 2
        }
        kept = {tuple(number) for number in occupied[name]}
        assert kept <= shown


def test_a_ray_ends_where_the_finest_layer_that_knows_the_place_has_it_occupied(layers: LayeredSnapshot) -> None:
    rng = np.random.default_rng(5)
    origins, ways = rng.uniform(-0.3, 0.3, (80, 3)), rng.normal(size=(80, 3))
    ways[:6] = np.concatenate([np.eye(3), -np.eye(3)])  # along the axes, too
    ends = layers.cast_rays(origins, ways, max_range_m=2.0)
    units = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    along = np.arange(0, 2.0, 0.002)
    for n in range(len(origins)):
        met = layers.state_at(origins[n] + units[n] * along[:, None]) == State.OCCUPIED
        before = met[along < ends.distance_m[n] - 1e-6]
        assert not before.any()
        if ends.hit[n]:
            inside = ends.points_m[n] + units[n] * 2e-8
            assert layers.state_at([inside])[0] == State.OCCUPIED
            assert layers.names_at([inside]) == [ends.names[n]]
            np.testing.assert_allclose(ends.points_m[n], origins[n] + units[n] * ends.distance_m[n], atol=1e-12)
        else:
            assert (ends.names[n], np.isnan(ends.points_m[n]).all()) == (None, True)
    assert len({*ends.names}) > 2
    # One layer, one origin, a range.
    alone = LayeredSnapshot({"a": layers[layers.names[0]]})
    mine, own = (
        alone.cast_rays([0, 0, 0], ways, max_range_m=0.2),
        layers[layers.names[0]].cast_rays([0, 0, 0], ways, max_range_m=0.2),
    )
    np.testing.assert_allclose(mine.distance_m, own.distance_m)


def test_a_ray_passes_the_free_part_of_a_coarse_obstacle_and_ends_in_the_rest() -> None:
    coarse, fine = (
        HistoryMap(MapLayer(geometry=Geometry(voxel_edge_um=um, depth=3, channels=()))) for um in (100_000, 10_000)
    )
    coarse.merge(counted(coarse.geometry, {(1, 0, 0): (5, 0)}))
    fine.merge(counted(fine.geometry, {(x, 0, 0): (0, 5) for x in range(0, 15)}))
    layers = LayeredSnapshot({"fine": snapshot_of(fine), "coarse": snapshot_of(coarse)})
    ends = layers.cast_rays([[0.005, 0.005, 0.005], [0.005, 0.055, 0.005]], [1, 0, 0], max_range_m=1.0)
    # Up to 0.15 m the fine layer knows that row as free; above it nothing is known of the coarse voxel's part.
    np.testing.assert_allclose(ends.distance_m, [0.145, 0.095], atol=1e-6)
    assert ends.names == ["coarse", "coarse"]
    assert layers.cast_rays([0.005, 0.005, 0.005], [1, 0, 0], max_range_m=0.14).hit.tolist() == [False]


def nested(*counts: dict[Number, tuple[int, int]]) -> LayeredSnapshot:
    """Layers of 1, 2 and 4 cm with these hits and misses."""
    found = {}
    for edge_um, mine in zip((10_000, 20_000, 40_000), counts, strict=True):
        whole = HistoryMap(MapLayer(geometry=Geometry(voxel_edge_um=edge_um, depth=3, channels=())))
        whole.merge(counted(whole.geometry, mine))
        found[f"at_{edge_um // 10_000}_cm"] = snapshot_of(whole)
    return LayeredSnapshot(found)


def test_a_ray_through_a_free_voxel_ends_at_an_obstacle_of_a_finer_layer_in_it() -> None:
    layers = nested({(5, 0, 0): (5, 0)}, {(2, 0, 0): (0, 5)}, {(1, 0, 0): (5, 0)})
    ends = layers.cast_rays([0.005, 0.005, 0.005], [1, 0, 0], max_range_m=1.0)
    np.testing.assert_allclose(ends.distance_m, [0.045], atol=1e-6)
    assert ends.names == ["at_1_cm"]


def test_rays_end_at_the_first_obstacle_of_layers_nested_in_each_other() -> None:
    chance = np.random.default_rng(11)
    for _ in range(10):
        # Rows of voxels along x: each layer knows half of its own, and has two thirds of these as free.
        worlds: list[dict[Number, tuple[int, int]]] = [
            {(x, 0, 0): (0, 5) if chance.random() < 0.67 else (5, 0) for x in range(size) if chance.random() < 0.5}
            for size in (64, 32, 16)
        ]
        layers = nested(*worlds)
        middles = np.stack([np.arange(64) * 0.01 + 0.005, *np.full((2, 64), 0.005)], axis=1)
        met, names = layers.state_at(middles) == State.OCCUPIED, layers.names_at(middles)
        for ways, rows in (([1, 0, 0], range(64)), ([-1, 0, 0], range(63, -1, -1))):
            ends = layers.cast_rays(middles, ways, max_range_m=1.0)
            for n in range(64):
                first = next((row for row in rows if met[row] and (row - n) * ways[0] >= 0), None)
                expected_m = np.inf if first is None else max(abs(first - n) * 0.01 - 0.005, 0)
                np.testing.assert_allclose(ends.distance_m[n], expected_m, atol=1e-6)
                assert ends.names[n] == (None if first is None else names[first])


def test_the_nearest_obstacle_is_of_what_no_finer_layer_shows(layers: LayeredSnapshot) -> None:
    points = np.random.default_rng(6).uniform(-1, 1, (50, 3))
    shown = layers.occupied_in()
    found = layers.nearest_occupied(points, radius_m=0.5)
    gaps = []
    for name, voxels in shown.items():
        edge_m = layers[name].geometry.voxel_edge_m
        low = voxels.numbers * edge_m
        away = np.maximum(np.maximum(low - points[:, None], points[:, None] - (low + edge_m)), 0)
        gaps.append(np.linalg.norm(away, axis=2).min(axis=1, initial=np.inf))
    expected = np.min(gaps, axis=0)
    expected[expected > 0.5] = np.inf
    # Points count to the nanometre.
    np.testing.assert_allclose(found.distance_m, expected, atol=2e-9)
    assert {*found.names} >= {None}
    np.testing.assert_allclose(
        np.linalg.norm(found.points_m - points, axis=1)[found.hit], expected[found.hit], atol=2e-9
    )


def test_obstacles_that_give_way_to_a_level_are_still_near() -> None:
    """A level has no distances: what it shows in the place of a cube stops no planner."""
    level = level_geometry(voxel_edge_m=0.1).model_copy(update={"depth": 3})
    ground = HistoryMap(MapLayer(geometry=level))
    ground.merge(counted(level, {(0, 0, 0): (5, 0)}))
    cubes = HistoryMap(MapLayer(geometry=Geometry(voxel_edge_um=200_000, depth=3, channels=())))
    cubes.merge(counted(cubes.geometry, {(0, 0, 0): (5, 0), (3, 0, 0): (5, 0)}))
    layers = LayeredSnapshot({"ground": snapshot_of(ground), "cubes": snapshot_of(cubes)})
    assert layers.names == ("ground", "cubes")
    assert layers.occupied_in()["cubes"].numbers.tolist() == [[3, 0, 0]]
    found = layers.nearest_occupied([[-0.1, 0.1, 0.1]], radius_m=1.0)
    np.testing.assert_allclose(found.distance_m, [0.1], atol=1e-9)
    assert found.names == ["cubes"]


def test_images_have_the_pixels_of_the_finest_layer_there(layers: LayeredSnapshot) -> None:
    box = [[-0.2, -0.1, -0.2], [0.271, 0.251, 0.3]]
    image = layers.layer_at(0.013, "state", box_m=box)
    H, W = image.values.shape
    assert image.edge_m == layers[layers.names[0]].geometry.voxel_edge_m
    x, y = (image.origin_m[axis] + image.edge_m * np.arange(size) for axis, size in ((0, W), (1, H)))
    assert (x[0] - image.edge_m < box[0][0] <= x[0], x[-1] <= box[1][0] < x[-1] + image.edge_m) == (True, True)
    for row in range(H):
        points = np.stack([x, np.full(W, y[row]), np.full(W, 0.013)], axis=1)
        assert image.values[row].tolist() == layers.state_at(points).tolist()
    colours = layers.layer_at(0.013, "colour", box_m=box)
    assert colours.values.shape == (H, W, 3)
    # The highest of what is shown.
    heights = layers.height_map(box_m=box)
    assert heights.values.shape == (H, W)
    tops = np.full((H, W), np.nan)
    for name, voxels in layers.occupied_in(box).items():
        edge_m = layers[name].geometry.voxel_edge_m
        for i, j, k in voxels.numbers.tolist():
            here = np.ix_(np.floor(y / edge_m + 1e-9) == j, np.floor(x / edge_m + 1e-9) == i)
            tops[here] = np.fmax(tops[here], (k + 1) * edge_m)
    np.testing.assert_allclose(heights.values, tops)
    # Somewhere without cells, and the whole map.
    assert layers.layer_at(0.0, box_m=[[50, 50, 0], [51, 51, 1]]).values.size == 0
    assert layers.height_map().values.size > heights.values.size


def test_layers_make_one_table(layers: LayeredSnapshot) -> None:
    parts = layers.occupied_in()
    table = joined_layers(list(parts.values()))
    assert len(table) == sum(map(len, parts.values()))
    assert table.readings.keys() == {"colour", "temperature"}
    start = 0
    for name, part in parts.items():
        rows = slice(start, start := start + len(part))
        for channel, reading in table.readings.items():
            own = part.readings.get(channel)
            assert reading.weight[rows].tolist() == ([0] * len(part) if own is None else own.weight.tolist())
            assert own is not None or layers[name].geometry.channel(channel) is None


def test_a_table_has_times_if_any_layer_has_some() -> None:
    first, second, *_ = world("cubes in cubes").occupied_in().values()
    kelvin = second.readings["temperature"]
    dated = replace(second, readings={"temperature": replace(kelvin, measured_s=np.arange(len(second)) + 0.5)})
    for parts in ([first, dated], [dated, first]):
        table = joined_layers(parts)
        for reading in table.readings.values():
            assert reading.measured_s is not None
            assert len(reading.measured_s) == len(table)
        expected = np.concatenate(
            [np.arange(len(part)) + 0.5 if part is dated else [np.nan] * len(part) for part in parts]
        )
        np.testing.assert_array_equal(table.readings["temperature"].measured_s, expected)


def test_a_level_is_in_sets_and_images_and_not_in_rays() -> None:
    ground, evidence = layer(level_geometry(), 3), layer(Geometry(voxel_edge_um=40_000, depth=3, channels=()), 4)
    both = LayeredSnapshot({"ground": ground, "evidence": evidence})
    assert both.names == ("evidence", "ground")
    assert len(both.occupied_in()["ground"])
    rays = np.zeros((1, 3)), [[0.0, 0.0, -1.0]]
    alone = evidence.cast_rays(*rays, max_range_m=9.0)
    np.testing.assert_allclose(both.cast_rays(*rays, max_range_m=9.0).distance_m, alone.distance_m)
    with pytest.raises(BadInputError) as refused:
        LayeredSnapshot({"ground": ground}).cast_rays(*rays, max_range_m=9.0)
    assert refused.value.kind == "level_layer"
    with pytest.raises(BadInputError) as refused:
        both.cast_rays(*rays, max_range_m=-1)
    assert refused.value.kind == "bad_range"
