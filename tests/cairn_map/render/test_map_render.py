"""Rendered maps against twins that cut every ray with every voxel; and the readings of pixels."""

from functools import partial

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.bounded import result_within
from tests.fixtures.map.made import PLAIN, SMALL
from tests.fixtures.map.worlds import map_of, random_map, snapshot_with
from tests.naive import sight as naive_sight

from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries import occupancy_kernels
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.queries.occupancy_states import State
from cairn_map.render.camera_rays import CameraRays, cells_in_sight, look_at, pinhole
from cairn_map.render.map_picture import layer_values
from cairn_map.render.map_render import MapRenderer, SurfaceImage
from cairn_map.render.partial_map import ReadCell, draw_as_needed, read_cell
from cairn_map.render.render_picture import Layer

EDGE_M = 0.05
SIGHT = pinhole(20, 14, focal_px=16)
FINE = pinhole(20, 14, focal_px=4000)
"""So fine that every voxel is larger than a pixel."""
DEEP = Geometry(voxel_edge_um=50_000, depth=5, channels=())


def random_pose(rng: np.random.Generator, within_m: float = 0.8) -> npt.NDArray[np.float64]:
    return look_at(rng.uniform(-within_m, within_m, 3).tolist(), rng.uniform(-within_m, within_m, 3).tolist())


def voxels_by_state(snapshot: MapSnapshot) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """(V, 3) numbers of the occupied voxels, and of the free ones."""
    known = snapshot.voxels_in()
    states = snapshot.state_at(known.centres_m)
    return known.numbers[states == State.OCCUPIED], known.numbers[states == State.FREE]


def voxels_seen(snapshot: MapSnapshot, seen: SurfaceImage) -> npt.NDArray[np.int64]:
    """(N, 3) numbers of the voxels at which what is seen is entered."""
    corners = snapshot.frozen.grid.cells[seen.slots[seen.hit]] * snapshot.geometry.side
    inside = occupancy_kernels.squeeze
    places = seen.places[seen.hit].astype(np.uint64)
    return corners + np.array([[int(inside(place >> np.uint64(axis))) for axis in range(3)] for place in places])


