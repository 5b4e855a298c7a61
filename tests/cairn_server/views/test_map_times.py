"""Maps as they were at a time, and what changed between two: by epoch, or from the commits that are kept."""

import io
from collections.abc import Sequence

import httpx
import laspy
import numpy as np
import pytest
from tests.fixtures.map.changing import CRATE, GEOMETRY, MODEL, WALL, Cells, scans
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.epoch_pushes import KNOWS_EPOCHS, pushed_in
from tests.fixtures.server.evidence_contract import SOON
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_map.codec.layer_code import decode_layer_cell
from cairn_map.codec.view_code import decode_view
from cairn_map.commits.commit import Commit
from cairn_map.epochs.changes import map_changes
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.epochs.present import shown_evidence
from cairn_map.evidence.grid import CellKey, cell_of_key, centres_of_voxels
from cairn_map.evidence.view import evidence_of_view
from cairn_map.files.point_clouds import DATED_PCD_POINT, POINT
from cairn_map.wire.change_messages import CellVoxels, ChangesAnswer
from cairn_server.folding.cells_at_rest import stored_history
from cairn_server.store.store_rows import MapRow
from cairn_server.views import map_changes as searches
from cairn_server.views import readings

LAYER = MapLayer(geometry=GEOMETRY, epoch_s=100)
SCANS = 30
WORLD = ((1, scans(CRATE, 1, misses=25)), (1, scans(WALL, 1, hits=12)), (4, scans(CRATE, 4, hits=12)))
"""Epochs and what was seen in them: a wall across two cells, and a crate that comes."""
PILLAR = np.array([[x, y, z] for x in range(-2, 2) for y in range(14, 18) for z in range(14, 18)])
"""Voxels of a pillar across eight cells."""
DOOR = (
    *WORLD,
    (9, scans(WALL, 9, misses=28)),
    (9, scans(CRATE, 9, hits=3, kelvin=300.0)),
    (9, scans(PILLAR, 9, hits=9)),
)
"""And a wall that goes, and a pillar that comes."""
WAYS = ("appeared", "gone", "moved", "warmer", "colder")


def commits_of(world: Sequence[tuple[int, Cells]], layer: MapLayer = LAYER) -> list[Commit]:
    """A commit for each look, in the epoch in which it was made, or with its time."""
    made = []
    for n, (epoch, cells) in enumerate(world):
        diff = {key: history.rows[Epoch(epoch)] for key, history in cells.items()}
        if layer.has_epochs:
            made.append(pushed_in(Epoch(epoch), n, 0, layer=layer, cells=diff, scans=SCANS))
        else:
            until_s = 100.0 * epoch + 50
            made.append(pushed(n, 0, geometry=GEOMETRY, cells=diff, scans=SCANS, captured_until_s=until_s))
    return made


def map_of(live: Live, world: Sequence[tuple[int, Cells]], epoch_s: int | None = 100) -> MapRow:
    row = live.new_map(GEOMETRY, epoch_s=epoch_s)
    for commit in commits_of(world, row.layer):
        assert live.push(row, commit).status_code == 201
    live.folded(row)
    return row


def get(live: Live, row: MapRow, path: str, **query: object) -> httpx.Response:
    return live.http.get(f"/maps/{row.name}/main/{path}", params=query, headers=KNOWS_EPOCHS)  # type: ignore[arg-type]


def places_of(found: list[CellVoxels]) -> set[tuple[float, ...]]:
    return {place for cell in found for place in cell.centres_m}


def cell_paths(live: Live, row: MapRow) -> list[str]:
    return [f"cells/{','.join(map(str, cell_of_key(CellKey(key))))}" for key in live.cells(row)]


