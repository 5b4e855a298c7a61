"""Where pushes are worked on: never on the event loop; and the writer, which outlives those who wait for it."""

import threading
from concurrent.futures import Future
from pathlib import Path

import apsw
import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_map.commits.commit_reading import CommitReader
from cairn_server.store.sqlite.store import FILE_NAME
from cairn_server.store.sqlite.writer import Writer, connect
from cairn_server.sync.checks import commit_checks
from cairn_server.sync.checks.checking import Checked, check_commit


def test_the_event_loop_checks_nothing(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    on_loop: list[bool] = []

    def noted(commit: CommitReader) -> Checked:
        on_loop.append(threading.current_thread() is live._thread)
        return check_commit(commit)

    monkeypatch.setattr(commit_checks, "check_commit", noted)
    row = live.new_map()
    assert live.push(row, pushed(0, 1)).status_code == 201
    assert live.push(row, pushed(1, 1)).status_code == 201
    assert live.push(row, pushed(1, 1)).json()["state"] == "known"
    assert live.push(row, pushed(1, 2)).status_code == 409
    assert on_loop == [False] * 4


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
