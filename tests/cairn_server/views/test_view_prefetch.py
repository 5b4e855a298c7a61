"""Views of cells: made before a page asks, and right whatever happened to the stored bytes."""

import json
from contextlib import closing
from dataclasses import replace

import pytest
from tests.fixtures.server.answers import cell_path
from tests.fixtures.server.damage import BROKEN, SOUND, broken_map
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import KEYS, pushed

from cairn_map.codec.view_code import decode_view
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.live.fold_news import FoldNews
from cairn_server.store.store_rows import MapRow
from cairn_server.views import cell_views, view_prefetch
from cairn_server.views.cell_views import ViewCache, first_depth, view_name, view_of_stored
from cairn_server.views.view_prefetch import ViewPrefetch

SOON_S = 0.01


def coarse_views(live: Live, row: MapRow) -> dict[str, bytes]:
    """Views that a page requests first, of the cells as the store has them now."""
    depth = first_depth(row.geometry.depth)
    with live.service.store.snapshot(row) as snapshot:
        cells = [snapshot.cell(cell.key) for cell in list(snapshot.cells())]
    return {view_name(row, cell, depth): view_of_stored(row, cell, depth) for cell in cells if cell}


def test_what_a_page_asks_for_first_is_there_before_it_asks(live: Live) -> None:
    row = live.new_map()
    views = live.service.views.cells.cache
    with closing(ViewPrefetch(live.service.store, views, live.service.fold_news, look_every_s=SOON_S)):
        for number in range(2):
            live.push(row, pushed(number, 0))
            live.folded(row)
            wanted = coarse_views(live, row)
            until(lambda wanted=wanted: all(views.has(name) for name in wanted), "views are made")  # type: ignore[misc]
            made = views.made
            for cell in map(cell_of_key, pushed(number, 0).cells):
                answer = live.http.get(f"/maps/{row.name}/main/cells/{cell}.view?depth={first_depth(3)}")
                assert answer.content in wanted.values()
                assert decode_view(answer.content).view.depth == first_depth(3)
            assert views.made == made


def test_a_map_that_pages_look_at_does_not_wait_for_the_views_of_others(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_prefetch, "AT_ONCE", 0)
    monkeypatch.setattr(view_prefetch, "UNSEEN_PAUSE_SHARE", 1e9)
    unseen, seen, views, news = live.new_map(), live.new_map(), live.service.views.cells.cache, FoldNews()
    live.push(unseen, pushed(0, 0))
    live.folded(unseen)
    news.take()  # other tests' maps
    news.note(unseen.number)
    with closing(ViewPrefetch(live.service.store, views, news, look_every_s=SOON_S)):
        until(
            lambda: any(views.has(name) for name in coarse_views(live, unseen)),
            "the first view is made, and others of its map wait",
        )
        live.http.get(f"/maps/{seen.name}/main/views")
        live.push(seen, pushed(0, 1))
        live.folded(seen)
        news.note(seen.number)
        until(lambda: all(views.has(name) for name in coarse_views(live, seen)), "views are made")
        assert not all(views.has(name) for name in coarse_views(live, unseen))


