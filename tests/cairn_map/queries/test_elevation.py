"""Elevation of a level layer: what stands on the ground does not move it; slopes and steps of known shapes."""

import io
import math
import tracemalloc
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from tests.naive.evidence import interleave

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Geometry, cell_key, level_geometry
from cairn_map.queries import region_queries
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.queries.level import elevation
from cairn_map.queries.level.elevation import Elevation, Vehicle
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State
from cairn_map.render.elevation_picture import elevation_npz, elevation_png

LEVEL = level_geometry()
Vote = tuple[int, int, float]
"""Column along x and y, height in metres."""
Voxels = Sequence[tuple[int, int, int]]


def snapshot_with(votes: list[Vote], *, tops: Voxels = (), passed: Voxels = ()) -> MapSnapshot:
    """A map of cell 0,0,0 with these votes, and with voxels that were hit without a vote, or seen through."""
    found: dict[tuple[int, int, int], list[int]] = {}
    for x, y, height in votes:
        own = math.floor(height / 0.05)
        sums = found.setdefault((x, y, own), [0, 0, 0, 0])
        for n, each in enumerate((1, 0, round((height - own * 0.05) * 200), 1)):
            sums[n] += each
    for column, voxels in ((0, tops), (1, passed)):
        for voxel in voxels:
            found.setdefault(voxel, [0, 0, 0, 0])[column] += 1
    numbers = np.array(list(found))
    sums = np.array(list(found.values()))
    places = np.array([interleave(*number) for number in numbers.tolist()], np.uint32)
    total = EvidenceMap(LEVEL)
    total.merge({cell_key((0, 0, 0)): packed_evidence(places, sums[:, :2], sums[:, 2:], LEVEL)})
    return snapshot_of(total)


def at(ground: Elevation, values: np.ndarray, x: int, y: int) -> float:
    column = round(ground.origin_m[0] / 0.2 - 0.5), round(ground.origin_m[1] / 0.2 - 0.5)
    return float(values[y - column[1], x - column[0]])