@pytest.mark.parametrize("geometry", [PLAIN, DEEP])
@pytest.mark.parametrize("is_beyond", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_each_pixel_sees_what_cutting_all_voxels_finds(geometry: Geometry, seed: int, is_beyond: bool) -> None:
    rng = np.random.default_rng(seed)
    snapshot = snapshot_of(random_map(seed, geometry))
    occupied, free = voxels_by_state(snapshot)
    target = (occupied[rng.integers(len(occupied))] + 0.5) * EDGE_M
    T = look_at((target + rng.uniform(-0.5, 0.5, 3)).tolist(), target.tolist())
    # The rays of a coarse camera under the angles of a fine one: so that none sees nodes.
    sight = CameraRays(SIGHT.rays[::2, ::2])
    object.__setattr__(sight, "pixel_rad", FINE.pixel_rad)
    starts = rng.uniform(-0.2, 0.3, (7, 10)).astype(np.float32)
    starts[rng.random(starts.shape) < 0.1] = np.nan
    ends = starts + rng.uniform(0.3, 2, starts.shape).astype(np.float32)
    renderer = MapRenderer()
    look = renderer.beyond if is_beyond else renderer.nearest
    seen = look(snapshot, sight, T, range_max_m=1.5, between_m=(starts, ends))
    origin = np.rint(T[:3, 3] * 1e9) / 50_000_000
    expected, voxels = [], []
    for ray, start, end in zip(sight.rays.reshape(-1, 3), starts.ravel(), ends.ravel(), strict=True):
        direction = T[:3, :3] @ ray
        span = max(float(start), 0) / EDGE_M, min(float(end), 1.5) / EDGE_M
        if np.isnan(start):
            at, row = np.nan, -1
        elif is_beyond:
            at, row = naive_sight.first_beyond(origin, direction, occupied, free, *span)
        else:
            at, row = naive_sight.first_cut(origin, direction, occupied, *span)
        expected.append(at * EDGE_M)
        voxels += [occupied[row]] if row >= 0 else []
    np.testing.assert_allclose(seen.range_m.ravel(), expected, atol=1e-5)
    assert (voxels_seen(snapshot, seen) == np.array(voxels)).all()
    assert seen.hit.any()
    assert not seen.hit.all()
    assert not seen.nodes.any()


@pytest.mark.parametrize("axes", [[0], [2], [0, 1, 2]])
@pytest.mark.parametrize("eye_m", [(0.1, 0.1, 0.1), (5, 5, 5)])
def test_a_pixel_without_a_ray_sees_nothing_and_the_others_see_what_they_saw(
    axes: list[int], eye_m: tuple[float, float, float]
) -> None:
    snapshot, renderer, T = snapshot_of(random_map(1, PLAIN)), MapRenderer(), look_at(eye_m, (0, 0, 0))
    rays = SIGHT.rays.copy()
    rays[:2, :3, axes] = np.nan  # in a corner: the angle between neighbours in the middle stays
    there = ~np.isnan(rays).any(axis=2)
    blind = CameraRays(rays)
    zeros = np.zeros(there.shape, np.float32)
    span_m = zeros, zeros + 30
    for see in (renderer.nearest, renderer.beyond):
        seen = result_within(20.0, partial(see, snapshot, blind, T, range_max_m=30, between_m=span_m))
        whole = see(snapshot, SIGHT, T, range_max_m=30, between_m=span_m)
        assert not seen.hit[~there].any()
        np.testing.assert_array_equal(seen.range_m[there], whole.range_m[there])


def test_what_is_seen_reads_as_the_map_at_that_place() -> None:
    rng = np.random.default_rng(5)
    snapshot, renderer = snapshot_of(random_map(5, SMALL)), MapRenderer()
    sight = CameraRays(SIGHT.rays)
    object.__setattr__(sight, "pixel_rad", FINE.pixel_rad)
    for _ in range(3):
        seen = renderer.nearest(snapshot, sight, random_pose(rng), range_max_m=3)
        points = (voxels_seen(snapshot, seen) + 0.5) * EDGE_M
        np.testing.assert_allclose(
            renderer.probability(snapshot, seen)[seen.hit], snapshot.probability_at(points), rtol=1e-6
        )
        for values, reading in (
            (renderer.temperature(snapshot, seen), snapshot.temperature_at(points)),
            (renderer.colour(snapshot, seen), snapshot.colour_at(points)),
        ):
            np.testing.assert_allclose(values[seen.hit], reading.mean, rtol=1e-6)
            assert np.isnan(values[~seen.hit]).all()
            assert np.isnan(reading.mean).any() and not np.isnan(reading.mean).all()


def test_threads_change_nothing() -> None:
    snapshot, T = snapshot_of(random_map(3, SMALL)), look_at((0.3, -0.5, 0.2), (0, 0, 0))
    one, three = MapRenderer(), MapRenderer(threads=3)
    a, b = (r.nearest(snapshot, pinhole(64, 48, focal_px=40), T, range_max_m=3) for r in (one, three))
    for name in ("range_m", "slots", "places", "nodes"):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name == "range_m")
    assert one.temperature(snapshot, a).tobytes() == three.temperature(snapshot, b).tobytes()
    assert a.hit.any()


@pytest.mark.parametrize("distance_m", [2.0, 6.0, 12.0, 45.0])
def test_no_voxel_is_so_far_that_it_slips_between_pixels(distance_m: float) -> None:
    rng, sight, renderer = np.random.default_rng(1), pinhole(32, 24, focal_px=60), MapRenderer()
    nodes = set()
    for _ in range(40):
        target = rng.uniform(-0.3, 0.3, 3)
        snapshot = snapshot_with(DEEP, {tuple(np.floor(target / EDGE_M).astype(int).tolist()): (3, 0)})
        away = rng.normal(size=3)
        eye = target + away / np.linalg.norm(away) * distance_m
        seen = renderer.nearest(snapshot, sight, look_at(eye.tolist(), target.tolist()), range_max_m=50)
        # The diagonal of a pixel is 4.7 cm wide at 2 m; above a brick's 40 cm it is from 17 m on.
        assert seen.hit.any() or distance_m > 17
        nodes |= set(seen.nodes[seen.hit].tolist())
    assert nodes <= {{2.0: 0, 6.0: 2, 12.0: 3, 45.0: 3}[distance_m]}


