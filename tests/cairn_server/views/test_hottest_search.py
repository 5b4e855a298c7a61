"""`GET .../main/hottest`: the voxels that a whole map names, found in the hottest cells alone."""

from itertools import product

import numpy as np
import pytest
from tests.fixtures.map.changing import GEOMETRY, scans
from tests.fixtures.map.made import PLAIN, SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.epoch_pushes import KNOWS_EPOCHS, pushed_in
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_client.folders.map_folder import open_map
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.grid import cell_key
from cairn_map.queries.region_queries import ranked_hottest
from cairn_map.wire.hottest_messages import HottestAnswer
from cairn_server.store.store_rows import MapRow
from cairn_server.views import hottest_search

CELLS = [cell_key(cell) for cell in product((-1, 0, 1), (-1, 0), (0, 1))]
BOX = (-0.3, -0.2, 0.0, 0.4, 0.3, 0.3)
HITS = 40
"""As many scans as hits."""


def asked(live: Live, row: MapRow, **query: object) -> HottestAnswer:
    answer = live.http.get(f"/maps/{row.name}/main/hottest", params=query, headers=KNOWS_EPOCHS)  # type: ignore[arg-type]
    assert answer.status_code == 200, answer.text
    return HottestAnswer.model_validate(answer.json())


def random_map(live: Live, epoch_s: int | None) -> MapRow:
    row = live.new_map(SMALL, epoch_s=epoch_s)
    for n in range(3):
        cells = {key: random_evidence(31 * n + m, SMALL, voxels=200) for m, key in enumerate(CELLS)}
        if epoch_s is None:
            commit = pushed(n, 0, cells=cells)
        else:
            commit = pushed_in(Epoch(n + 1), n, 0, layer=row.layer, cells=cells)
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    return row


def map_of(live: Live, *looks: tuple[list[tuple[int, int, int]], int, float | None]) -> MapRow:
    """A map in which voxels were hit so often, and have a temperature."""
    row = live.new_map(GEOMETRY)
    for n, (voxels, hits, kelvin) in enumerate(looks):
        found = scans(np.array(voxels), 0, hits=hits, kelvin=kelvin)
        cells = {key: history.rows[Epoch(0)] for key, history in found.items()}
        commit = pushed(n, 0, geometry=GEOMETRY, cells=cells, scans=HITS)
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    return row


@pytest.mark.parametrize("epoch_s", [None, 100])
def test_the_hottest_are_those_of_the_whole_map(live: Live, epoch_s: int | None) -> None:
    row = random_map(live, epoch_s)
    whole = open_map(f"http://127.0.0.1:{live.port}/maps/{row.name}")
    for count, box in ((1, None), (7, None), (60, None), (1000, None), (5, BOX), (1000, BOX)):
        box_m = None if box is None else np.reshape(box, (2, 3))
        voxels, are_sure = ranked_hottest(whole.frozen, count, min_probability=0.5, box_m=box_m)
        kelvin = voxels.readings["temperature"].mean
        query = {"count": count} | ({} if box is None else {"box": ",".join(map(str, box))})
        found = asked(live, row, **query)
        assert found.complete
        assert [v.mean for v in found.voxels] == kelvin.tolist()
        assert [v.confirmed for v in found.voxels] == are_sure.tolist()
        # Of equally hot ones at the end of the list, any may be named.
        above = {tuple(place) for place in voxels.numbers[kelvin != kelvin[-1]].tolist()}
        assert above <= {v.voxel for v in found.voxels}
        points = np.array([v.point_m for v in found.voxels])
        np.testing.assert_array_equal(whole.temperature_at(points).mean, [v.mean for v in found.voxels])
        np.testing.assert_array_equal(whole.counts_at(points), [(v.hits, v.misses) for v in found.voxels])
        measured_s = [np.nan if v.measured_s is None else v.measured_s for v in found.voxels]
        np.testing.assert_array_equal(whole.measured_at(points, "temperature"), measured_s)
        assert all(v.celsius == pytest.approx(v.mean - 273.15, abs=0.01) for v in found.voxels)


def test_only_the_cells_that_may_be_hotter_are_looked_at(live: Live) -> None:
    fires = [([(40 * n, 0, 0)], 2, 300.0 + n) for n in range(12)]
    row = map_of(live, *fires)
    one = asked(live, row, count=1)
    assert ([v.mean for v in one.voxels], one.searched) == ([pytest.approx(311.0)], 1)
    three = asked(live, row, count=3)
    assert [v.mean for v in three.voxels] == [pytest.approx(kelvin) for kelvin in (311, 310, 309)]
    assert three.searched == 3
    assert asked(live, row, count=100).searched == 12


def test_a_ghost_comes_after_what_was_seen_twice_however_hot_it_is(live: Live) -> None:
    row = map_of(live, ([(3, 3, 3)], 1, 400.0), ([(40, 0, 0)], 2, 310.0))
    found = asked(live, row, count=2)
    assert [(v.voxel, v.confirmed) for v in found.voxels] == [((40, 0, 0), True), ((3, 3, 3), False)]
    assert [v.voxel for v in asked(live, row, count=1).voxels] == [(40, 0, 0)]


def test_a_surface_in_the_next_cell_confirms_a_voxel_at_the_border(live: Live) -> None:
    side = GEOMETRY.side
    next_door = [(side, y, 5) for y in (4, 5, 6)]
    row = map_of(live, ([(side - 1, 5, 5)], 1, 350.0), (next_door, 1, None))
    (found,) = asked(live, row, count=1).voxels
    assert (found.voxel, found.cell, found.confirmed) == ((side - 1, 5, 5), (0, 0, 0), True)


def test_what_a_bound_ended_says_so(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    side = GEOMETRY.side
    next_door = [(side, y, 5) for y in (4, 5, 6)]
    row = map_of(live, ([(side - 1, 5, 5)], 1, 350.0), (next_door, 1, 300.0))
    with monkeypatch.context() as small:
        small.setattr(hottest_search, "CELLS_BYTES", 1)
        alone = asked(live, row, count=1)
    assert (alone.complete, [v.confirmed for v in alone.voxels]) == (False, [False])
    monkeypatch.setattr(hottest_search, "SEARCH_S", -1.0)
    late = asked(live, row, count=5)
    assert (late.voxels, late.complete, late.searched) == ([], False, 0)


def test_what_has_no_temperature_has_no_hottest(live: Live) -> None:
    plain, empty = live.new_map(PLAIN), live.new_map(SMALL)
    assert kind_of(live.http.get(f"/maps/{plain.name}/main/hottest")) == "unknown_channel"
    assert asked(live, empty).voxels == []
    for box in ("1,2,3", "1,0,0,0,1,1", "a,b,c,d,e,f"):
        assert kind_of(live.http.get(f"/maps/{empty.name}/main/hottest", params={"box": box})) == "bad_box"