@pytest.mark.parametrize("parts_bytes", [0, 1 << 26])
def test_changes_cell_by_cell_are_those_of_the_whole_map(
    live: Live, monkeypatch: pytest.MonkeyPatch, parts_bytes: int
) -> None:
    monkeypatch.setattr(searches, "PARTS_BYTES", parts_bytes)
    row = map_of(live, DOOR)
    with live.service.store.snapshot(row) as snapshot:
        stored = [snapshot.cell(CellKey(key)) for key in live.cells(row)]
    histories = {cell.key: stored_history(cell, LAYER) for cell in stored if cell}
    assert len(histories) > 4
    for since, until in ((1, None), (1, 4), (4, None), (0, 9), (9, None)):
        query = {"since": 100 * since + 30} | ({} if until is None else {"until": 100 * until + 99})
        answer = ChangesAnswer.model_validate(get(live, row, "changes", **query).json())
        last = None if until is None else Epoch(until)
        expected = map_changes(histories, GEOMETRY, MODEL, since=Epoch(since), until=last)
        for way in WAYS:
            centres = np.round(centres_of_voxels(getattr(expected, way), GEOMETRY), 6)
            assert places_of(getattr(answer, way)) == {tuple(place) for place in centres.tolist()}
            assert getattr(answer.counts, way) == len(centres)
        assert answer.since_s == 100 * (since + 1)
    gone = places_of(ChangesAnswer.model_validate(get(live, row, "changes", since=450).json()).gone)
    assert len(gone) == len(WALL)
    # In a box, the same as everywhere, and the cells outside of it count as neighbours.
    boxed = get(live, row, "changes", since=450, box="-0.2,0,0,0.2,1,1").json()
    assert places_of(ChangesAnswer.model_validate(boxed).gone) == {place for place in gone if abs(place[0]) <= 0.2}


def test_a_map_without_epochs_tells_changes_from_its_kept_commits_or_that_it_does_not_know(live: Live) -> None:
    row, with_epochs = map_of(live, DOOR, epoch_s=None), map_of(live, DOOR)
    for query in ({"since": 199}, {"since": 499}, {"since": 199, "until": 499}):
        plain, known = (get(live, each, "changes", **query).json() for each in (row, with_epochs))
        assert plain["counts"] == known["counts"] and plain["gone"] == known["gone"]
    assert live.service.store.forget_evidence(row, before_s=SOON, limit=99) > 0
    for path in ("changes?since=499", f"{cell_paths(live, row)[0]}?at=499", "export?at=499&format=npz"):
        refused = live.http.get(f"/maps/{row.name}/main/{path}")
        assert (refused.status_code, kind_of(refused)) == (409, "not_known")
        assert "epochs" in refused.text
    assert get(live, row, cell_paths(live, row)[0]).status_code == 200


@pytest.mark.parametrize("epoch_s", [100, None])
def test_every_form_at_a_time_is_that_of_a_map_that_had_no_more_then(live: Live, epoch_s: int | None) -> None:
    row, early = map_of(live, DOOR, epoch_s), map_of(live, WORLD, epoch_s)
    for path in cell_paths(live, early):
        for form in (path, f"{path}.npz", f"{path}.ply"):
            then, now = get(live, row, form, at=499), get(live, row, form)
            assert then.content == get(live, early, form).content
            assert then.headers["ETag"] != now.headers["ETag"]
            assert then.headers["ETag"] != get(live, row, form, at=150).headers["ETag"]
        for depth in (1, GEOMETRY.depth):
            assert get(live, row, path, at=499, depth=depth).content == get(live, early, path, depth=depth).content
        total = live.http.get(f"/maps/{row.name}/main/{path}", params={"at": 499})
        assert total.content == live.http.get(f"/maps/{early.name}/main/{path}").content
    assert points_of(live, row, at=499) == points_of(live, early) != points_of(live, row)
    numbers = ",".join(map(str, WALL[0].tolist()))
    then, expected = get(live, row, f"voxels/{numbers}", time=499).json(), get(live, early, f"voxels/{numbers}").json()
    for name in ("hits", "misses", "probability", "channels"):
        assert then[name] == expected[name]
    assert [commit["hits"] for commit in then["commits"]] == [commit["hits"] for commit in expected["commits"]]


def points_of(live: Live, row: MapRow, **query: object) -> set[bytes]:
    answer = get(live, row, "export", format="npz", **query)
    with np.load(io.BytesIO(answer.content)) as arrays:
        assert int(answer.headers["Cairn-Points"]) == len(arrays["points"])
        return {point.tobytes() for point in arrays["points"]}