def test_a_node_is_the_mean_of_its_samples_and_the_likeliest_of_its_voxels() -> None:
    geometry = SMALL
    whole = random_map(2, geometry)
    snapshot, renderer = snapshot_of(whole), MapRenderer()
    seen = renderer.nearest(snapshot, pinhole(24, 18, focal_px=14), look_at((1.1, 0.1, 0.2), (0, 0, 0)), range_max_m=5)
    assert len(set(seen.nodes[seen.hit].tolist())) > 1
    found = {layer: layer_values(renderer, snapshot, seen, layer) for layer in (Layer.TEMPERATURE, Layer.PROBABILITY)}
    known = snapshot.voxels_in()
    thermal = known.readings["temperature"]
    voxels = iter(voxels_seen(snapshot, seen))
    for y, x in zip(*np.nonzero(seen.hit), strict=True):
        size = 1 << int(seen.nodes[y, x])
        inside = (known.numbers // size == next(voxels) // size).all(axis=1)
        weight = thermal.weight[inside]
        mean = np.nansum(thermal.mean[inside] * weight) / weight.sum() - 273.15 if weight.any() else np.nan
        assert found[Layer.TEMPERATURE][y, x] == pytest.approx(mean, nan_ok=True, abs=1e-3)
        assert found[Layer.PROBABILITY][y, x] == pytest.approx(np.nanmax(known.probability[inside]), abs=1e-6)


def test_a_map_that_changes_is_drawn_as_it_is() -> None:
    rng, renderer = np.random.default_rng(9), MapRenderer()
    whole, more = random_map(6, SMALL), random_map(7, SMALL)
    snapshot = snapshot_of(whole)
    for step in range(3):
        T = random_pose(rng)
        seen = renderer.nearest(snapshot, SIGHT, T, range_max_m=3)
        values = renderer.temperature(snapshot, seen)
        again = MapRenderer().temperature(snapshot, MapRenderer().nearest(snapshot, SIGHT, T, range_max_m=3))
        assert np.array_equal(values, again, equal_nan=True)
        whole.merge({key: more.evidence(key) for key in list(more)[step::3]})
        snapshot = snapshot.refreshed(whole)


def test_a_wall_hides_and_what_is_behind_it_is_beyond() -> None:
    """Wall of two voxels, a room of free ones, a thing; the wall's own back is no thing behind it."""
    wall = {(x, y, z): (3, 0) for x in (10, 11, 13) for y in range(-8, 8) for z in range(-8, 8)}
    room = {(x, y, z): (0, 3) for x in range(14, 20) for y in range(-8, 8) for z in range(-8, 8)}
    thing = {(20, y, z): (3, 0) for y in range(-8, 8) for z in range(-8, 8)}
    renderer, T = MapRenderer(), look_at((0.0, 0.01, 0.01), (1.0, 0.01, 0.01))
    live = np.full((14, 20), 0.5, np.float32)
    between = (live, np.full_like(live, 3))
    for known, expected_m in ((wall | room | thing, 1.0), (wall | thing, np.nan)):
        snapshot = snapshot_with(DEEP, known)
        ahead = pinhole(20, 14, focal_px=200)
        assert renderer.nearest(snapshot, ahead, T, range_max_m=3).depth_m == pytest.approx(0.5, abs=0.01)
        seen = renderer.beyond(snapshot, ahead, T, range_max_m=3, between_m=between)
        assert seen.depth_m[7, 10] == pytest.approx(expected_m, abs=0.01, nan_ok=True)


def test_cells_are_read_only_where_a_ray_comes_to_them() -> None:
    whole = random_map(4, SMALL)
    key_of_far = cell_key((3, 0, 0))
    model, rng = SensorModel(), np.random.default_rng(3)
    full = snapshot_of(whole)
    for _ in range(6):
        T, asked = random_pose(rng), []

        def read(keys: list[CellKey], asked: list[CellKey] = asked) -> dict[CellKey, ReadCell]:
            asked += keys
            found = {key: whole.cell(key) for key in keys}
            return {key: read_cell(cell, SMALL, model, Layer.DEPTH) for key, cell in found.items() if cell is not None}

        drawn = draw_as_needed(
            MapRenderer(),
            SMALL,
            model,
            {},
            list(whole),
            read,
            sight=SIGHT,
            T_map_camera=T,
            range_max_m=3,  # type: ignore[arg-type]
        )
        expected = MapRenderer().nearest(full, SIGHT, T, range_max_m=3)
        np.testing.assert_allclose(drawn.seen.range_m, expected.range_m, rtol=1e-5)
        assert len(set(asked)) == len(asked)
        seen_cells = {full.frozen.keys[slot] for slot in np.unique(expected.slots[expected.hit])}
        assert seen_cells <= set(asked)
    T = look_at((0.2, 0.2, 0.2), (-3, 0.2, 0.2))
    asked = []
    drawn = draw_as_needed(
        MapRenderer(),
        SMALL,
        model,
        {},
        list(whole),
        read,
        sight=SIGHT,
        T_map_camera=T,
        range_max_m=3,  # type: ignore[arg-type]
    )
    assert key_of_far not in drawn.snapshot.frozen.keys[: len(drawn.snapshot.frozen.cells)] or drawn.seen.hit.any()


def test_cells_beside_the_view_are_not_in_sight() -> None:
    rng = np.random.default_rng(2)
    cells = rng.integers(-8, 8, (400, 3))
    for _ in range(20):
        T = random_pose(rng, 3.0)
        inside = cells_in_sight(cells, SIGHT, T, edges_m=(0.4, 0.4, 0.4), range_max_m=2.5)
        points = (cells + rng.random((400, 3))) * 0.4
        in_camera = (points - T[:3, 3]) @ T[:3, :3]
        pixels = in_camera[:, :2] / in_camera[:, 2:] * 16 + [9.5, 6.5]
        seen = (in_camera[:, 2] > 0) & (np.abs(pixels - [9.5, 6.5]) < [9.5, 6.5]).all(axis=1)
        seen &= np.linalg.norm(in_camera, axis=1) < 2.5
        assert (inside | ~seen).all()
        assert 0 < inside.sum() < 350


def test_ages_are_those_of_blocks() -> None:
    whole = map_of(DEEP, {(4, 0, 0): (3, 0), (4, 9, 0): (3, 0)})
    snapshot, renderer, key = snapshot_of(whole), MapRenderer(), cell_key((0, 0, 0))
    changes = np.full(8**3, np.nan)
    changes[1], changes[8 * 2 + 1] = 100.0, 1e9  # blocks of x 4 to 7; y 0 to 3 and 8 to 11
    for eye, when in (((0.0, 0.02, 0.02), 100.0), ((0.0, 0.47, 0.02), 1e9)):
        T = look_at(eye, (0.2, eye[1], eye[2]))
        seen = renderer.nearest(snapshot, pinhole(4, 4, focal_px=40), T, range_max_m=3)
        assert seen.hit.all()
        assert (renderer.changed(snapshot, seen, {key: changes}) == when).all()
        assert np.isnan(renderer.changed(snapshot, seen, {})).all()


def test_an_empty_map_shows_nothing() -> None:
    snapshot = snapshot_of(EvidenceMap(SMALL))
    seen = MapRenderer(threads=2).nearest(snapshot, SIGHT, np.eye(4), range_max_m=5)
    assert not seen.hit.any()
    assert np.isnan(MapRenderer().temperature(snapshot, seen)).all()


@pytest.mark.parametrize("T", [np.eye(3), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1])])
def test_what_is_no_pose_is_refused(T: npt.NDArray[np.float64]) -> None:
    with pytest.raises(BadInputError) as caught:
        MapRenderer().nearest(snapshot_of(EvidenceMap(SMALL)), SIGHT, T, range_max_m=5)
    assert caught.value.kind == "bad_pose"
