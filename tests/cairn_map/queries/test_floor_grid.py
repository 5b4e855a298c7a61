"""Floor grids against their slow twin, and the laws that a robot which drives by them relies on."""

import math

import numpy as np
import pytest
from tests.fixtures.map.worlds import map_of, snapshot_with
from tests.naive import queries as naive

from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import Geometry
from cairn_map.queries.floor_grid import FREE, OCCUPIED, UNKNOWN, FloorGrid
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of

Number = tuple[int, int, int]
Voxels = dict[Number, tuple[int, int]]

GRIDS = [Geometry(voxel_edge_um=50_000, depth=depth, channels=()) for depth in (3, 4, 5)]
GROUND_M, BAND_M = 0.2, (0.1, 0.6)
ZONE_LOW, BAND_LOW, BAND_HIGH = 2, 6, 16
"""Voxels of 5 cm with centres from 0.125 m, 0.325 m and 0.825 m on: the ground's, the band's, and above."""
WIDTH, DEPTH = 21, 18
AIR, WALL = (0, 2), (4, 0)


def storey(seed: int) -> Voxels:
    """A ground with holes and steps, air with gaps, a few obstacles; around the origin, across cells of every size."""
    rng, voxels = np.random.default_rng(seed), Voxels()
    for x in range(-WIDTH // 2, WIDTH // 2):
        for y in range(-DEPTH // 2, DEPTH // 2):
            top = int(rng.integers(1, 7)) if rng.random() < 0.3 else 3
            for z in range(top + 1, 20):
                if rng.random() < 0.99:
                    voxels[x, y, z] = AIR if rng.random() < 0.985 else WALL
            if rng.random() < 0.9:
                voxels[x, y, top] = WALL
    return voxels


def grid_of(snapshot: MapSnapshot) -> FloorGrid:
    return snapshot.floor_grid(ground_m=GROUND_M, band_m=BAND_M)


def columns_of(grid: FloorGrid) -> dict[tuple[int, int], int]:
    """Known pixels by the numbers of their voxels."""
    x, y = (round(value / grid.edge_m) for value in grid.origin_m)
    rows, columns = np.nonzero(grid.values != UNKNOWN)
    return {
        (x + column, y + row): int(grid.values[row, column])
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
    }


@pytest.mark.parametrize("geometry", GRIDS)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_floor_is_that_of_the_twin(geometry: Geometry, seed: int) -> None:
    voxels = storey(seed)
    world: naive.World = {voxel: (*counts, ()) for voxel, counts in voxels.items()}
    heights = {"zone_low": ZONE_LOW, "band_low": BAND_LOW, "band_high": BAND_HIGH}
    expected = {
        column: value
        for column in {(x, y) for x, y, _ in voxels}
        if (value := naive.floor_column(world, column, **heights)) != UNKNOWN
    }
    found = columns_of(grid_of(snapshot_with(geometry, voxels)))
    assert found == expected
    assert set(found.values()) == {FREE, OCCUPIED}


def test_the_floor_does_not_depend_on_how_the_map_is_split_into_cells() -> None:
    voxels = storey(3)
    one, *others = (columns_of(grid_of(snapshot_with(geometry, voxels))) for geometry in GRIDS)
    assert all(other == one for other in others)
    assert one


def test_a_voxel_in_the_band_makes_its_column_occupied_and_no_other() -> None:
    voxels, rng = storey(4), np.random.default_rng(4)
    before = columns_of(grid_of(snapshot_with(GRIDS[0], voxels)))
    columns = sorted({(x, y) for x, y, _ in voxels})
    for _ in range(20):
        x, y = columns[rng.integers(len(columns))]
        z = int(rng.integers(BAND_LOW, BAND_HIGH))
        after = columns_of(grid_of(snapshot_with(GRIDS[0], voxels | {(x, y, z): WALL})))
        assert after == before | {(x, y): OCCUPIED}


def test_nothing_is_free_where_a_voxel_down_to_the_ground_is_unseen() -> None:
    voxels, rng = storey(5), np.random.default_rng(5)
    before = columns_of(grid_of(snapshot_with(GRIDS[1], voxels)))
    free = sorted(column for column, value in before.items() if value == FREE)
    for _ in range(20):
        column = free[rng.integers(len(free))]
        top = max(z for z in range(ZONE_LOW, BAND_LOW) if voxels.get((*column, z)) == WALL)
        unseen = (*column, int(rng.integers(top, BAND_HIGH)))
        below = {(*column, z) for z in range(ZONE_LOW, top)}
        less = {voxel: counts for voxel, counts in voxels.items() if voxel != unseen and voxel not in below}
        after = columns_of(grid_of(snapshot_with(GRIDS[1], less)))
        assert after == {known: value for known, value in before.items() if known != column}


def test_air_down_into_a_hole_is_not_free_and_neither_is_an_empty_map() -> None:
    hole: Voxels = {(0, 0, z): AIR for z in range(-10, 20)} | {(0, 0, -11): WALL}
    assert columns_of(grid_of(snapshot_with(GRIDS[0], hole))) == {}
    assert columns_of(grid_of(snapshot_with(GRIDS[0], {}))) == {}
    with pytest.raises(NotFoundError, match="map the floor"):
        snapshot_with(GRIDS[0], {}).grounds()


def test_a_box_is_a_part_of_the_whole_floor() -> None:
    snapshot = snapshot_with(GRIDS[2], storey(6))
    whole = columns_of(grid_of(snapshot))
    box_m = [[-0.21, -0.1, 0.0], [0.2, math.inf, 0.1]]
    part = snapshot.floor_grid(ground_m=GROUND_M, band_m=BAND_M, box_m=box_m)
    inside = {(x, y): value for (x, y), value in whole.items() if -4 <= x <= 3 and y >= -2}
    assert columns_of(part) == inside != {}
    assert part.origin_m == pytest.approx((-0.2, -0.1))
    assert part.values.shape[1] == 8


def test_every_storey_has_a_ground_and_a_table_has_none() -> None:
    house: Voxels = {}
    for x in range(20):
        for y in range(20):
            height = dict.fromkeys(range(1, 40), AIR) | dict.fromkeys(range(61, 100), AIR)
            is_table = x < 6 and y < 6
            height |= {20: WALL} if is_table else {}
            house |= {(x, y, z): counts for z, counts in ({0: WALL, 60: WALL} | height).items() if y < 14 or z < 60}
    grounds = snapshot_of(map_of(GRIDS[2], house)).grounds()
    assert [height_m for height_m, _ in grounds] == pytest.approx([0.05, 3.05])
    assert [area_m2 for _, area_m2 in grounds] == pytest.approx([(400 - 36) * 0.0025, 280 * 0.0025])


@pytest.mark.parametrize("band_m", [(0.01, 1.0), (0.5, 0.5), (0.1, math.inf), (math.nan, 1.0)])
def test_bands_that_no_robot_has_are_refused(band_m: tuple[float, float]) -> None:
    snapshot = snapshot_with(GRIDS[0], storey(1))
    with pytest.raises(BadInputError, match="at least a voxel"):
        snapshot.floor_grid(ground_m=0.0, band_m=band_m)
    with pytest.raises(BadInputError, match="within"):
        snapshot.floor_grid(ground_m=math.nan)
