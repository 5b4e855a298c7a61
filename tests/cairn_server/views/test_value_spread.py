"""`GET .../main/spread`: the values of a whole map, counted cell by cell, and again only where a cell changed."""

from itertools import product

import numpy as np
import pytest
from tests.fixtures.map.made import PLAIN, SMALL, surface_evidence
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_client.folders.map_folder import open_map
from cairn_map.arrays import Floats
from cairn_map.evidence.channels import HEIGHT_OFFSET
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire.spread_messages import BINS_MAX, Spread, SpreadAnswer
from cairn_server.store.store_rows import MapRow
from cairn_server.views import value_spread
from cairn_server.views.value_spread import STEP_K

CELLS = [cell_key(cell) for cell in product((-1, 0), (0, 1), (-2, 0))]
SCANS = 64
"""Enough for the counts of surfaces."""


def asked(live: Live, row: MapRow) -> SpreadAnswer:
    answer = live.http.get(f"/maps/{row.name}/main/spread")
    assert answer.status_code == 200, answer.text
    return SpreadAnswer.model_validate(answer.json())


def surfaces(live: Live, seed: int) -> MapRow:
    row = live.new_map(SMALL)
    cells = {key: surface_evidence(100 * seed + n, SMALL) for n, key in enumerate(CELLS)}
    assert live.push(row, pushed(0, 0, cells=cells, scans=SCANS)).status_code == 201
    live.folded(row)
    return row


def assert_counts(found: Spread | None, values: Floats, step: float, places: Floats) -> None:
    """The histogram is that of values, whose bins are these places."""
    assert found is not None
    assert (found.least, found.most) == (pytest.approx(values.min()), pytest.approx(values.max()))
    first = int(places.min())
    assert (found.begin, found.step) == (pytest.approx(first * step), step)
    assert found.counts == np.bincount(places.astype(int) - first).tolist()


def test_all_occupied_voxels_are_counted_by_height_and_temperature(live: Live) -> None:
    row = surfaces(live, 1)
    voxels = open_map(f"http://127.0.0.1:{live.port}/maps/{row.name}").occupied_in()
    kelvin = voxels.readings["temperature"].mean
    kelvin = kelvin[np.isfinite(kelvin)]
    found = asked(live, row)
    assert (found.complete, found.cells) == (True, len(CELLS))
    edge_m = SMALL.voxel_edge_m
    assert_counts(found.height, (voxels.numbers[:, 2] + 0.5) * edge_m, edge_m, voxels.numbers[:, 2])
    assert_counts(found.temperature, kelvin, STEP_K, np.floor(kelvin / STEP_K))


def test_a_cell_is_counted_again_only_when_it_changed(live: Live) -> None:
    row, spread = surfaces(live, 2), live.service.views.spread
    before = spread.counted
    first = asked(live, row)
    counted = spread.counted
    assert asked(live, row) == first
    assert spread.counted == counted == before + len(CELLS)
    change = pushed(1, 0, cells={CELLS[0]: surface_evidence(9, SMALL)}, scans=SCANS)
    assert live.push(row, change).status_code == 201
    live.folded(row)
    assert asked(live, row) != first
    assert spread.counted == counted + 1


def test_a_request_that_takes_too_long_leaves_the_rest_to_the_next(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = surfaces(live, 3)
    with monkeypatch.context() as short:
        short.setattr(value_spread, "COUNT_S", -1.0)
        late = asked(live, row)
    assert (late.complete, late.cells, late.height) == (False, 0, None)
    assert asked(live, row).complete


def test_a_tall_map_has_wider_steps(live: Live) -> None:
    row = live.new_map(SMALL)
    top = 40 * BINS_MAX // SMALL.side
    cells = {cell_key((0, 0, k)): surface_evidence(k, SMALL) for k in (0, top)}
    assert live.push(row, pushed(0, 0, cells=cells, scans=SCANS)).status_code == 201
    live.folded(row)
    height = asked(live, row).height
    assert height is not None
    assert len(height.counts) <= BINS_MAX < 2 * len(height.counts)
    assert height.begin <= height.least < height.most < height.begin + height.step * len(height.counts)
    assert sum(height.counts) == len(open_map(f"http://127.0.0.1:{live.port}/maps/{row.name}").occupied_in().numbers)


def test_a_map_without_temperatures_has_heights_alone(live: Live) -> None:
    row, empty = live.new_map(PLAIN), live.new_map(SMALL)
    assert live.push(row, pushed(0, 0, geometry=PLAIN, cells={CELLS[0]: surface_evidence(0, PLAIN)}, scans=SCANS))
    live.folded(row)
    found = asked(live, row)
    assert found.height is not None
    assert found.temperature is None
    assert (asked(live, empty).height, asked(live, empty).cells) == (None, 0)


def test_heights_of_a_level_are_counted_by_its_bins(live: Live) -> None:
    level = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=3, channels=(HEIGHT_OFFSET,))
    row = live.new_map(level)
    evidence = packed_evidence(
        np.array([0, 4], np.uint32), np.array([[4, 0], [4, 0]]), np.array([[8, 4], [12, 4]]), level
    )
    assert live.push(row, pushed(0, 0, geometry=level, cells={cell_key((0, 0, 1)): evidence})).status_code == 201
    live.folded(row)
    height = asked(live, row).height
    assert height is not None
    assert (height.begin, height.step, height.counts) == (pytest.approx(0.4), 0.05, [1, 1])
