"""Order of cells, and the temperature of a cell's hottest voxel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import GEOMETRIES, MIDDLE, PLAIN, random_evidence

from cairn_map.evidence.brick_cell import difference
from cairn_map.evidence.cell_order import HOT_ABOVE_K, HOT_RINGS, first_to_last, hottest_k
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Cell, Geometry

HERE = Cell(0, 0, 0)
COLD_K, FIRE_K = 293.0, 900.0


def slow_hottest_k(evidence: Evidence, geometry: Geometry) -> float | None:
    """Voxel by voxel."""
    planes = geometry.planes_of(TEMPERATURE.name)
    means = [0.05 * row[planes][0] / row[planes][-1] for row in evidence.samples.tolist() if row[planes][-1] > 0]
    return max(means, default=None)


def order(rings: list[int], kelvin: list[float], *, near: Cell | None = HERE) -> list[int]:
    """Cells on one axis, in the order of their change."""
    cells = np.array([[ring, 0, 0] for ring in rings], np.int64).reshape(-1, 3)
    found = first_to_last(cells, near=near, changed=np.arange(len(rings)), hottest_k=np.array(kelvin, np.float64))
    return [int(n) for n in found]


@pytest.mark.parametrize("geometry", [geometry for geometry in GEOMETRIES if geometry is not PLAIN])
@pytest.mark.parametrize("seed", range(5))
def test_the_hottest_voxel_is_that_of_the_highest_mean(geometry: Geometry, seed: int) -> None:
    evidence = random_evidence(seed, geometry)
    assert hottest_k(evidence, geometry) == pytest.approx(slow_hottest_k(evidence, geometry), rel=1e-12)
    signed = difference(evidence, random_evidence(seed + 1, geometry), geometry)
    assert hottest_k(signed, geometry) == pytest.approx(slow_hottest_k(signed, geometry), rel=1e-12)


def test_what_has_no_temperature_has_no_hottest_voxel() -> None:
    assert hottest_k(random_evidence(1, PLAIN), PLAIN) is None
    assert hottest_k(empty_evidence(MIDDLE), MIDDLE) is None


def test_the_robots_surroundings_come_before_a_fire_far_away_and_that_before_walls_nearer_than_it() -> None:
    rings = [9, 8, 5, 3, 2, 1, 0]
    kelvin = [COLD_K, FIRE_K, *[COLD_K] * 5]
    assert order(rings, kelvin) == [6, 5, 4, 1, 3, 2, 0]


def test_without_a_place_hot_cells_come_first_and_then_the_newest() -> None:
    assert order([1, 2, 3, 4], [COLD_K, FIRE_K, COLD_K, COLD_K], near=None) == [1, 3, 2, 0]


@pytest.mark.parametrize("kelvin", [[COLD_K + n % 2 * HOT_ABOVE_K for n in range(9)], [FIRE_K] * 9, [np.nan] * 9])
def test_what_is_no_hotter_than_the_rest_does_not_come_first(kelvin: list[float]) -> None:
    assert order([3, 3, 1, 1, 1, 7, 9, 8, 8], kelvin) == [4, 3, 2, 1, 0, 5, 8, 7, 6]


@given(st.lists(st.tuples(st.integers(0, 40), st.sampled_from([np.nan, COLD_K, 300.0, 350.0, FIRE_K]))))
def test_no_cell_waits_for_hot_ones_that_are_more_than_some_times_as_far(cells: list[tuple[int, float]]) -> None:
    rings = [ring for ring, _ in cells]
    found = order(rings, [kelvin for _, kelvin in cells])
    assert sorted(found) == list(range(len(cells)))
    for place, n in enumerate(found):
        assert all(rings[before] <= HOT_RINGS * rings[n] for before in found[:place])


def test_no_cells_have_an_order() -> None:
    assert order([], []) == []
