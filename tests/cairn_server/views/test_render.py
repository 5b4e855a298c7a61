"""`GET .../main/render`: the same picture as at home, rendered again when the map changes, bounded, and honest."""

import io
import threading
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import cv2
import httpx
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import PLAIN, SMALL, surface_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.damage import broken_map, damage
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_map.codec.cell_code import decode_cell
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_key, cell_of_key, level_geometry
from cairn_map.queries.map_snapshot import snapshot_of
from cairn_map.render.ground_picture import snapshot_ground
from cairn_map.render.legend import with_legend
from cairn_map.render.map_picture import layer_picture, layer_values
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.render_picture import GROUND_LAYERS, Layer, Scale, png_of
from cairn_map.render.render_request import RenderRequest, request_from
from cairn_map.warm_up import warm_up_pictures
from cairn_server.store.store_rows import MapRow
from cairn_server.views import map_views

LOOK = request_from((1.4, 1.3, 1.2), (0.1, 0.2, 0.3), width=64, height=48, focal_px=40.0, range_m=6.0)
GROUND_CELL = cell_key((-1, 0, 0))
LAYERS = [layer for layer in Layer if layer not in GROUND_LAYERS]
"""Those of cubes."""


def mapped(live: Live, *numbers: int) -> MapRow:
    row = live.new_map()
    for number in numbers:
        assert live.push(row, pushed(number, number)).status_code == 201
    live.folded(row)
    return row


def ask(live: Live, row: MapRow, request: RenderRequest = LOOK, *, etag: str | None = None) -> httpx.Response:
    headers = {"If-None-Match": etag} if etag else {}
    query = request.model_dump(mode="json", exclude_none=True)
    return live.http.get(f"/maps/{row.name}/main/render", params=query, headers=headers)


def asking(request: RenderRequest = LOOK, **change: Any) -> RenderRequest:
    return request.model_copy(update=change)


def map_of(live: Live, row: MapRow) -> EvidenceMap:
    whole = EvidenceMap(row.geometry)
    for key, body in live.cells(row).items():
        whole.replace(CellKey(key), decode_cell(body).evidence)
    return whole


def arrays(answer: httpx.Response) -> dict[str, npt.NDArray[Any]]:
    assert answer.status_code == 200, answer.text
    with np.load(io.BytesIO(answer.content)) as found:
        return dict(found)


@pytest.mark.parametrize("layer", [layer for layer in LAYERS if layer is not Layer.AGE])
def test_a_picture_is_what_the_same_map_shows_at_home(live: Live, layer: Layer) -> None:
    row, request = mapped(live, 0, 1), asking(layer=layer)
    answer = ask(live, row, request)
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "image/png")
    found = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    snapshot, renderer = snapshot_of(map_of(live, row), row.sensor_model), MapRenderer()
    seen = renderer.nearest(snapshot, request.sight, request.T_map_camera, range_max_m=request.range_m)
    assert 0.005 < seen.hit.mean() < 0.9
    values = layer_values(renderer, snapshot, seen, layer)
    assert np.array_equal(found[..., ::-1], layer_picture(values, seen, request.scale))
    assert found.shape[0] > 48 + 30 and found.shape[1:] == (64, 3)
    if layer is not Layer.COLOUR:
        # A scale that ends below the highest value seen says so in its legend, and no other does.
        highest = float(np.nanmax(values))
        for high, notes in ((highest + 1, []), (highest - 0.01, [f"highest: {highest:.4g}"])):
            scale = Scale(layer, high - 10, high)
            legend = with_legend(np.zeros((48, 64, 3), np.uint8), scale, notes)[48:]
            assert np.array_equal(layer_picture(values, seen, scale)[48:], legend)
    told = arrays(ask(live, row, asking(request, format="npz")))
    assert np.array_equal(told["range_m"], seen.range_m, equal_nan=True)
    names = {Layer.TEMPERATURE: {"temperature_k"}, Layer.DEPTH: set()}.get(layer, {str(layer)})
    assert told.keys() == {"range_m", "depth_m"} | names