def test_pictures_at_a_time_are_those_of_then_and_have_etags_of_their_own(live: Live) -> None:
    row, early = map_of(live, DOOR), map_of(live, WORLD)
    look = {"x": 0.3, "y": -2, "z": 0.3, "qx": -0.70710678, "qw": 0.70710678, "width": 16, "height": 16, "focal_px": 8}
    look |= {"layer": "probability", "format": "npz"}
    then, now = get(live, row, "render", at="1970-01-01T00:08:19", **look), get(live, row, "render", **look)
    expected = get(live, early, "render", **look)
    with np.load(io.BytesIO(then.content)) as one, np.load(io.BytesIO(expected.content)) as other:
        assert one.files == other.files
        assert all(np.array_equal(one[name], other[name], equal_nan=True) for name in one.files)
    assert then.content != now.content
    assert then.headers["ETag"] != now.headers["ETag"]


def test_times_that_are_none_and_spans_that_end_before_they_begin_are_refused(live: Live) -> None:
    row = map_of(live, WORLD)
    path = cell_paths(live, row)[0]
    for query in (f"{path}?at=noon", f"{path}?at=nan", "changes?since=1e300", "changes?since=5000&until=4000"):
        refused = live.http.get(f"/maps/{row.name}/main/{query}")
        assert (refused.status_code, kind_of(refused)) == (400, "bad_time")
    assert get(live, row, "changes").status_code == 422