CASES: dict[str, Callable[[np.random.Generator], float]] = {
    "clean": lambda rng: rng.normal(1.0, 0.02),
    "wrong heights": lambda rng: rng.normal(1.0, 0.02) if rng.random() > 0.1 else rng.uniform(1.0, 3.0),
    "grass": lambda rng: min(rng.normal(1.0, 0.015) if rng.random() > 0.7 else rng.uniform(1.0, 1.3) for _ in range(4)),
    "a person who stood": lambda rng: rng.normal(1.0, 0.02) if rng.random() > 0.33 else rng.uniform(1.1, 2.8),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_above_the_ground_does_not_move_it(case: str) -> None:
    rng = np.random.default_rng(7)
    votes = [(x, y, CASES[case](rng)) for x in range(12) for y in range(12) for _ in range(60)]
    ground = snapshot_with(votes).elevation()
    error = ground.height_m[:12, :12] - 1.0
    assert np.median(np.abs(error)) <= 0.02
    assert np.mean(np.abs(error) <= 3 * ground.sigma_m[:12, :12]) >= 0.99


def test_under_a_bridge_the_road_is_read_and_the_deck_is_no_obstacle() -> None:
    rng = np.random.default_rng(3)
    votes = [(5, 5, rng.normal(0.5, 0.02)) for _ in range(10)] + [(5, 5, rng.normal(3.0, 0.02)) for _ in range(50)]
    ground = snapshot_with(votes).elevation()
    assert abs(at(ground, ground.height_m, 5, 5) - 0.5) <= 0.12
    assert at(ground, ground.obstacle_m, 5, 5) == 0
    assert np.nanmax(snapshot_with(votes).elevation(clearance_m=3.0).obstacle_m) == pytest.approx(2.5, abs=0.12)
    above = snapshot_with(votes).elevation(box_m=[[0, 0, 2], [3, 3, 4]])
    assert at(above, above.height_m, 5, 5) == pytest.approx(3.0, abs=0.02)


def test_fewer_than_two_votes_or_15_percent_are_no_surface() -> None:
    assert np.isnan(snapshot_with([(1, 1, 0.5)]).elevation().height_m).all()
    for low, expected in ((8, 2.0), (9, 0.5)):
        votes = [(1, 1, 0.5)] * low + [(1, 1, 2.0)] * (60 - low)
        ground = snapshot_with(votes).elevation()
        assert at(ground, ground.height_m, 1, 1) == pytest.approx(expected, abs=1e-9)
        assert at(ground, ground.votes, 1, 1) == (low if expected == 0.5 else 60 - low)


def test_things_are_obstacles_where_as_many_scans_saw_them_and_grass_is_seen_through() -> None:
    votes = [(x, 1, 0.02) for x in (1, 2, 3) for _ in range(10)]
    tops = [(1, 1, 16)] * 5 + [(2, 1, 16)] + [(3, 1, 5)] * 3
    ground = snapshot_with(votes, tops=tops, passed=[(3, 1, 5)] * 9).elevation()
    assert [at(ground, ground.obstacle_m, x, 1) for x in (1, 2, 3)] == pytest.approx([0.83, 0, 0])
    assert [at(ground, ground.difficulty(), x, 1) > 1 for x in (1, 2, 3)] == [True, False, False]


def test_slopes_roughness_and_steps_of_known_shapes() -> None:
    slope = snapshot_with([(x, y, 1 + 0.05 * x) for x in range(6) for y in range(6) for _ in range(3)]).elevation()
    assert at(slope, slope.slope_rad, 3, 3) == pytest.approx(math.atan(0.25), abs=1e-6)
    assert at(slope, slope.roughness_m, 3, 3) == pytest.approx(0, abs=1e-6)
    assert at(slope, slope.step_m, 3, 3) == pytest.approx(0.05)
    kerb = snapshot_with([(x, y, 1 + 0.2 * (x > 3)) for x in range(8) for y in range(6) for _ in range(3)]).elevation()
    assert [at(kerb, kerb.step_m, x, 3) for x in (1, 3, 4, 6)] == pytest.approx([0, 0.2, 0.2, 0])
    assert at(kerb, kerb.difficulty(Vehicle(step_max_m=0.1)), 3, 3) == pytest.approx(2.0)
    line = snapshot_with([(x, 1, 1.0) for x in range(6) for _ in range(3)]).elevation()
    assert np.isnan(line.slope_rad).all()
    assert np.isnan(at(line, line.difficulty(), 0, 3))
    assert at(line, line.difficulty(), 2, 1) == 0


def test_tiles_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    votes = [
        (x, y, rng.normal(1 + 0.1 * x, 0.05)) for x in range(9) for y in range(11) if (x + y) % 5 for _ in range(4)
    ]
    snapshot = snapshot_with(votes)
    whole = snapshot.elevation().arrays()
    for pixels in (1, 7, 300):
        monkeypatch.setattr(elevation, "TILE_PIXELS", pixels)
        tiled = snapshot.elevation().arrays()
        assert all(np.array_equal(tiled[name], whole[name], equal_nan=True) for name in whole)


def test_an_elevation_takes_little_more_memory_than_its_answer_and_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    total = EvidenceMap(LEVEL)
    one = packed_evidence(np.zeros(1, np.uint32), np.array([[1, 0]]), np.array([[0, 2]]), LEVEL)
    total.merge({cell_key((0, 0, 0)): one, cell_key((15, 15, 0)): one})
    snapshot = snapshot_of(total)
    tracemalloc.start()
    ground = snapshot.elevation()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    pixels = ground.height_m.size
    assert pixels > 10 * elevation.TILE_PIXELS
    assert peak < 100 * pixels
    monkeypatch.setattr(region_queries, "ELEVATION_PIXELS_MAX", pixels - 1)
    with pytest.raises(BadInputError, match="give a smaller box") as refused:
        snapshot.elevation()
    assert refused.value.kind == "too_large"
    assert snapshot.elevation(box_m=[[0, 0, 0], [2, 2, 2]]).votes.sum() == 2


def test_a_long_row_takes_no_more_memory_than_a_square() -> None:
    total = EvidenceMap(LEVEL)
    one = packed_evidence(np.zeros(1, np.uint32), np.array([[1, 0]]), np.array([[0, 2]]), LEVEL)
    far = 8 * elevation.TILE_PIXELS // LEVEL.side
    total.merge({cell_key((0, 0, 0)): one, cell_key((far, 0, 0)): one})
    snapshot, box_m = snapshot_of(total), [[0, 0, 0], [far * LEVEL.cell_edge_m + 0.2, 0.2, 1]]
    tracemalloc.start()
    row = snapshot.elevation(box_m=box_m)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (len(row.height_m), row.votes.sum()) == (1, 4)
    assert peak < 100 * row.height_m.size


def test_points_and_slices_of_flat_voxels_are_where_they_are() -> None:
    snapshot = snapshot_with([(1, 2, 0.52)] * 4, passed=[(1, 2, 40)])
    points = [[0.3, 0.5, 0.51], [0.3, 0.5, 0.549], [0.3, 0.5, 0.55], [0.3, 0.5, 2.01], [0.3, 0.5, 0.49]]
    assert snapshot.state_at(points).tolist() == [State.OCCUPIED, State.OCCUPIED, 0, State.FREE, 0]
    assert snapshot.reading_at(points[:1], "height").mean.tolist() == [20]
    assert snapshot.voxels_in([[0, 0, 0.5], [1, 1, 0.56]]).centres_m[0].tolist() == pytest.approx([0.3, 0.5, 0.525])
    assert np.nanmax(snapshot.height_map().values) == pytest.approx(0.55)
    assert LayeredSnapshot({"ground": snapshot}).names_at(points[:1]) == ["ground"]


@pytest.mark.parametrize(
    "ask",
    [
        lambda level: level.cast_rays([[0, 0, 1]], [[1, 0, 0]], max_range_m=5),
        lambda level: level.nearest_occupied([[0, 0, 1]], radius_m=1),
        lambda level: level.check_sphere([[0, 0, 1]], radius_m=1),
        lambda level: level.floor_grid(ground_m=0),
        lambda level: level.grounds(),
        lambda level: level.hot_spots(),
        lambda level: level.frontier(),
        lambda level: level.frontier_cells(),
    ],
)
def test_questions_about_space_are_refused(ask: Callable[[MapSnapshot], object]) -> None:
    with pytest.raises(BadInputError) as refused:
        ask(snapshot_with([(1, 1, 0.5)] * 2))
    assert refused.value.kind == "level_layer"


def test_cubes_have_no_elevation_and_limits_are_checked() -> None:
    with pytest.raises(BadInputError, match="--kind level") as refused:
        snapshot_of(EvidenceMap(Geometry())).elevation()
    assert refused.value.kind == "not_level"
    with pytest.raises(BadInputError, match="clearance"):
        snapshot_of(EvidenceMap(LEVEL)).elevation(clearance_m=0)
    with pytest.raises(BadInputError, match="step_max_m"):
        Vehicle(step_max_m=0)
    assert snapshot_of(EvidenceMap(LEVEL)).elevation().height_m.shape == (0, 0)


def test_files_hold_all_of_it() -> None:
    ground = snapshot_with([(x, y, 1 + 0.1 * x) for x in range(4) for y in range(4) for _ in range(3)]).elevation()
    with np.load(io.BytesIO(elevation_npz(ground))) as found:
        assert {*found} == {*ground.arrays(), "difficulty"}
        assert np.array_equal(found["height_m"], ground.height_m, equal_nan=True)
    assert elevation_png(ground).startswith(b"\x89PNG")
