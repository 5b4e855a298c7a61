"""Small pushes are worked on where they arrive, on the event loop; nothing that may take long is."""

import threading
from concurrent.futures import Future
from pathlib import Path

import apsw
import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import bearer, robot_token
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.quotas import MOLE_CALLER, Clock, guarded, metered, spend

from cairn_map.commits.commit_reading import CommitReader
from cairn_server.access.quotas import DAY_S
from cairn_server.http.routes import sync as sync_routes
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.sqlite.writer import Writer, connect
from cairn_server.sync.checks import commit_checks
from cairn_server.sync.checks.checking import Checked


@pytest.fixture
def checked_on(live: Live, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """For each check whether it was on the event loop."""
    found: list[bool] = []
    check = live.service.pushes.checks.check

    def noted(commit: CommitReader) -> Checked:
        found.append(threading.current_thread() is live._thread)
        return check(commit)

    monkeypatch.setattr(live.service.pushes.checks, "check", noted)
    return found


def test_a_small_push_is_checked_on_the_event_loop(live: Live, checked_on: list[bool]) -> None:
    assert live.push(live.new_map(), pushed(0, 1)).status_code == 201
    assert checked_on == [True]


def test_what_may_take_longer_has_a_thread(live: Live, checked_on: list[bool], monkeypatch: pytest.MonkeyPatch) -> None:
    row = live.new_map()
    monkeypatch.setattr(commit_checks, "QUICK_S", 0.0)
    assert live.push(row, pushed(0, 1)).status_code == 201
    monkeypatch.setattr(commit_checks, "QUICK_S", 60.0)
    monkeypatch.setattr(sync_routes, "AT_ONCE_BYTES", 100)
    assert live.push(row, pushed(1, 1)).status_code == 201
    assert live.push(row, pushed(1, 1)).json()["state"] == "known"
    assert live.push(row, pushed(1, 2)).status_code == 409
    assert checked_on == [False] * 4


def test_a_robots_first_push_of_a_day_reads_what_it_pushed_in_a_thread(tmp_path: Path) -> None:
    clock = Clock()
    with metered(tmp_path, clock, bytes_per_day=10, map_extent_m=1000) as (meter, row):
        assert not meter.is_ready(row)
        assert spend(meter, row) is None
        assert meter.is_ready(row)
        clock.now_s += DAY_S
        assert not meter.is_ready(row)


def test_a_server_that_has_just_started_reads_quotas_in_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_loop: list[bool] = []
    with guarded(tmp_path) as live:
        spending = live.service.pushes.meter.spending

        def noted(*args: object, **kwargs: object) -> object:
            on_loop.append(threading.current_thread() is live._thread)
            return spending(*args, **kwargs)  # type: ignore[arg-type]

        monkeypatch.setattr(live.service.pushes.meter, "spending", noted)
        row = live.new_map(SMALL)
        mole = bearer(robot_token(live, row, MOLE_CALLER.robot or ""))
        assert [live.push(row, pushed(n, n), headers=mole).status_code for n in range(2)] == [201, 201]
    assert on_loop == [False, True]


def test_a_job_whose_asker_gave_up_is_written_and_the_writer_lives(tmp_path: Path) -> None:
    path = tmp_path / FILE_NAME
    connect(path).close()
    writer = Writer(path)
    begun, go_on = threading.Event(), threading.Event()

    def slow(_: apsw.Connection) -> int:
        begun.set()
        go_on.wait(20)
        return 1

    given_up: Future[int] = writer.submit(slow)
    assert begun.wait(20)
    assert not given_up.cancel()
    go_on.set()
    assert writer.run(lambda _: 2) == 2
    assert given_up.result(20) == 1
    assert writer.is_alive
    writer.close()
