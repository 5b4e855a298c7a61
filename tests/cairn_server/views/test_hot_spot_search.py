"""`GET .../main/hotspots`: the spots of a whole map, of which only changed cells are read again."""

from itertools import product

import numpy as np
import pytest
from tests.fixtures.map.changing import GEOMETRY, scans
from tests.fixtures.map.made import PLAIN, SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.deadline import until
from tests.fixtures.server.epoch_pushes import KNOWS_EPOCHS, pushed_in
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_client.folders.map_folder import open_map
from cairn_map.commits.commit import Commit
from cairn_map.epochs.epoch import Epoch
from cairn_map.evidence.grid import cell_key
from cairn_map.wire.hot_spot_messages import HotSpotsAnswer
from cairn_server.live.fold_news import FoldNews
from cairn_server.store.store_rows import MapRow
from cairn_server.views import hot_spot_search
from cairn_server.views.cell_views import ViewCache
from cairn_server.views.view_prefetch import ViewPrefetch

CELLS = [cell_key(cell) for cell in product((-1, 0, 1), (-1, 0), (0, 1))]
BOX = (-0.3, -0.2, 0.0, 0.4, 0.3, 0.3)
SIDE = GEOMETRY.side
Voxels = list[tuple[int, int, int]]
PLATE: Voxels = [(x, y, 3) for x in (SIDE - 1, SIDE) for y in (4, 5)]
"""Across the border of two cells."""


def asked(live: Live, row: MapRow, **query: object) -> HotSpotsAnswer:
    answer = live.http.get(f"/maps/{row.name}/main/hotspots", params=query, headers=KNOWS_EPOCHS)  # type: ignore[arg-type]
    assert answer.status_code == 200, answer.text
    return HotSpotsAnswer.model_validate(answer.json())


def push(live: Live, row: MapRow, n: int, voxels: Voxels, kelvin: float, *, hits: int = 2) -> Commit:
    """Push and fold warm voxels."""
    found = scans(np.array(voxels), 0, hits=hits, kelvin=kelvin)
    cells = {key: history.rows[Epoch(0)] for key, history in found.items()}
    commit = pushed(n, 0, geometry=GEOMETRY, cells=cells, scans=hits)
    assert live.push(row, commit).status_code == 201
    live.folded(row)
    return commit


@pytest.mark.parametrize("epoch_s", [None, 100])
def test_the_spots_are_those_of_the_whole_map(live: Live, epoch_s: int | None) -> None:
    row = live.new_map(SMALL, epoch_s=epoch_s)
    for n in range(3):
        cells = {key: random_evidence(31 * n + m, SMALL, voxels=200) for m, key in enumerate(CELLS)}
        commit = pushed(n, 0, cells=cells)
        if epoch_s is not None:
            commit = pushed_in(Epoch(n + 1), n, 0, layer=row.layer, cells=cells)
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    whole = open_map(f"http://127.0.0.1:{live.port}/maps/{row.name}")
    over_k = float(np.median(whole.hot_spots(over_k=0.0, voxels_min=1).kelvin)) - 5.0
    for least, box in ((1, None), (3, None), (1, BOX)):
        box_m = None if box is None else np.reshape(box, (2, 3))
        expected = whole.hot_spots(over_k=over_k, voxels_min=least, box_m=box_m)
        assert len(expected)
        query = {"over_k": over_k, "min_voxels": least, "count": 1000}
        if box is not None:
            query["box"] = ",".join(map(str, box))
        found = asked(live, row, **query)
        while not found.complete:  # the cells that were looked at in its time are kept
            found = asked(live, row, **query)
        assert found.total == len(expected)
        assert [spot.voxel for spot in found.spots] == [tuple(peak) for peak in expected.peaks.tolist()]
        assert [spot.kelvin for spot in found.spots] == pytest.approx(expected.kelvin.tolist(), abs=1e-3)
        assert [(spot.voxels, spot.confirmed) for spot in found.spots] == list(
            zip(expected.voxels.tolist(), expected.confirmed.tolist(), strict=True)
        )
        measured_s = [np.nan if spot.measured_s is None else spot.measured_s for spot in found.spots]
        np.testing.assert_array_equal(expected.measured_s, measured_s)