def test_cells_that_were_drawn_are_not_read_again_and_weigh_what_their_layer_does(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, views = mapped(live, 0, 1), live.service.views.pictures
    first = {layer: ask(live, row, asking(layer=layer)).content for layer in LAYERS}
    with live.service.store.snapshot(row) as snapshot:
        chains = {snapshot.chain_at(cell.lm) for cell in snapshot.cells()}
    kept = {name: read for name, (read, _) in views._read_cells._kept.items() if name[0][0] in chains}
    assert {layer for _, layer, _ in kept} == {*LAYERS} - {Layer.AGE}
    for (_, layer, _), read in kept.items():
        arrays = (read.cell.counts.brick_of, read.states.bricks, read.states.words, *read.tables.tables.values())
        assert read.size_bytes == sum(array.nbytes for array in arrays)
        assert len(read.tables.tables) == (layer is not Layer.DEPTH)
        assert read.cell.counts.pool.strides == (0, 0, 0) and not len(read.cell.samples.packed()[0])
    monkeypatch.setattr(map_views, "_ready", None)  # who reads one now fails
    assert {layer: ask(live, row, asking(layer=layer)).content for layer in LAYERS} == first


def test_the_etag_is_of_the_map_and_of_the_question(live: Live) -> None:
    row = mapped(live, 0)
    first = ask(live, row)
    again = ask(live, row, etag=first.headers["ETag"])
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["ETag"] == first.headers["ETag"]
    assert ask(live, row).content == first.content
    other = ask(live, row, asking(low=0.0), etag=first.headers["ETag"])
    assert other.status_code == 200
    live.push(row, pushed(1, 1))
    live.folded(row)
    changed = ask(live, row, etag=first.headers["ETag"])
    assert changed.status_code == 200
    assert changed.headers["Cairn-Cursor"] != first.headers["Cairn-Cursor"]
    live.retract(row, pushed(1, 1)).raise_for_status()
    live.folded(row)
    assert ask(live, row).content == first.content


def test_ages_are_counted_from_the_newest_measurement(live: Live) -> None:
    """Commit n was captured until 1.5e9 + n: what only commit 0 saw is as old as the newest one is younger."""
    row = mapped(live, 0, 9)
    told = arrays(ask(live, row, asking(layer=Layer.AGE, format="npz")))
    seen = ~np.isnan(told["range_m"])
    assert set(np.unique(told["age_s"][seen])) <= {0.0, 9.0}
    assert np.isnan(told["age_s"][~seen]).all()
    alone = arrays(ask(live, mapped(live, 9), asking(layer=Layer.AGE, format="npz")))
    assert set(np.unique(alone["age_s"][~np.isnan(alone["age_s"])])) == {0.0}


def test_a_time_that_only_a_commit_claims_makes_nothing_old_nor_does_its_retract(live: Live) -> None:
    look = asking(layer=Layer.AGE, format="npz")
    row = mapped(live, 0, 9)
    later, earlier = (pushed(n, 1, captured_until_s=time_s) for n, time_s in ((2, 2e10), (10, 1.0)))
    for commit in (later, earlier):
        live.push(row, commit).raise_for_status()
    live.folded(row)

    def ages() -> set[float]:
        told = arrays(ask(live, row, look))["age_s"]
        return set(np.unique(told[~np.isnan(told)]).tolist())

    assert ages() <= {0.0, 9.0, float(np.float32(1.5e9 + 9 - 1.0))}
    live.retract(row, later, earlier).raise_for_status()
    live.folded(row)
    assert ages() <= {0.0, 9.0}


def test_the_age_of_what_nobody_can_tell_it_of_any_more_is_unknown(live: Live) -> None:
    row, look = mapped(live, 0), asking(layer=Layer.AGE, format="npz")
    seen = ~np.isnan(arrays(ask(live, row, look))["range_m"])
    damage(live, "UPDATE cell SET stamps = x'01020304' WHERE map = ?", row.number)
    told = arrays(ask(live, row, look))
    np.testing.assert_array_equal(~np.isnan(told["range_m"]), seen)
    assert seen.any() and np.isnan(told["age_s"]).all()


def test_an_uncertain_pose_blurs_the_picture_or_withholds_it(live: Live) -> None:
    row, lower = mapped(live, 0), np.zeros(21)
    sharp = ask(live, row)
    lower[2] = 0.05**2  # of ry alone: about the camera's axis down, so that all moves along rows
    one_way = {"covariance_lower": ",".join(map(str, lower.tolist()))}
    for certain, is_drawn in (
        ({"sigma_m": 0.02, "sigma_rad": 0.03}, True),
        (one_way, True),
        ({"sigma_rad": 1.0}, False),
    ):
        blurred = ask(live, row, asking(**certain))
        assert blurred.status_code == 200 and blurred.content != sharp.content
        picture = cv2.imdecode(np.frombuffer(blurred.content, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert (picture[20:48].std(axis=(0, 1)).max() > 1) == is_drawn
    told = arrays(ask(live, row, asking(**one_way, format="npz")))
    xx, xy, yy = told["spread_px2"][~np.isnan(told["range_m"])].T
    assert np.nanmedian(xx) > 1 and np.nanmax(yy / xx) < 0.2 and (xy**2 <= xx * yy * 1.01 + 1e-9).all()
    assert "spread_px2" not in arrays(ask(live, row, asking(format="npz")))


@pytest.mark.parametrize(
    "change",
    [
        {"width": 1281, "height": 960},
        {"width": 5000},
        {"range_m": 51},
        {"range_m": "inf"},
        {"qw": 0.5},
        {"x": "nan"},
        {"low": 50, "high": 10},
        {"layer": "smell"},
        {"focal_px": 0},
        {"format": "gif"},
        {"sigma_m": -1},
        {"sigma_rad": 4},
        {"covariance_lower": "1,2,3"},
        {"covariance_lower": ",".join(["x"] * 21)},
        {"covariance_lower": ",".join(["-1"] * 21)},
        {"covariance_lower": ",".join(["1e9"] * 21)},
        {"covariance_lower": ",".join(["0"] * 21), "sigma_m": 1},
        {"covariance_lower": "0" * 1001},
        {"more": 1},
    ],
)
def test_what_cannot_be_drawn_is_refused(live: Live, change: dict[str, Any]) -> None:
    row = mapped(live, 0)
    query = LOOK.model_dump(mode="json", exclude_none=True) | change
    answer = live.http.get(f"/maps/{row.name}/main/render", params=query)
    assert (answer.status_code, kind_of(answer)) == (422, "bad_message")


def test_a_map_without_temperatures_says_so_and_still_shows_its_depth(live: Live) -> None:
    row = live.new_map(PLAIN)
    live.push(row, pushed(0, 0, geometry=PLAIN))
    live.folded(row)
    refused = ask(live, row)
    assert (refused.status_code, kind_of(refused)) == (400, "unknown_channel")
    assert ask(live, row, asking(layer=Layer.DEPTH)).status_code == 200


@pytest.mark.parametrize(
    ("limit", "value", "expected"),
    [
        ("CELLS_IN_VIEW_MAX", 1, (413, "too_large")),
        ("VOXELS_READ_MAX", 1, (413, "too_large")),
        ("RENDER_S", -1.0, (400, "too_costly")),
    ],
)
def test_a_picture_that_takes_too_much_is_refused(
    live: Live, monkeypatch: pytest.MonkeyPatch, limit: str, value: float, expected: tuple[int, str]
) -> None:
    row = mapped(live, 0, 1)
    monkeypatch.setattr(map_views, limit, value)
    answer = ask(live, row)
    assert (answer.status_code, kind_of(answer)) == expected


def test_compiling_kernels_is_no_part_of_a_pictures_time(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row, now_s = mapped(live, 0), [0.0]

    def compile_for_long() -> None:
        with ExitStack() as all_turns:
            for _ in range(map_views.RENDERS_AT_ONCE):
                all_turns.enter_context(live.service.views.pictures._turn())
        warm_up_pictures()
        now_s[0] += 2 * map_views.RENDER_S

    monkeypatch.setattr(map_views, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(map_views, "_get_ready", compile_for_long)
    assert ask(live, row).status_code == 200 and now_s[0] > 0


def test_who_asks_while_another_ones_request_compiles_is_told_to_come_later(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = mapped(live, 0)
    monkeypatch.setattr(map_views, "WAIT_S", 0.01)
    with map_views._loading:
        answer = ask(live, row)
    assert (answer.status_code, kind_of(answer)) == (503, "busy")
    assert "compiled" in answer.text and answer.headers["Retry-After"]
    assert ask(live, row).status_code == 200


def test_only_so_many_are_made_at_once(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row, views = mapped(live, 0), live.service.views.pictures
    monkeypatch.setattr(map_views, "WAIT_S", 0.01)
    monkeypatch.setattr(views, "_room", threading.BoundedSemaphore(1))
    with views._turn():
        answer = ask(live, row)
        assert (answer.status_code, kind_of(answer)) == (503, "busy")
        assert answer.headers["Retry-After"]
    assert ask(live, row).status_code == 200


def test_a_damaged_cell_is_no_empty_place(live: Live) -> None:
    healed = broken_map(live, keep_diffs=True)
    assert ask(live, healed).content == ask(live, mapped(live, 0)).content
    broken = broken_map(live, keep_diffs=False)
    answer = ask(live, broken)
    assert (answer.status_code, kind_of(answer)) == (500, "damaged_store")


def test_an_empty_map_is_drawn_as_nothing(live: Live) -> None:
    told = arrays(ask(live, live.new_map(SMALL), asking(format="npz")))
    assert np.isnan(told["range_m"]).all()


def test_a_level_is_drawn_as_at_home_and_its_cells_are_kept(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    level = level_geometry().model_copy(update={"depth": 4})
    row = live.new_map(level)
    commit = pushed(0, 0, geometry=level, cells={GROUND_CELL: surface_evidence(1, level)}, scans=40)
    assert live.push(row, commit).status_code == 201
    live.folded(row)
    i, j, k = (edge * (place + 0.5) for edge, place in zip(level.cell_edges_m, cell_of_key(GROUND_CELL), strict=True))
    look = request_from((i - 2, j - 2, k + 3), (i, j, k), width=64, height=48, focal_px=40.0, range_m=20.0)
    for layer in (Layer.DIFFICULTY, Layer.HEIGHT, Layer.PROBABILITY, Layer.DEPTH):
        request = asking(look, layer=layer, low=0.0, high=4.0)
        image = snapshot_ground(snapshot_of(map_of(live, row), row.sensor_model)).seen(
            look.sight, look.T_map_camera, range_max_m=20.0
        )
        assert image.seen.hit.mean() > 0.05
        picture = layer_picture(image.values(layer), image.seen, request.scale, shade=image.shade)
        assert ask(live, row, request).content == png_of(picture)
        monkeypatch.setattr(map_views, "ground_cell", None)  # who reads one now fails
    ages = arrays(ask(live, row, asking(look, layer=Layer.AGE, format="npz")))["age_s"]
    assert (ages[image.seen.hit] == 0).all()
    for layer, kind in ((Layer.COLOUR, "unknown_channel"), (Layer.TEMPERATURE, "unknown_channel")):
        assert kind_of(ask(live, row, asking(look, layer=layer))) == kind
    assert kind_of(ask(live, mapped(live, 0), asking(layer=Layer.SLOPE))) == "not_level"
    monkeypatch.setattr(map_views, "CELLS_IN_VIEW_MAX", 0)
    assert kind_of(ask(live, row, asking(look, layer=Layer.STEP))) == "too_large"
