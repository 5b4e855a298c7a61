"""Physical values of evidence against sums taken voxel by voxel in exact fractions."""

from collections.abc import Callable
from fractions import Fraction
from math import sqrt

import numpy as np
import pytest
from tests.fixtures.map.made import GEOMETRIES, KEY, SMALL, as_dict, random_evidence, surface_evidence
from tests.naive import evidence as naive_evidence

from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import Geometry, cell_key, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import joined_voxels, voxels_of_evidence

MODEL = SensorModel()
geometries = pytest.mark.parametrize("geometry", GEOMETRIES)


@pytest.mark.slow
@geometries
@pytest.mark.parametrize("made", [random_evidence, surface_evidence])
def test_numbers_counts_means_and_spreads_are_those_of_the_sums(
    geometry: Geometry, made: Callable[[int, Geometry], Evidence]
) -> None:
    evidence = made(2, geometry)
    found = voxels_of_evidence(KEY, evidence, geometry, MODEL, occupied_only=False)
    side, edge_m = 2**geometry.depth, geometry.voxel_edge_um / 1e6
    corner = np.array(cell_of_key(KEY)) * side
    assert len(found) == len(evidence)
    for row, (place, (hits, misses, sums)) in enumerate(as_dict(evidence).items()):
        number = corner + naive_evidence.deinterleave(place)
        assert found.numbers[row].tolist() == number.tolist()
        np.testing.assert_allclose(found.centres_m[row], (number + 0.5) * edge_m, rtol=1e-12)
        assert found.counts[row].tolist() == [hits, misses]
        for channel in geometry.channels:
            reading = found.readings[channel.name]
            mine = sums[geometry.planes_of(channel.name)]
            assert reading.weight[row] == mine[-1]
            if not mine[-1]:
                assert np.isnan(reading.mean[row]).all()
                continue
            means = [Fraction(value, mine[-1]) for value in mine[: channel.value_count]]
            expected = [float(mean) * channel.step + channel.zero for mean in means]
            np.testing.assert_allclose(np.atleast_1d(reading.mean[row]), expected, rtol=1e-12, atol=1e-12)
            if channel.kind is ChannelKind.TEMPERATURE:
                assert reading.spread is not None
                variance = max(Fraction(mine[1], mine[-1]) - means[0] ** 2, Fraction(0))
                assert reading.spread[row] == pytest.approx(sqrt(variance) * channel.step, abs=1e-4)
            else:
                assert reading.spread is None


@geometries
def test_the_occupied_are_the_rows_whose_probability_is_above_the_bound(geometry: Geometry) -> None:
    evidence = surface_evidence(4, geometry)
    every = voxels_of_evidence(KEY, evidence, geometry, MODEL, occupied_only=False)
    occupied = voxels_of_evidence(KEY, evidence, geometry, MODEL, occupied_only=True)
    rows = np.nonzero(every.probability > MODEL.p_occupied)[0]
    assert 0 < len(rows) < len(every)
    expected = every.rows(rows)
    np.testing.assert_array_equal(occupied.numbers, expected.numbers)
    np.testing.assert_array_equal(occupied.counts, expected.counts)
    for name, reading in occupied.readings.items():
        np.testing.assert_array_equal(reading.mean, expected.readings[name].mean)
        np.testing.assert_array_equal(reading.weight, expected.readings[name].weight)


def test_tables_of_cells_joined_have_the_rows_of_each_in_turn() -> None:
    keys = [cell_key((0, 0, 0)), cell_key((-1, 0, 2)), cell_key((1, 0, 0))]
    parts = [
        voxels_of_evidence(key, random_evidence(n, SMALL), SMALL, MODEL, occupied_only=False)
        for n, key in enumerate(keys)
    ]
    whole, start = joined_voxels(parts), 0
    assert len(whole) == sum(map(len, parts))
    assert len(np.unique(whole.numbers, axis=0)) == len(whole)
    for part in parts:
        mine = whole.rows(np.arange(start, start + len(part)))
        start += len(part)
        np.testing.assert_array_equal(mine.numbers, part.numbers)
        np.testing.assert_array_equal(mine.centres_m, part.centres_m)
        np.testing.assert_array_equal(mine.probability, part.probability)
        for name, reading in part.readings.items():
            np.testing.assert_array_equal(mine.readings[name].mean, reading.mean)
            assert (mine.readings[name].spread is None) == (reading.spread is None)
            if reading.spread is not None:
                np.testing.assert_array_equal(mine.readings[name].spread, reading.spread)
    temperature = whole.of_kind(ChannelKind.TEMPERATURE)
    assert temperature is not None and temperature.channel.kind is ChannelKind.TEMPERATURE