def test_after_a_push_only_the_cells_that_changed_are_read(live: Live) -> None:
    row = live.new_map(GEOMETRY)
    for n in range(6):
        push(live, row, n, [(40 * n, y, 0) for y in range(3)], 320.0 + n)
    push(live, row, 6, [(400, 0, 0)], 290.0)
    first = asked(live, row)
    assert (first.read, first.total) == (6, 6)
    assert asked(live, row).read == 0
    push(live, row, 7, [(40, 1, 0)], 400.0)
    again = asked(live, row)
    assert (again.read, again.total) == (1, 6)
    assert again.spots[0].voxel == (40, 1, 0)
    assert asked(live, row, over_k=322.5).read == 4


def test_a_spot_says_where_it_is_who_measured_it_and_when(live: Live) -> None:
    row = live.new_map(GEOMETRY)
    floor: Voxels = [(x, y, 0) for x in range(SIDE - 8, SIDE + 8) for y in range(16)]
    push(live, row, 0, floor, 290.0)
    first = push(live, row, 1, PLATE, 330.0)
    (spot,) = asked(live, row).spots
    assert (spot.voxel, spot.voxels, spot.confirmed) == ((SIDE - 1, 4, 3), 4, True)
    assert (spot.celsius, spot.hits, spot.weight) == (pytest.approx(56.85, abs=0.01), 2, 2)
    assert spot.low_m == pytest.approx((0.05 * (SIDE - 1), 0.2, 0.15))
    assert spot.high_m == pytest.approx((0.05 * (SIDE + 1), 0.3, 0.2))
    assert spot.over_floor_m == pytest.approx(2.5 * 0.05)
    assert spot.commit == str(first.id)
    second = push(live, row, 2, PLATE[:2], 340.0)
    newest = asked(live, row).spots[0]
    assert newest.commit == str(second.id)
    assert newest.captured_s is not None
    # What was taken out is no witness, and leaves no heat.
    assert live.retract(row, second).status_code == 201
    live.folded(row)
    assert asked(live, row).spots == [spot]


def test_cells_that_are_read_for_a_picture_are_not_read_again_for_the_list(live: Live) -> None:
    row = live.new_map(GEOMETRY)
    push(live, row, 0, PLATE, 330.0)
    push(live, row, 1, [(400, 0, 0)], 290.0)
    views, store = live.service.views, live.service.store
    prefetch = ViewPrefetch(store, ViewCache(), FoldNews(), look_every_s=0.001, on_read=views.hot_spots.prepare)
    try:
        until(lambda: row.number in prefetch._seen, "views of all cells are made")
    finally:
        prefetch.close()
    found = asked(live, row)
    assert (found.read, found.total) == (0, 1)


def test_what_a_bound_ended_says_so(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map(GEOMETRY)
    push(live, row, 0, PLATE, 330.0)
    with monkeypatch.context() as late:
        late.setattr(hot_spot_search, "SEARCH_S", -1.0)
        assert (asked(live, row).complete, asked(live, row).spots) == (False, [])
    with monkeypatch.context() as small:
        small.setattr(hot_spot_search, "PIECES_BYTES", 1)
        url = f"/maps/{row.name}/main/hotspots"
        assert kind_of(live.http.get(url)) == "too_costly"
    with monkeypatch.context() as hasty:
        hasty.setattr(hot_spot_search, "WITNESS_S", -1.0)
        assert [spot.commit for spot in asked(live, row).spots] == [None]
    assert asked(live, row).spots[0].commit is not None


def test_what_has_no_temperature_or_no_sense_is_refused(live: Live) -> None:
    plain, empty = live.new_map(PLAIN), live.new_map(SMALL)
    assert kind_of(live.http.get(f"/maps/{plain.name}/main/hotspots")) == "unknown_channel"
    assert asked(live, empty).spots == []
    assert kind_of(live.http.get(f"/maps/{empty.name}/main/hotspots", params={"box": "1,2,3"})) == "bad_box"
    for query in ({"over_k": "nan"}, {"count": 0}, {"count": 1001}, {"min_voxels": 0}):
        assert live.http.get(f"/maps/{empty.name}/main/hotspots", params=query).status_code == 422  # type: ignore[arg-type]