def test_answers_of_too_many_changes_and_pasts_of_too_many_commits_are_refused(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, plain = map_of(live, DOOR), map_of(live, DOOR, epoch_s=None)
    monkeypatch.setattr(searches, "CHANGED_MAX", 10)
    refused = get(live, row, "changes", since=450)
    assert (refused.status_code, kind_of(refused)) == (413, "too_large")
    assert "box" in refused.text
    monkeypatch.setattr(readings, "PAST_ENTRIES_MAX", 1)
    refused = get(live, plain, cell_paths(live, plain)[0], at=450)
    assert (refused.status_code, kind_of(refused)) == (400, "too_costly")
    monkeypatch.setattr(searches, "SEARCH_S", -1.0)
    assert kind_of(get(live, row, "changes", since=450)) == "too_costly"


def test_what_was_taken_out_is_in_no_past(live: Live) -> None:
    for epoch_s in (100, None):
        row = map_of(live, DOOR, epoch_s)
        live.retract(row, commits_of(DOOR, row.layer)[1])
        live.folded(row)
        assert get(live, row, "changes", since=450).json()["counts"]["gone"] == 0
        numbers = ",".join(map(str, WALL[0].tolist()))
        assert get(live, row, f"voxels/{numbers}", time=499).json()["hits"] == 0


def test_the_octree_of_a_cell_at_a_time_has_the_rows_until_then(live: Live) -> None:
    row = map_of(live, DOOR)
    for path, key in zip(cell_paths(live, row), live.cells(row), strict=True):
        rows = decode_layer_cell(get(live, row, path).content, CellKey(key), LAYER).history
        then = decode_layer_cell(get(live, row, path, at=499).content, CellKey(key), LAYER).history
        assert then == rows.until(Epoch(4))


def test_a_view_of_all_known_voxels_has_the_states_of_the_reading(live: Live) -> None:
    row = map_of(live, DOOR)
    for path, key in zip(cell_paths(live, row), live.cells(row), strict=True):
        answer = get(live, row, f"{path}.view", known="true")
        shown = evidence_of_view(decode_view(answer.content).view, GEOMETRY, MODEL)
        rows = decode_layer_cell(get(live, row, path).content, CellKey(key), LAYER).history
        read = shown_evidence(rows, LAYER, MODEL)
        assert np.array_equal(shown.voxels, read.voxels)
        assert np.array_equal(shown.occupied(MODEL), read.occupied(MODEL))
        assert answer.headers["ETag"] != get(live, row, f"{path}.view").headers["ETag"]
        assert kind_of(get(live, row, f"{path}.npz", known="true")) == "unknown_format"


def test_a_cell_with_more_rows_than_fit_in_memory_is_read_row_by_row_to_the_same_reading(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = map_of(live, DOOR)
    with live.service.store.snapshot(row) as snapshot:
        cells = [cell for key in live.cells(row) if (cell := snapshot.cell(CellKey(key)))]
        found = []
        for fits in (True, False):
            monkeypatch.setattr(readings, "fits", lambda *_, fits=fits: fits)
            now = [readings.stored_reading(cell, row) for cell in cells]
            then = [readings.past_reading(snapshot, cell, row, 499) for cell in cells]
            again = [readings.reading_of_body(cell.key, cell.body, row) for cell in cells]
            found.append([now, then, again])
    assert found[0] == found[1]


def test_temperatures_say_when_they_were_measured_and_how_often(live: Live) -> None:
    row, plain = map_of(live, DOOR), map_of(live, DOOR, epoch_s=None)
    path = f"voxels/{','.join(map(str, CRATE[0].tolist()))}"
    (found,), (bare,) = (get(live, each, path).json()["channels"] for each in (row, plain))
    assert (found["weight"], found["measured_s"], "measured_s" in bare) == (3, 900.0, False)
    (never,) = get(live, row, f"voxels/{','.join(map(str, PILLAR[0].tolist()))}").json()["channels"]
    assert (never["weight"], "measured_s" in never) == (0, False)
    (hot,) = get(live, row, "hottest", count=1).json()["voxels"]
    assert (hot["weight"], hot["measured_s"]) == (3, 900.0)
    assert "measured_s" not in get(live, plain, "hottest", count=1).json()["voxels"][0]


@pytest.mark.parametrize("depth", [GEOMETRY.depth, 1])
def test_exported_points_say_when_their_temperatures_were_measured(live: Live, depth: int) -> None:
    row, plain = map_of(live, DOOR), map_of(live, DOOR, epoch_s=None)
    asked = {"format": "npz", "depth": depth}
    with np.load(io.BytesIO(get(live, row, "export", **asked).content)) as arrays:
        points = arrays["points"]
    is_warm = np.isfinite(points["temperature"])
    assert is_warm.any() and not is_warm.all()
    assert set(points["temperature_measured_s"][is_warm].tolist()) == {900.0}
    assert np.isnan(points["temperature_measured_s"][~is_warm]).all() and np.isnan(points["colour_measured_s"]).all()
    with np.load(io.BytesIO(get(live, plain, "export", **asked).content)) as arrays:
        assert arrays["points"].dtype == POINT
    ply, pcd, laz = (get(live, row, "export", **(asked | {"format": form})) for form in ("ply", "pcd", "laz"))
    head, _, body = ply.content.partition(b"end_header\n")
    assert b"property double temperature_measured_s\n" in head and body == points.tobytes()
    head, _, body = pcd.content.partition(b"DATA binary\n")
    rows = np.frombuffer(body, DATED_PCD_POINT)
    assert b"SIZE 4 4 4 4 4 4 4 8 8\n" in head
    for form in (ply, pcd):
        assert int(form.headers["Content-Length"]) == len(form.content)
    with laspy.open(io.BytesIO(laz.content)) as file:
        found = file.read()
    for each in (rows, found):
        np.testing.assert_array_equal(each["temperature_measured_s"], points["temperature_measured_s"])


@pytest.mark.parametrize("epoch_s", [100, None])
def test_ages_at_a_time_are_those_of_what_was_measured_until_then(live: Live, epoch_s: int | None) -> None:
    row = map_of(live, DOOR, epoch_s)
    look = {"x": 0.3, "y": -2, "z": 0.3, "qx": -0.70710678, "qw": 0.70710678, "width": 16, "height": 16, "focal_px": 8}
    look |= {"layer": "age", "format": "npz"}
    # Wall and place of the crate were seen in epoch 1, or until 150 s, the crate until 450 s.
    for at_s, ages in ((199.0, {99.0, 49.0}), (499.0, {399.0, 349.0, 99.0, 49.0})):
        with np.load(io.BytesIO(get(live, row, "render", at=at_s, **look).content)) as arrays:
            found, range_m = arrays["age_s"], arrays["range_m"]
        expected = ages & ({99.0, 399.0} if epoch_s else {49.0, 349.0})
        assert np.isfinite(range_m).any()
        assert set(found[np.isfinite(range_m)].tolist()) <= expected
        assert set(found[np.isfinite(range_m)].tolist()) & {399.0, 349.0, 99.0, 49.0}
