"""Times of folding: at once for one who pushes now and then, in groups while many do."""

import threading

import pytest
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import pushed

from cairn_server.folding import fold_thread, group_folding
from cairn_server.folding.fold_thread import REST_MAX_S, REST_SHARE, rest_s
from cairn_server.store.store_rows import MapRow


def test_a_fold_is_followed_by_a_rest_only_if_commits_came_meanwhile() -> None:
    assert rest_s(0.1, is_pushed=False) == 0
    assert rest_s(0.1, is_pushed=True) == pytest.approx(0.1 * REST_SHARE)
    assert rest_s(10.0, is_pushed=True) == REST_MAX_S


def test_what_comes_while_the_folder_rests_is_folded_together(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rest lasts until all is there; then one fold takes it."""
    all_there, row, groups = threading.Event(), live.new_map(), []
    fold_around = group_folding.fold_around

    def noted(*args: object, **kwargs: object) -> int:
        count: int = fold_around(*args, **kwargs)  # type: ignore[arg-type]
        if count:
            groups.append(count)
            if len(groups) == 1:  # commits come while it folds
                assert [live.push(row, pushed(n, n)).status_code for n in (1, 2)] == [201, 201]
        return count

    def rest(took_s: float, *, is_pushed: bool) -> float:
        if is_pushed:
            assert [live.push(row, pushed(n, n)).status_code for n in (3, 4)] == [201, 201]
            all_there.set()
        return 0.0

    monkeypatch.setattr(group_folding, "fold_around", noted)
    monkeypatch.setattr(fold_thread, "rest_s", rest)
    live.push(row, pushed(0, 0))
    assert all_there.wait(20)
    until(lambda: sum(groups) == 5, "all folded")
    assert groups == [1, 4]


def test_a_map_that_rests_does_not_hold_up_the_others(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    busy, other = live.new_map(), live.new_map()
    monkeypatch.setattr(fold_thread, "rest_s", lambda _, *, is_pushed: 3600.0 if is_pushed else 0.0)
    fold_group = fold_thread.FoldThread._fold_group

    def slow(thread: fold_thread.FoldThread, row: MapRow, *, is_news: bool) -> group_folding.Folded:
        folded = fold_group(thread, row, is_news=is_news)
        if row.name == busy.name:
            thread.wake()  # as by a push that comes meanwhile
        return folded

    monkeypatch.setattr(fold_thread.FoldThread, "_fold_group", slow)
    live.push(busy, pushed(0, 0))
    until(lambda: _seq(live, busy) == 1, "the first commit is folded")
    live.push(busy, pushed(1, 1))
    live.push(other, pushed(0, 0))
    until(lambda: _seq(live, other) == 1, "the other map's commit is folded")
    assert _seq(live, busy) == 1


def _seq(live: Live, row: MapRow) -> int:
    with live.service.store.snapshot(row) as snapshot:
        return snapshot.head.seq
