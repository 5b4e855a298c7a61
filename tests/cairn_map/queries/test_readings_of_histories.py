"""Maps with epochs through every door that reads a map: as the slow twin says, and with one row as the sums read."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import as_naive, change, epoch_map, random_history
from tests.fixtures.map.made import KEY, SMALL
from tests.fixtures.map.octomap_files import octomap_file
from tests.fixtures.map.worlds import random_map
from tests.naive import history as naive_history

from cairn_map.codec.view_code import encode_view
from cairn_map.epochs.cell_history import CellHistory, cell_history
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.map_reading import MapReading
from cairn_map.epochs.present import present
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key, centres_of_voxels, voxels_in_cell
from cairn_map.evidence.inverse_sensor_model import LOG_ODDS_STEP, SensorModel, log_odds
from cairn_map.evidence.view import LOG_ODDS_ZERO, Chance, Extent, ViewStyle, view_of
from cairn_map.evidence.voxels import Voxels, voxels_of_evidence
from cairn_map.files.cell_files import MEDIA_TYPES, cell_file
from cairn_map.files.export_request import ExportRequest, chosen_places
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State
from cairn_map.render.camera_rays import look_at, pinhole
from cairn_map.render.map_picture import layer_values
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.partial_map import draw_as_needed, read_cell
from cairn_map.render.render_picture import GROUND_LAYERS, Layer

MODELS = st.sampled_from([0.3, 0.5, 0.7]).map(lambda p: SensorModel(p_occupied=p))
MODEL = SensorModel()
STYLES = st.builds(
    ViewStyle,
    depth=st.one_of(st.none(), st.integers(1, 3)),
    extent=st.sampled_from(Extent),
    chance=st.just(Chance.LOG_ODDS),
)
SIGHT = pinhole(20, 14, focal_px=16)


def twin_odds(history: CellHistory, model: SensorModel) -> dict[int, float]:
    """Log-odds of the known voxels."""
    naive = as_naive(history)
    steps = tuple(log_odds(p) for p in (model.p_hit, model.p_miss, model.p_min, model.p_max))
    places = naive_history.total(naive)
    found = {place: naive_history.log_odds(naive, place, steps) for place in places}  # type: ignore[arg-type]
    return {place: odds for place, odds in found.items() if odds is not None}


def snapshot_of_history(history: CellHistory, model: SensorModel) -> MapSnapshot:
    rows = epoch_map()
    for epoch, row in history.rows.items():
        change(rows, epoch, row)
    return snapshot_of(MapReading(rows), model)


def places_of(voxels: Voxels) -> list[int]:
    """Morton codes of voxels of the one cell."""
    inside = voxels.numbers - np.array(cell_of_key(KEY)) * SMALL.side
    bits = [[(value >> bit & 1) << 3 * bit for bit in range(SMALL.depth)] for value in range(SMALL.side)]
    spread = np.array([sum(each) for each in bits])
    return (spread[inside] << np.arange(3)).sum(axis=1).tolist()


@given(st.integers(0, 10**6), MODELS)
def test_each_voxel_reads_as_the_twin_says(seed: int, model: SensorModel) -> None:
    history = random_history(seed)
    reading, twin = present(history, SMALL, model).evidence, twin_odds(history, model)
    zero = log_odds(model.p_occupied)
    voxels = voxels_of_evidence(KEY, reading, SMALL, model, occupied_only=False)
    found = {place: p for place, p in zip(places_of(voxels), voxels.probability.tolist(), strict=True) if p == p}
    assert found == pytest.approx({place: 1 / (1 + math.exp(-odds)) for place, odds in twin.items()}, rel=1e-12)
    occupied = voxels_of_evidence(KEY, reading, SMALL, model, occupied_only=True)
    assert places_of(occupied) == sorted(place for place, odds in twin.items() if odds > zero)


@given(st.integers(0, 10**6), MODELS, STYLES)
def test_each_node_of_a_view_is_the_likeliest_voxel_below(seed: int, model: SensorModel, style: ViewStyle) -> None:
    history = random_history(seed)
    view = view_of(present(history, SMALL, model).evidence, SMALL, model, style)
    up = 3 * (SMALL.depth - view.depth)
    nodes: dict[int, float] = {}
    for place, odds in twin_odds(history, model).items():
        nodes[place >> up] = max(odds, nodes.get(place >> up, -math.inf))
    least = log_odds(model.p_occupied) if style.extent is Extent.OCCUPIED else -math.inf
    expected = {node: odds for node, odds in nodes.items() if odds > least}
    assert view.nodes.tolist() == sorted(expected)
    steps = [round(expected[node] / LOG_ODDS_STEP) + LOG_ODDS_ZERO for node in view.nodes.tolist()]
    assert view.chances.tolist() == pytest.approx(steps, abs=1)


@given(st.integers(0, 10**6), MODELS)
def test_each_point_of_a_snapshot_reads_as_the_twin_says(seed: int, model: SensorModel) -> None:
    history = random_history(seed)
    snapshot, twin = snapshot_of_history(history, model), twin_odds(history, model)
    places = np.arange(8**SMALL.depth, dtype=np.uint32)
    points = centres_of_voxels(voxels_in_cell(places, KEY, SMALL), SMALL)
    zero = log_odds(model.p_occupied)
    states = {place: State.OCCUPIED if odds > zero else State.FREE for place, odds in twin.items()}
    assert snapshot.state_at(points).tolist() == [states.get(place, State.UNKNOWN) for place in places.tolist()]
    odds = [twin.get(place, math.nan) for place in places.tolist()]
    np.testing.assert_allclose(snapshot.log_odds_at(points), odds, rtol=0, atol=LOG_ODDS_STEP)
    assert places_of(snapshot.occupied_in()) == sorted(place for place, odds in twin.items() if odds > zero)
    known, packed = snapshot.voxels_in(), snapshot.frozen.cells[0].packed()
    np.testing.assert_allclose(
        snapshot.log_odds_at(known.centres_m),
        np.where((packed.counts != 0).any(axis=1), packed.log_odds(model), np.nan),
        rtol=1e-12,
    )


@given(st.integers(0, 10**6), MODELS, st.sampled_from([None, Epoch(3)]))
def test_each_reading_has_the_time_of_the_newest_samples_that_it_shows(
    seed: int, model: SensorModel, at: Epoch | None
) -> None:
    history, rows = random_history(seed), epoch_map()
    for epoch, row in history.rows.items():
        change(rows, epoch, row)
    snapshot, reading = snapshot_of(MapReading(rows, at=at), model), present(history, SMALL, model, at=at)
    points = centres_of_voxels(voxels_in_cell(np.arange(8**SMALL.depth, dtype=np.uint32), KEY, SMALL), SMALL)
    for column, channel in enumerate(SMALL.channels):
        expected = np.full(len(points), np.nan)
        epochs = reading.sampled_in[:, column]
        dated = epochs != BASE
        expected[reading.voxels[reading.sampled[dated]]] = epochs[dated] * 120.0
        found = snapshot.measured_at(points[::-1], channel.name)[::-1]
        np.testing.assert_array_equal(found, expected)
        # Whatever has a time has samples, and the files of the cell say the same.
        assert (snapshot.reading_at(points, channel.name).weight[np.isfinite(found)] > 0).all()
        voxels = voxels_of_evidence(KEY, reading.dated_evidence(120), SMALL, model, occupied_only=False)
        np.testing.assert_array_equal(voxels.readings[channel.name].measured_s, expected[places_of(voxels)])


def one_row(epoch: Epoch, cells: EvidenceMap) -> MapReading:
    """A map with epochs whose cells have one row each, the sums of a map without."""
    rows = epoch_map()
    for key in cells:
        change(rows, epoch, cells.evidence(key), key=key)
    return MapReading(rows)


def reading_of(row: Evidence, epoch: Epoch) -> Evidence:
    return present(cell_history({epoch: row}), SMALL, MODEL).evidence


@pytest.mark.parametrize("epoch", [BASE, Epoch(7)])
def test_files_of_one_row_are_those_of_the_sums(epoch: Epoch) -> None:
    sums = random_map(3, SMALL).packed()
    readings = {key: reading_of(row, epoch) for key, row in sums.items()}
    for asked in (ExportRequest(format="ot"), ExportRequest(format="bt", p=0.75), ExportRequest(format="ot", depth=2)):
        assert octomap_file(readings, SMALL, asked) == octomap_file(sums, SMALL, asked)
    for key, row in sums.items():
        for suffix in MEDIA_TYPES:
            assert cell_file(suffix, key, readings[key], SMALL, MODEL) == cell_file(suffix, key, row, SMALL, MODEL)
        for style in (ViewStyle(extent=Extent.KNOWN), ViewStyle(depth=2)):
            files = [encode_view(key, it, SMALL, MODEL, style=style) for it in (readings[key], row)]
            assert files[0] == files[1]
        asked = ExportRequest(p=0.75)
        assert np.array_equal(*(chosen_places(key, it, SMALL, MODEL, asked) for it in (readings[key], row)))


@pytest.mark.parametrize("epoch", [BASE, Epoch(7)])
@pytest.mark.parametrize("p_occupied", [0.3, 0.5, 0.7])
def test_queries_of_one_row_are_those_of_the_sums(epoch: Epoch, p_occupied: float) -> None:
    whole, model = random_map(4, SMALL), SensorModel(p_occupied=p_occupied)
    # Four times as often, so that some voxels are at the model's bounds.
    for _ in range(2):
        whole.merge(whole.packed())
    sums, reading = snapshot_of(whole, model), snapshot_of(one_row(epoch, whole), model)
    rng = np.random.default_rng(1)
    points, directions = rng.uniform(-1, 1, (500, 3)), rng.normal(size=(500, 3))
    exact: list[Callable[[MapSnapshot], np.ndarray]] = [
        lambda it: it.state_at(points),
        lambda it: it.counts_at(points),
        lambda it: it.temperature_at(points).mean,
        lambda it: it.colour_at(points).mean,
        lambda it: it.cast_rays(points, directions, max_range_m=3).distance_m,
        lambda it: it.nearest_occupied(points, radius_m=0.5).distance_m,
        lambda it: it.check_sphere(points, radius_m=0.1).states,
        lambda it: it.frontier(),
        lambda it: it.height_map().values,
        lambda it: it.layer_at(0.1, "state").values,
        lambda it: it.occupied_in().numbers,
        lambda it: it.voxels_in().numbers,
        lambda it: it.hottest(9).numbers,
    ]
    for ask in exact:
        np.testing.assert_array_equal(ask(reading), ask(sums))
    np.testing.assert_allclose(reading.log_odds_at(points), sums.log_odds_at(points), rtol=0, atol=LOG_ODDS_STEP / 2)
    np.testing.assert_allclose(reading.probability_at(points), sums.probability_at(points), rtol=0, atol=3e-4)
    # What is at a bound of the model is exactly there.
    at_bound = np.isin(sums.log_odds_at(points), [log_odds(model.p_min), log_odds(model.p_max)])
    assert at_bound.any()
    assert np.array_equal(reading.log_odds_at(points)[at_bound], sums.log_odds_at(points)[at_bound])


def test_pictures_of_one_row_are_those_of_the_sums() -> None:
    whole = random_map(5, SMALL)
    snapshots = snapshot_of(whole), snapshot_of(one_row(Epoch(7), whole))
    for eye_m in ((0.7, 0.6, 0.5), (-0.5, 0.3, 0.2)):
        T = look_at(eye_m, (0, 0, 0))
        drawn = [(renderer := MapRenderer(), renderer.nearest(it, SIGHT, T, range_max_m=3)) for it in snapshots]
        assert np.array_equal(drawn[0][1].range_m, drawn[1][1].range_m, equal_nan=True)
        assert drawn[0][1].hit.any()
        for layer in [layer for layer in Layer if layer not in GROUND_LAYERS]:
            values = [
                layer_values(renderer, it, seen, layer) for it, (renderer, seen) in zip(snapshots, drawn, strict=True)
            ]
            np.testing.assert_allclose(values[1], values[0], rtol=0, atol=3e-4)


def test_a_cell_that_is_read_for_a_picture_may_be_a_reading() -> None:
    rows = epoch_map()
    for n, cell in enumerate(((0, 0, 0), (0, 0, 1), (-1, 0, 0))):
        for epoch, row in random_history(n).rows.items():
            change(rows, epoch, row, key=cell_key(cell))
    reading, T = MapReading(rows), look_at((0.7, 0.6, 0.5), (0, 0, 0))
    cells, snapshot, renderer = reading.frozen_cells(MODEL), snapshot_of(reading, MODEL), MapRenderer()
    for layer in (Layer.PROBABILITY, Layer.TEMPERATURE):
        read = {key: read_cell(cell, SMALL, MODEL, layer) for key, cell in cells.items()}  # type: ignore[arg-type]

        def some(keys: list[CellKey], read: dict = read) -> dict:  # type: ignore[type-arg]
            return {key: read[key] for key in keys}

        drawing = draw_as_needed(
            renderer,
            SMALL,
            MODEL,
            {},
            list(cells),
            some,
            sight=SIGHT,
            T_map_camera=T,
            range_max_m=3,  # type: ignore[arg-type]
        )
        expected = MapRenderer().nearest(snapshot, SIGHT, T, range_max_m=3)
        np.testing.assert_allclose(drawing.seen.range_m, expected.range_m, rtol=1e-5)
        values = layer_values(renderer, drawing.snapshot, drawing.seen, layer)
        np.testing.assert_allclose(values, layer_values(MapRenderer(), snapshot, expected, layer), rtol=1e-5)


def test_a_wall_that_vanished_is_free_in_a_snapshot_and_was_there_before() -> None:
    rows = epoch_map()
    places = np.arange(64, dtype=np.uint32)
    for epoch, counts in ((Epoch(3), (200, 0)), (Epoch(5), (0, 9))):
        wall = np.tile(counts, (64, 1)).astype(np.int32)
        nothing = np.zeros((0, SMALL.plane_count), np.int64)
        change(rows, epoch, Evidence(places, wall, np.empty(0, np.uint32), nothing))
    point = centres_of_voxels(voxels_in_cell(places[:1], KEY, SMALL), SMALL)
    now, then = (snapshot_of(MapReading(rows, at=at)) for at in (None, Epoch(4)))
    assert (now.state_at(point)[0], then.state_at(point)[0]) == (State.FREE, State.OCCUPIED)
    assert (now.seen_at(point)[0], then.seen_at(point)[0]) == (5 * 120, 3 * 120)


def test_a_snapshot_follows_the_rows_and_reads_only_cells_that_changed() -> None:
    rows = epoch_map()
    for n, cell in enumerate(((0, 0, 0), (0, 0, 1))):
        for epoch, row in random_history(n).rows.items():
            change(rows, epoch, row, key=cell_key(cell))
    reading = MapReading(rows)
    first = snapshot_of(reading)
    diff = random_history(9).rows[BASE]
    newest = max(rows.rows(cell_key((0, 0, 0))))
    change(rows, newest, diff, key=cell_key((0, 0, 0)))
    reading.note({cell_key((0, 0, 0)): diff}, epoch=newest, sign=1)
    then, fresh = first.refreshed(reading), snapshot_of(MapReading(rows))
    assert np.array_equal(then.frozen.grid.words, fresh.frozen.grid.words)
    assert [a.sums[0] is b.sums[0] for a, b in zip(first.frozen.states, then.frozen.states, strict=True)].count(
        True
    ) == 1


def test_a_temperature_is_as_old_as_its_samples_and_not_as_its_voxel() -> None:
    rows, place = epoch_map(), np.zeros(1, np.uint32)
    samples = np.zeros((1, SMALL.plane_count), np.int64)
    samples[0, SMALL.planes_of("temperature")] = [6000 * 4, 6000**2 * 4, 4]
    hit = np.array([[5, 0]], np.int32)
    change(rows, Epoch(3), Evidence(place, hit, place, samples))
    change(rows, Epoch(8), Evidence(place, hit, np.empty(0, np.uint32), samples[:0]))
    snapshot, point = snapshot_of(rows), centres_of_voxels(voxels_in_cell(place, KEY, SMALL), SMALL)
    assert snapshot.seen_at(point).tolist() == [8 * 120]
    assert snapshot.measured_at(point, "temperature").tolist() == [3 * 120]
    assert np.isnan(snapshot.measured_at(point, "colour")).all()
    with pytest.raises(BadInputError, match="smell"):
        snapshot.measured_at(point, "smell")


def test_files_say_when_samples_were_measured_in_maps_with_epochs_alone() -> None:
    history = random_history(5)
    sums, reading = history.total(SMALL), present(history, SMALL, MODEL)
    for suffix, name in (("npz", b"temperature_measured_s"), ("ply", b"property double temperature_measured_s")):
        files = [
            cell_file(suffix, KEY, it, SMALL, MODEL)[0] for it in (sums, reading.evidence, reading.dated_evidence(9))
        ]
        assert [name in file for file in files] == [False, False, True]


def test_a_map_without_epochs_has_no_times() -> None:
    snapshot = snapshot_of(random_map(1, SMALL))
    assert np.isnan(snapshot.seen_at(np.zeros((2, 3)))).all()
    assert np.isnan(snapshot.measured_at(np.zeros((2, 3)), "temperature")).all()
