"""Point queries of a snapshot, and its staying unchanged."""

import math
import tracemalloc

import numpy as np
import pytest
from tests.fixtures.map.made import DOSE, GEOMETRIES, MIDDLE, PLAIN, SMALL, random_evidence
from tests.fixtures.map.worlds import map_of, random_map, random_points, snapshot_with, world_of
from tests.naive import queries as naive

from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel
from cairn_map.evidence.evidence import COUNT_MAX, packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CELL_LIMIT, Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries import point_queries
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State

HALVES = SensorModel(p_hit=0.6, p_miss=0.4)
"""A hit says as much as a miss: ties are many."""


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that every test has several."""
    monkeypatch.setattr(point_queries, "CHUNK", 128)


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("seed", [1, 2])
def test_states_and_counts_are_those_of_the_twin(geometry: Geometry, seed: int) -> None:
    whole = random_map(seed, geometry)
    world, snapshot = world_of(whole), snapshot_of(whole)
    points = random_points(seed, whole, 700)
    voxels = [naive.voxel_at(point, geometry.voxel_edge_um * 1000) for point in points.tolist()]
    assert snapshot.state_at(points).tolist() == [naive.state(world, voxel) for voxel in voxels]
    counts = snapshot.counts_at(points)
    assert counts.tolist() == [list(world.get(voxel, (0, 0))[:2]) for voxel in voxels]
    seen = (counts != 0).any(axis=1)
    np.testing.assert_array_equal(snapshot.log_odds_at(points)[seen], SensorModel().log_odds(counts[seen]))
    np.testing.assert_allclose(snapshot.probability_at(points), SensorModel().probability(counts), rtol=1e-15)
    assert np.isnan(snapshot.log_odds_at(points)[~seen]).all()


@pytest.mark.parametrize("seed", [1, 2])
def test_readings_are_those_of_the_twin(seed: int) -> None:
    whole = random_map(seed, SMALL)
    world, snapshot = world_of(whole), snapshot_of(whole)
    voxels = sorted(world)[::2] + [(x + 5, y, z) for x, y, z in sorted(world)[::20]]
    points = (np.array(voxels) + 0.5) * SMALL.voxel_edge_m
    nothing = (0,) * SMALL.plane_count
    sums = np.array([world.get(voxel, (0, 0, nothing))[2] for voxel in voxels], float)
    for channel in SMALL.channels:
        mine = sums[:, SMALL.planes_of(channel.name)]
        reading = snapshot.reading_at(points, channel.name)
        assert reading.weight.tolist() == mine[:, -1].tolist()
        has = mine[:, -1] > 0
        assert has.any()
        values = mine[has, : channel.value_count] / mine[has, -1:] * channel.step + channel.zero
        np.testing.assert_allclose(reading.mean[has].reshape(len(values), -1), values)
        assert np.isnan(reading.mean[~has]).all()
    planes = sums[:, SMALL.planes_of("temperature")]
    has = planes[:, -1] > 0
    variance = planes[has, 1] / planes[has, 2] - (planes[has, 0] / planes[has, 2]) ** 2
    spread = snapshot.temperature_at(points).spread
    assert spread is not None
    np.testing.assert_allclose(spread[has], np.sqrt(variance) * TEMPERATURE.step)
    assert np.isnan(spread[~has]).all()
    for read, channel in ((snapshot.colour_at, COLOUR), (snapshot.intensity_at, INTENSITY)):
        assert read(points).channel == channel
    assert snapshot.colour_at(points).mean.shape == (len(points), 3)
    assert snapshot.reading_at(points, "dose").channel == DOSE


def test_sums_of_more_than_32_bits_are_read_whole() -> None:
    geometry = Geometry(voxel_edge_um=50_000, depth=3, channels=(INTENSITY, TEMPERATURE))
    sums = np.array([[7, 1, 300, 1 << 40, 3]])
    whole = EvidenceMap(geometry)
    whole.merge({cell_key((0, 0, 0)): packed_evidence(np.array([7], np.uint32), np.array([[3, 0]]), sums, geometry)})
    reading = snapshot_of(whole).temperature_at([[0.07, 0.07, 0.07]])
    assert reading.spread is not None
    assert reading.spread[0] == pytest.approx(math.sqrt((1 << 40) / 3 - 100**2) * TEMPERATURE.step)
    assert snapshot_of(whole).intensity_at([[0.07, 0.07, 0.07]]).mean.tolist() == [7]


@pytest.mark.parametrize("hits", [0, 1, 5, 32_767, 32_768, COUNT_MAX])
@pytest.mark.parametrize("model", [SensorModel(), HALVES])
def test_states_of_counts_of_any_size_are_those_of_the_model(hits: int, model: SensorModel) -> None:
    voxels = {(x, 0, 0): (hits, min(max(hits + x - 4, 0), COUNT_MAX)) for x in range(8)}
    snapshot = snapshot_of(map_of(PLAIN, voxels), model)
    points = [[(x + 0.5) * 0.05, 0.01, 0.01] for x in range(8)]
    counts = np.array(list(voxels.values()))
    expected = (counts != 0).any(axis=1) * 1 + model.occupied(counts)
    assert snapshot.state_at(points).tolist() == expected.tolist()
    assert snapshot.counts_at(points).tolist() == counts.tolist()
    np.testing.assert_array_equal(snapshot.probability_at(points), model.probability(counts))


def test_a_point_on_a_border_is_in_the_upper_voxel() -> None:
    snapshot = snapshot_with(PLAIN, {(3, 0, 0): (1, 0), (-1, 0, 0): (0, 1)})
    borders = [[0.15, 0, 0], [0.2, 0, 0], [-0.05, 0, 0], [0, 0, 0], [-1e-10, 0, 0], [-1e-9, 0, 0]]
    assert snapshot.state_at(borders).tolist() == [2, 0, 1, 0, 0, 1]


def test_every_voxel_of_the_largest_cell_has_its_place() -> None:
    geometry = Geometry(voxel_edge_um=20_000, depth=8, channels=())
    rng = np.random.default_rng(1)
    voxels = rng.integers(-256, 256, (300, 3))
    counts = {tuple(voxel): (n, 1) for n, voxel in enumerate(voxels.tolist())}
    found = snapshot_with(geometry, counts).counts_at((voxels + 0.5) * 0.02)
    assert found.tolist() == [list(counts[tuple(voxel)]) for voxel in voxels.tolist()]


def test_an_empty_map_knows_nothing() -> None:
    snapshot = snapshot_of(EvidenceMap(MIDDLE))
    assert snapshot.state_at([[0, 0, 0], [1e6, 0, 0]]).tolist() == [0, 0]
    assert snapshot.counts_at([[0, 0, 0]]).tolist() == [[0, 0]]
    assert np.isnan(snapshot.probability_at([[0, 0, 0]])).all()
    assert snapshot.temperature_at([[0, 0, 0]]).weight.tolist() == [0]
    assert snapshot.state_at(np.empty((0, 3))).shape == (0,)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300, CELL_LIMIT * MIDDLE.cell_edge_m])
@pytest.mark.parametrize("what", ["state_at", "counts_at", "log_odds_at", "probability_at", "colour_at"])
def test_points_outside_the_numbered_space_are_refused(what: str, bad: float) -> None:
    snapshot = snapshot_of(random_map(1, MIDDLE))
    points = np.zeros((300, 3))
    points[299, 1] = bad
    with pytest.raises(BadInputError) as refused:
        getattr(snapshot, what)(points)
    assert refused.value.kind == "point_range"


@pytest.mark.parametrize("bad", [[1, 2, 3], [[1, 2]], [["a", "b", "c"]], 5])
def test_what_is_no_list_of_points_is_refused(bad: object) -> None:
    with pytest.raises(BadInputError) as refused:
        snapshot_of(EvidenceMap(PLAIN)).state_at(bad)  # type: ignore[arg-type]
    assert refused.value.kind == "bad_points"


def test_many_points_need_little_memory_beside_their_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_queries, "CHUNK", 1 << 14)
    snapshot, points = snapshot_of(random_map(1, MIDDLE)), np.full((1 << 19, 3), 0.1)
    for ask, answer_bytes in (
        (snapshot.state_at, 1),
        (snapshot.counts_at, 8),
        (snapshot.probability_at, 8),
        (lambda p: snapshot.cast_rays(p, p, max_range_m=0.5), 57),
    ):
        ask(points[:1])  # type: ignore[no-untyped-call]
        tracemalloc.start()
        try:
            ask(points)  # type: ignore[no-untyped-call]
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < answer_bytes * len(points) + 3_000_000


def test_a_channel_that_the_map_does_not_have_is_refused() -> None:
    snapshot = snapshot_of(random_map(1, PLAIN))
    for ask in (snapshot.colour_at, snapshot.temperature_at, lambda p: snapshot.reading_at(p, "dose")):
        with pytest.raises(BadInputError) as refused:
            ask([[0, 0, 0]])
        assert refused.value.kind == "unknown_channel"


def test_a_cell_at_the_end_of_the_numbered_space_is_found() -> None:
    far = (CELL_LIMIT - 2) * PLAIN.side
    snapshot = snapshot_with(PLAIN, {(far, -far, 0): (1, 0)})
    points = [[(far + 0.5) * 0.05, (0.5 - far) * 0.05, 0.02], [(0.5 - far) * 0.05, (far + 0.5) * 0.05, 0.02]]
    assert snapshot.state_at(points).tolist() == [State.OCCUPIED, State.UNKNOWN]


def test_a_snapshot_does_not_see_what_is_merged_later() -> None:
    whole = random_map(1, SMALL)
    diff = {cell_key((0, 0, 0)): random_evidence(77, SMALL, voxels=200), cell_key((9, 9, 9)): random_evidence(5, SMALL)}
    points = random_points(3, whole, 900)

    def answers(snapshot: MapSnapshot) -> list[list[float]]:
        read = snapshot.counts_at(points), snapshot.state_at(points), snapshot.temperature_at(points).weight
        return [array.tolist() for array in (*read, snapshot.voxels_in().numbers)]

    first = snapshot_of(whole)
    before = answers(first)
    whole.merge(diff)
    merged = first.refreshed(whole)
    assert answers(first) == before
    assert answers(merged) == answers(snapshot_of(whole)) != before
    whole.unmerge(diff)
    assert answers(merged) != before
    assert answers(merged.refreshed(whole)) == before
    whole.clear()
    assert answers(first) == before
    assert len(merged.refreshed(whole).voxels_in()) == 0


def test_a_refreshed_snapshot_reads_only_the_cells_that_changed_anew() -> None:
    whole = random_map(1, SMALL)
    first = snapshot_of(whole)
    whole.merge({cell_key((0, 0, 0)): random_evidence(7, SMALL)})
    old, new = first._frozen, first.refreshed(whole)._frozen
    kept = [key for key, a, b in zip(new.keys, old.states, new.states, strict=True) if a.sums is b.sums]
    assert kept == [key for key in whole if key != cell_key((0, 0, 0))]


def test_another_model_reads_the_same_counts_otherwise() -> None:
    whole = map_of(PLAIN, {(0, 0, 0): (1, 2)})
    states = [snapshot_of(whole, SensorModel(p_miss=p)).state_at([[0, 0, 0]])[0] for p in (0.4, 0.2)]
    assert states == [State.OCCUPIED, State.FREE]


def test_a_map_without_channels_has_voxels_without_readings() -> None:
    found = snapshot_of(random_map(1, PLAIN)).voxels_in([[0, 0, 0], [0.1, 0.1, 0.1]])
    assert found.readings == {}
    assert (found.numbers >= 0).all()
    assert (found.numbers < 2).all()


def test_two_scalar_channels_are_read_by_name() -> None:
    gas = Channel(kind=DOSE.kind, name="gas", unit="ppm", step=2.0)
    geometry = Geometry(voxel_edge_um=50_000, depth=3, channels=(DOSE, gas))
    whole = EvidenceMap(geometry)
    sums = np.array([[300, 2, 50, 5]])
    whole.merge({cell_key((0, 0, 0)): packed_evidence(np.array([0], np.uint32), np.array([[0, 0]]), sums, geometry)})
    snapshot = snapshot_of(whole)
    assert snapshot.reading_at([[0, 0, 0]], "gas").mean.tolist() == [20]
    assert snapshot.reading_at([[0, 0, 0]], "dose").mean.tolist() == [0]
    # A reading alone does not say whether a voxel is occupied.
    assert snapshot.state_at([[0, 0, 0]]).tolist() == [State.UNKNOWN]
    assert np.isnan(snapshot.probability_at([[0, 0, 0]])).all()
