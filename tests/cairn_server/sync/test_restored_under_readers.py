"""A store put back to an older state while the server runs, as a failover to an old copy does.

The log then counts on from the older state, and other entries get the numbers of those that were lost. What the server
has cached of the lost ones is shown to no reader.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import apsw
import pytest
from tests.fixtures.map.made import MIDDLE
from tests.fixtures.server.fetching import fetch
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed, sum_of
from tests.fixtures.server.stores import sqlite_of
from tests.naive.asker import NaiveAsker

from cairn_map.render.render_request import RenderRequest, request_from
from cairn_map.wire.frames import FrameKind
from cairn_map.wire.live_events import Hello
from cairn_server.store.sqlite.backup import back_up
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.store.sqlite.writer import connect
from cairn_server.store.store_age import Clocks
from cairn_server.store.store_rows import MapRow
from cairn_server.views.cell_views import first_depth, view_name
from cairn_server.views.map_views import MapViews
from cairn_server.views.view_prefetch import ViewPrefetch

LOOK = request_from((1.4, 1.3, 1.2), (0.1, 0.2, 0.3), width=64, height=48, focal_px=40.0, range_m=6.0)
BEFORE = [pushed(n, n, WREN) for n in range(12)]
X, Y = pushed(12, 0, WREN), pushed(0, 3, MOLE)
"""Two commits that touch the same cells: in either order the cells are the same in the end."""
PutBack = Callable[[], None]


@pytest.fixture
def own(tmp_path: Path) -> Iterator[Live]:
    with Live(tmp_path / "server") as server:
        yield server


def saved(live: Live) -> PutBack:
    """Back the store up; the function that puts the backup in its place, under the running server."""
    sqlite_of(live.service.store)
    folder: Path = live.service.settings.folder
    file = folder / "saved.cairn"
    back_up(folder, file, lambda done, total: None)

    def put_back() -> None:
        with closing(connect(folder / FILE_NAME)) as store, closing(apsw.Connection(str(file))) as copy:
            backup = store.backup("main", copy, "main")
            backup.step(-1)
            backup.finish()

    return put_back


def push(live: Live, row: MapRow, *commits: object) -> None:
    for commit in commits:
        assert live.push(row, commit).status_code == 201  # type: ignore[arg-type]
        live.folded(row)


def test_a_delta_of_a_lost_history_is_not_sent(own: Live) -> None:
    row, asker, early = own.new_map(), NaiveAsker(None), NaiveAsker(None)
    push(own, row, *BEFORE)
    fetch(own, row, early)
    put_back = saved(own)
    for commit in (X, Y):
        push(own, row, commit)
        fetch(own, row, asker)
    put_back()
    for commit in (Y, X):
        early.kinds.clear()
        push(own, row, commit)
        fetch(own, row, early)
        assert set(early.kinds) == {FrameKind.DELTA}
    assert early.map() == sum_of([*BEFORE, X, Y])


def test_changed_blocks_of_a_lost_history_are_not_sent(own: Live) -> None:
    row = own.new_map(MIDDLE)
    before, x, y = (pushed(n, 3 * n, WREN, geometry=MIDDLE) for n in range(3))
    asker, early = (NaiveAsker(None, asks_for=("state", "full")) for _ in range(2))
    push(own, row, before)
    fetch(own, row, early)
    put_back = saved(own)
    for commit in (x, y):
        push(own, row, commit)
        fetch(own, row, asker)
    put_back()
    for commit in (y, x):
        early.kinds.clear()
        push(own, row, commit)
        fetch(own, row, early)
        assert FrameKind.STATE in early.kinds
    assert early.map() == sum_of([before, x, y])


def test_the_history_of_a_cell_names_commits_and_not_rows_which_another_map_may_have_now(own: Live) -> None:
    row, other = own.new_map(), own.new_map()
    asker, early = NaiveAsker(None), NaiveAsker(None, asks_for=("delta",))
    push(own, row, *BEFORE)
    for each in (asker, early):
        fetch(own, row, each)
    put_back = saved(own)
    push(own, row, X)
    fetch(own, row, asker)
    put_back()
    push(own, other, Y)
    push(own, row, X)
    early.kinds.clear()
    fetch(own, row, early)
    assert set(early.kinds) == {FrameKind.DELTA}
    assert early.map() == sum_of([*BEFORE, X])


def test_a_picture_shows_no_cell_and_no_time_of_a_lost_history(own: Live) -> None:
    row = own.new_map()
    request = RenderRequest.model_validate(LOOK.model_dump() | {"layer": "age", "format": "npz"})
    push(own, row, BEFORE[0])
    put_back = saved(own)
    push(own, row, X)
    lost = own.service.views.pictures.asked(row, request, known=None)
    put_back()
    push(own, row, BEFORE[4])
    shown = own.service.views.pictures.asked(row, request, known=lost.etag)
    fresh = MapViews(own.service.store, own.service.cells).asked(row, request, known=None)
    assert shown.body == fresh.body != lost.body


def test_what_was_stable_in_a_lost_history_is_not_called_stable(tmp_path: Path) -> None:
    seconds = [100.0]
    store = SqliteStore(tmp_path, Clocks(steady_s=lambda: seconds[0]))
    with Live(tmp_path, store=store, stable_after_s=5.0) as own:
        row = own.new_map()
        push(own, row, BEFORE[0])
        put_back = saved(own)
        push(own, row, X)
        seconds[0] += 6.0
        stable = own.service.sync.replies._stable
        with own.service.store.snapshot(row) as snapshot:
            assert set(stable.of(snapshot)) == {BEFORE[0].id, X.id}
        put_back()
        with own.service.store.snapshot(row) as snapshot:
            assert set(stable.of(snapshot)) == {BEFORE[0].id}
        # As many entries more as were lost, and one: the state that was lost is no beginning of theirs.
        push(own, row, BEFORE[1], BEFORE[2])
        seconds[0] += 6.0
        with own.service.store.snapshot(row) as snapshot:
            assert set(stable.of(snapshot)) == {commit.id for commit in BEFORE[:3]}


def test_streams_end_and_who_comes_again_hears_that_its_place_is_lost(own: Live) -> None:
    row = own.new_map()
    push(own, row, BEFORE[0])
    put_back = saved(own)
    push(own, row, X)
    listener = own.service.live.join(row, b"t", lambda: None, after=None)
    (hello,) = listener.take()
    assert isinstance(hello, Hello) and not listener.is_over
    place = listener._seen
    put_back()
    push(own, row, Y, BEFORE[1])
    until(lambda: listener.is_over, "the stream ends")
    assert listener.take() == []
    listener.leave()
    again = own.service.live.join(row, b"t", lambda: None, after=place)
    (hello,) = again.take()
    assert isinstance(hello, Hello) and not hello.resumed
    again.leave()


def test_views_are_made_ahead_of_cells_that_changed_under_numbers_of_lost_entries(own: Live) -> None:
    row, views = own.new_map(), own.service.views.cells.cache
    push(own, row, BEFORE[0])
    put_back = saved(own)
    push(own, row, X)
    with closing(ViewPrefetch(own.service.store, views, own.service.fold_news, look_every_s=3600)) as ahead:
        until(lambda: row.number in ahead._seen, "views are made")
        put_back()
        push(own, row, Y)
        ahead._make_all(row)
        with own.service.store.snapshot(row) as snapshot:
            names = [view_name(row, cell, first_depth(row.geometry.depth)) for cell in snapshot.cells()]
        assert all(map(views.has, names))


def test_the_number_of_a_lost_retract_is_not_given_again(own: Live) -> None:
    row = own.new_map()
    push(own, row, X, Y)
    put_back = saved(own)
    said = [own.retract(row, X).json()["id"]]
    own.folded(row)
    put_back()
    said += [own.retract(row, Y).json()["id"] for _ in range(2)]
    incarnations = [text.split(".")[1] for text in said]
    assert incarnations[0] != incarnations[1] == incarnations[2]
    assert [text.split(".")[2] for text in said] == ["0", "0", "1"]
