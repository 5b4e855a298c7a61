"""Events of a robot as they happen: each once, in its order, and never at the price of mapping."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import map_commit, robot_in

from cairn_client.http.backoff import Backoff
from cairn_client.robot.robot_events import (
    CellsChanged,
    Committed,
    Event,
    EventStream,
    LinkBack,
    LinkLost,
    Pushed,
    Refused,
    SyncFailed,
)
from cairn_map.errors import BadInputError, DamagedDataError, UnreachableError
from cairn_map.evidence.grid import cell_of_key

Until = Callable[[Callable[[], bool]], None]


def kinds(events: list[Event]) -> list[str]:
    return [type(event).__name__ for event in events]


def test_a_robot_tells_of_its_commits_and_of_the_news_of_others(server: LiveServer, tmp_path: Path) -> None:
    with (
        robot_in(tmp_path, server.map_url) as mole,
        robot_in(tmp_path, server.map_url, name="bat") as bat,
        mole.events() as of_mole,
        bat.events() as of_bat,
    ):
        mole.observe(scan_of(1))
        commit = mole.commit()
        assert commit is not None
        committed, *rest = of_mole.take()
        assert isinstance(committed, Committed) and not rest
        assert (committed.commit, committed.size_bytes) == (commit.id, len(commit.data))
        cells = tuple(cell_of_key(key) for key in sorted(commit.cells))
        assert committed.cells == cells
        mole.sync()
        (pushed,) = [event for event in of_mole.take() if isinstance(event, Pushed)]
        assert pushed.commit == commit.id
        server.wait_for_fold()
        bat.sync()
        (changed,) = of_bat.take()
        assert isinstance(changed, CellsChanged) and changed.cells == cells
        bat.sync()
        assert of_bat.take() == []


def test_the_background_tells_when_the_link_is_lost_and_when_it_is_back(
    server: LiveServer, tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Backoff, "next_s", lambda self, wish: 0.02)
    with robot_in(tmp_path, server.map_url) as mole, mole.events() as stream:
        server.stop()
        mole.start_sync(every_s=0.02)
        told: list[Event] = []
        until(lambda: bool(told.extend(stream.take()) or len(told) >= 3))
        lost = [event for event in told if isinstance(event, LinkLost)]
        assert [event.tries for event in lost] == list(range(1, len(told) + 1))
        assert {(event.kind, event.again_s) for event in lost} == {("no_link", 0.02)}
        server.start()
        until(lambda: bool(told.extend(stream.take()) or kinds(told).count("LinkBack") == 1))
        back = next(event for event in told if isinstance(event, LinkBack))
        assert 0 < back.away_s < 60


def test_a_round_that_somebody_calls_tells_its_failure_too(tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole, mole.events() as stream:
        with pytest.raises(UnreachableError):
            mole.sync()
        (lost,) = stream.take()
        assert isinstance(lost, LinkLost) and (lost.tries, lost.again_s) == (1, None)


def test_an_answer_that_is_not_sound_is_no_lost_link(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as mole, mole.events() as stream:

        def damaged(*_: object, **__: object) -> object:
            raise DamagedDataError("bad_frame", "no")

        mole._api.missing = damaged  # type: ignore[assignment, method-assign]
        with pytest.raises(DamagedDataError):
            mole.sync()
        (failed,) = stream.take()
        assert isinstance(failed, SyncFailed) and (failed.kind, failed.tries) == ("bad_frame", 1)


def test_a_fault_of_ours_is_told_and_ends_no_background_sync(
    server: LiveServer, tmp_path: Path, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Backoff, "next_s", lambda self, wish: 0.01)
    with robot_in(tmp_path, server.map_url) as mole, mole.events() as stream:
        sound, faults = mole._api.missing, [OSError(5, "Input/output error")]

        def faulty(*args: object, **options: object) -> object:
            if faults:
                raise faults.pop()
            return sound(*args, **options)  # type: ignore[arg-type]

        mole._api.missing = faulty  # type: ignore[assignment, method-assign]
        mole.start_sync(every_s=0.01)
        seen: list[Event] = []
        until(lambda: bool(seen.extend(stream.take()) or "LinkBack" in kinds(seen)))
        failed = next(event for event in seen if isinstance(event, SyncFailed))
        assert failed.kind == "internal" and "Input/output error" in failed.reason


def test_a_refusal_is_told_once_with_its_reason(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url) as mole:
        map_commit(mole, 1)

        def picky(*_: object, **__: object) -> object:
            raise BadInputError("too_much_evidence", "no room for it")

        mole._api.push = picky  # type: ignore[assignment, method-assign]
        with mole.events() as stream:
            for _ in range(3):
                mole.sync()
            (refused,) = stream.take()
        assert isinstance(refused, Refused)
        assert (refused.kind, refused.reason) == ("too_much_evidence", "no room for it")


def test_a_slow_reader_loses_the_oldest_events_and_knows_how_many(tmp_path: Path) -> None:
    with robot_in(tmp_path) as mole:
        slow, quick = mole.events(size=2), mole.events()
        commits = [map_commit(mole, seed) for seed in range(5)]
        assert [str(event.commit) for event in slow.take() if isinstance(event, Committed)] == commits[3:]
        assert (slow.dropped, quick.dropped) == (3, 0)
        assert len(quick.take()) == 5
    with pytest.raises(BadInputError):
        mole.events(size=0)


def test_an_iteration_waits_for_events_and_ends_with_the_robot(tmp_path: Path) -> None:
    told: list[Event] = []
    mole = robot_in(tmp_path)
    stream = mole.events()
    reader = threading.Thread(target=lambda: told.extend(stream))
    reader.start()
    map_commit(mole, 1)
    map_commit(mole, 2)
    mole.close()
    reader.join(20)
    assert not reader.is_alive()
    assert kinds(told)[:2] == ["Committed", "Committed"]
    assert stream.take(timeout_s=None) == []


def test_a_closed_stream_takes_no_more() -> None:
    stream = EventStream(3)
    stream.put(LinkBack(away_s=1))
    stream.close()
    stream.put(LinkBack(away_s=2))
    assert kinds(stream.take()) == ["LinkBack"]
