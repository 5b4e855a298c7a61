"""Live events of marks: told as they come and go, put together, and left out where there are none."""

import pytest
from tests.fixtures.map.marks import mark, mark_commit
from tests.fixtures.server.listening import by_sse, hello_of, up_to_head
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_map.commits.commit import Commit
from cairn_map.wire.live_events import LiveEvent, MarksEvent
from cairn_server.live import live_map
from cairn_server.live.live_map import LiveChanges
from cairn_server.store.store_rows import MapRow


def marks_of(events: list[LiveEvent]) -> list[MarksEvent]:
    return [event for event in events if isinstance(event, MarksEvent)]


def fold(live: Live, row: MapRow, *commits: Commit) -> None:
    for commit in commits:
        assert live.push(row, commit).status_code == 201
        live.folded(row)


def test_who_listens_hears_of_a_mark_that_comes_and_goes(live: Live) -> None:
    row = live.new_map()
    with by_sse(live, row) as events:
        hello_of(events)
        live.push(row, mark_commit(0, mark(), author=MOLE))
        found = up_to_head(events, 1)
        assert [event.type for event in found if event.type != "robot"] == ["marks", "log", "head"]
        (came,) = marks_of(found)
        assert came.marks != "many" and [(entry.key, entry.mark) for entry in came.marks] == [(f"{MOLE}.0:0", mark())]
        live.push(row, mark_commit(1, mark("off"), author=MOLE, retracts=(f"{MOLE}.0",)))
        (changed,) = marks_of(up_to_head(events, 3))
    assert changed.marks != "many" and [entry.mark.name for entry in changed.marks] == ["off"]
    assert (changed.removed, changed.marks[0].amends) == ([f"{MOLE}.0"], (f"{MOLE}.0",))


def news(changes: LiveChanges, seq: int) -> list[MarksEvent]:
    """Marks in the events of who stands at an entry."""
    changes.read()
    place = live_map.EventPosition(seq, "00000000", 0)
    return marks_of(changes.since(place, losses=changes.losses)[0])


def test_a_map_without_marks_tells_of_none_however_long_nobody_listened(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "PAST_ENTRIES", 1)
    row = live.new_map()
    fold(live, row, *(pushed(n, n) for n in range(3)))
    changes = LiveChanges(live.service.store, row)
    assert news(changes, 0) == []
    fold(live, row, mark_commit(3, mark(), author=MOLE), pushed(4, 0), pushed(5, 1))
    assert [event.marks for event in news(LiveChanges(live.service.store, row), 0)] == ["many"]
    assert news(LiveChanges(live.service.store, row), 5) == []


def test_more_marks_than_an_event_holds_are_many_and_entries_stay_whole(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "MARKS_MAX", 4)
    row = live.new_map()
    changes = LiveChanges(live.service.store, row)
    for n in range(3):
        fold(live, row, mark_commit(n, mark(), mark(), author=MOLE))
        changes.read()
    counts = ["many" if event.marks == "many" else len(event.marks) for seq in range(3) for event in news(changes, seq)]
    assert counts == ["many", 4, 2]
    fold(live, row, mark_commit(3, *[mark()] * 6, author=MOLE))
    assert [event.marks for event in news(changes, 3)] == ["many"]


def test_a_mark_that_came_and_went_between_two_events_is_told_as_gone_alone(live: Live) -> None:
    row = live.new_map()
    changes = LiveChanges(live.service.store, row)
    changes.read()
    fold(live, row, mark_commit(0, mark(), author=MOLE))
    changes.read()
    fold(live, row, mark_commit(1, mark("off"), author=MOLE, retracts=(f"{MOLE}.0",)))
    (event,) = news(changes, 0)
    assert event.marks != "many" and [entry.mark.name for entry in event.marks] == ["off"]
    assert event.removed == [f"{MOLE}.0"]