def test_a_map_in_which_nothing_happens_is_not_looked_at(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    idle, busy, store, asked = live.new_map(), live.new_map(), live.service.store, []
    heads = store.heads
    monkeypatch.setattr(store, "heads", lambda numbers: asked.append(numbers) or heads(numbers))
    views, news = ViewCache(), FoldNews()
    with closing(ViewPrefetch(store, views, news, look_every_s=SOON_S)):
        until(lambda: asked == [None], "all maps are looked at once")
        live.push(busy, pushed(0, 0))
        live.folded(busy)
        news.note(busy.number)
        until(lambda: all(views.has(name) for name in coarse_views(live, busy)), "views are made")
    assert asked == [None, {busy.number}] and idle.number not in asked[1]


def test_a_look_that_failed_is_made_again(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    row, store, fails = live.new_map(), live.service.store, [True, True]
    live.push(row, pushed(0, 0))
    live.folded(row)
    heads = store.heads

    def failing(numbers: frozenset[int] | None) -> object:
        if fails:
            fails.pop()
            raise UnreachableError("store_failed", "for a moment")
        return heads(numbers)

    monkeypatch.setattr(store, "heads", failing)
    views = ViewCache()
    with closing(ViewPrefetch(store, views, FoldNews(), look_every_s=SOON_S)):
        until(lambda: all(views.has(name) for name in coarse_views(live, row)), "views are made")


def test_a_view_is_not_that_of_another_map_which_had_the_name_before(live: Live) -> None:
    """As where somebody starts again in the same folder, with other probabilities, and pushes the same commits."""
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    anew = replace(row, sensor_model=SensorModel(p_hit=0.9))
    with live.service.store.snapshot(row) as snapshot:
        stored = snapshot.cell(next(iter(snapshot.cells())).key)
    assert stored is not None and view_of_stored(row, stored, 1) != view_of_stored(anew, stored, 1)
    assert view_name(row, stored, 1) != view_name(anew, stored, 1)


def test_the_views_used_last_are_kept_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_views, "BYTES_MAX", 20)
    cache = ViewCache()
    for name in "ab":
        cache.view(name, lambda: bytes(10))
    cache.view("a", lambda: pytest.fail("it is here"))
    cache.view("c", lambda: bytes(10))
    assert [cache.has(name) for name in "abc"] == [True, False, True]


@pytest.mark.processes
def test_a_map_that_cannot_be_read_leaves_the_others_theirs(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    broken, sound = live.new_map(), live.new_map()
    live.push(sound, pushed(0, 0))
    live.folded(sound)
    store, views = live.service.store, live.service.views.cells.cache
    monkeypatch.setattr(store, "maps", lambda: [replace(broken, number=-1), sound])
    with closing(ViewPrefetch(store, views, FoldNews(), look_every_s=SOON_S)):
        until(lambda: all(views.has(name) for name in coarse_views(live, sound)), "views of the sound map are made")


def test_a_map_made_anew_with_another_sensor_model_has_other_views(live: Live) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    with live.service.store.snapshot(row) as snapshot:
        cell = next(iter(snapshot.cells()))
    other = replace(row, sensor_model=row.sensor_model.model_copy(update={"p_occupied": 0.9}))
    assert view_name(row, cell, 1) != view_name(other, cell, 1)


@pytest.mark.parametrize("depth", [1, 3])
def test_a_view_of_a_cell_damaged_at_rest_is_made_from_the_log_or_refused(live: Live, depth: int) -> None:
    healed, sound = broken_map(live, keep_diffs=True), live.new_map()
    live.push(sound, pushed(0, 0))
    live.folded(sound)
    query = f".view?depth={depth}"
    want = live.http.get(cell_path(sound, BROKEN, query))
    got = live.http.get(cell_path(healed, BROKEN, query))
    assert (got.status_code, got.content) == (200, want.content)
    assert got.headers["ETag"] == want.headers["ETag"]
    lost = broken_map(live, keep_diffs=False)
    assert live.http.get(cell_path(lost, BROKEN, query)).status_code == 500
    assert live.http.get(cell_path(lost, SOUND, query)).status_code == 200
    assert live.http.get(cell_path(lost, KEYS[2], query)).status_code == 404


def parts_of(body: bytes) -> list[bytes]:
    """Heads and views in turn: PROTOCOL.md section 4.3."""
    found, at = [], 0
    while at < len(body):
        size = int.from_bytes(body[at : at + 4], "little")
        found.append(body[at + 4 : at + 4 + size])
        assert len(found[-1]) == size
        at += 4 + size
    return found


def test_views_that_are_ready_come_in_one_answer_as_they_come_one_by_one(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = live.new_map()
    live.push(row, pushed(0, 0))
    live.folded(row)
    main, depth = f"/maps/{row.name}/main", first_depth(row.geometry.depth)
    answer = live.http.get(f"{main}/views")
    assert (answer.content, answer.headers["Cairn-View-Depth"]) == (b"", str(depth))
    asked = {
        cell: live.http.get(f"{main}/cells/{cell}.view?depth={depth}") for cell in map(cell_of_key, pushed(0, 0).cells)
    }
    parts = parts_of(live.http.get(f"{main}/views").content)
    heads = [json.loads(head) for head in parts[::2]]
    told = {tuple(head["cell"]): (head["etag"], view) for head, view in zip(heads, parts[1::2], strict=True)}
    assert told == {cell: (one.headers["ETag"], one.content) for cell, one in asked.items()}
    assert len(told) > 1
    monkeypatch.setattr(cell_views, "BUNDLE_BYTES_MAX", 8 + len(parts[0]) + len(parts[1]))
    assert parts_of(live.http.get(f"{main}/views").content) == parts[:2]
