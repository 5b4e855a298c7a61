"""`cairn robot status`, `queue` and `sync`: a robot's folder looked at, while it is at work and while it is not."""

import itertools
import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import NOWHERE, map_commit, robot_in
from tests.fixtures.client.world import stored_commits

from cairn_client import main as cairn
from cairn_client.cli.event_lines import until_signal
from cairn_client.cli.robots.command import main as robot_command
from cairn_client.replica.limits import Limits
from cairn_map.errors import UnreachableError


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Standard output of `cairn robot ...`."""
    capsys.readouterr()
    assert robot_command([str(argument) for argument in arguments]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


def code_of(*arguments: object) -> int:
    return cairn.main(["robot", *(str(argument) for argument in arguments)])


def test_the_status_of_a_robot_at_work_is_that_of_its_store(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mole"
    with robot_in(tmp_path, server.map_url, stay=True, limits=Limits(keep_acked_s=0)) as mole:
        map_commit(mole, 1)
        mole.sync()
        server.wait_for_fold()
        mole.sync()
        mole.observe(scan_of(2))
        commit = mole.commit()
        assert commit is not None
        status = json.loads(printed(capsys, "status", folder, "--json"))
        assert (status["robot"], status["map"], status["url"]) == ("mole", MAP, server.map_url)
        assert (status["mode"], status["is_open"]) == ("high-end", True)
        assert status["incarnation"] == mole.replica.author.incarnation
        assert status["cursor"] == str(mole.replica.default_cursor)
        assert status["cells"] == len(mole.replica.cells) > 0
        assert (status["waiting"], status["waiting_bytes"]) == (1, len(commit.data))
        assert (status["kept"], status["kept_bytes"]) == (1, len(commit.data))  # the first one is stable
        assert 0 <= time.time() - status["last_contact_s"] < 60
        assert (status["failing_since_s"], status["failure"]) == (None, "")
        assert status["disk_bytes"] > status["cells_bytes"] > 0
        assert "mole on map lab" in printed(capsys, "status", folder)
        assert ", at work" in printed(capsys, "status", folder)
    assert ", not at work" in printed(capsys, "status", folder)


def test_the_status_says_since_when_and_why_there_is_no_link(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with robot_in(tmp_path, NOWHERE) as mole, pytest.raises(UnreachableError):
        mole.sync()
    status = json.loads(printed(capsys, "status", tmp_path / "mole", "--json"))
    assert (status["last_contact_s"], status["failure_kind"]) == (None, "no_link")
    assert 0 <= time.time() - status["failing_since_s"] < 60
    assert "never; failing for" in printed(capsys, "status", tmp_path / "mole")


def test_the_queue_says_of_each_commit_whether_the_server_has_it(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.stop()
    server.settings = server.settings.model_copy(update={"stable_after_s": 1e6})
    server.start()
    folder = tmp_path / "mole"
    with robot_in(tmp_path, server.map_url, stay=True) as mole:
        assert "(nothing: all commits of mole" in printed(capsys, "queue", folder)
        first = map_commit(mole, 1)
        mole.sync()
        server.stop()
        second = map_commit(mole, 2, 3)
        queue = json.loads(printed(capsys, "queue", folder, "--json"))
        assert [commit["id"] for commit in queue["commits"]] == [first, second]
        assert [commit["acknowledged"] for commit in queue["commits"]] == [True, False]
        assert queue["commits"][1]["captured_s"] == [scan_of(2).time_s, scan_of(3).time_s]
        assert queue["commits"][1]["note"] == "2 3"
        lines = printed(capsys, "queue", folder).splitlines()
        assert [line.split()[5] for line in lines[1:]] == ["yes", "no"]
    with sqlite3.connect(folder / "robot.sqlite") as connection:
        connection.execute("UPDATE commits SET data = substr(data, 1, 20) WHERE n = 1")
    connection.close()
    queue = json.loads(printed(capsys, "queue", folder, "--json"))
    assert [commit["is_damaged"] for commit in queue["commits"]] == [False, True]


def test_looking_does_not_disturb_a_robot_that_opens_writes_and_closes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(3):
        with robot_in(tmp_path) as mole:
            for n in range(3):
                map_commit(mole, 10 * seed + n)
                queue = json.loads(printed(capsys, "queue", tmp_path / "mole", "--json"))
                assert len(queue["commits"]) == 3 * seed + n + 1


def test_a_folder_that_nobody_may_write_is_read_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with robot_in(tmp_path) as mole:
        map_commit(mole, 1)
    folder = tmp_path / "mole"
    try:
        (folder / "robot.sqlite").chmod(0o444)
        folder.chmod(0o555)
        assert json.loads(printed(capsys, "status", folder, "--json"))["waiting"] == 1
    finally:
        folder.chmod(0o755)


def test_a_folder_of_no_robot_is_not_found_and_a_broken_one_is_damaged(tmp_path: Path) -> None:
    assert code_of("status", tmp_path / "none") == 3
    (tmp_path / "robot.sqlite").write_bytes(b"no such thing" * 1000)
    assert code_of("queue", tmp_path) == 6


def test_a_round_for_a_folder_pushes_and_fetches(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mole"
    with robot_in(tmp_path, NOWHERE) as mole:
        map_commit(mole, 1)
    assert code_of("sync", folder) == 5
    report = json.loads(printed(capsys, "sync", folder, "--map", server.map_url, "--json"))
    assert (report["pushed"], report["refused"], report["waiting"]) == (1, {}, 0)
    assert report["up_bytes"] > 0 and report["down_bytes"] > 0
    server.wait_for_fold()
    assert "pushed 0 commits, " in printed(capsys, "sync", folder)  # the server is remembered
    status = json.loads(printed(capsys, "status", folder, "--json"))
    assert (status["url"], status["waiting"]) == (server.map_url, 0)
    assert len(stored_commits(tmp_path / "server")) == 1


def test_the_removed_command_names_the_one_that_replaces_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cairn.main(["robot", "pull", "--map", NOWHERE, "--state", "mole"]) == 1
    assert "`cairn robot sync DIR --map URL` does the same" in capsys.readouterr().err


@pytest.mark.slow
def test_a_folder_in_use_is_not_synced_by_another(server: LiveServer, tmp_path: Path) -> None:
    with robot_in(tmp_path, server.map_url):
        assert code_of("sync", tmp_path / "mole") == 4


def test_wrong_options_are_refused(tmp_path: Path) -> None:
    robot_in(tmp_path).close()
    assert code_of("sync", tmp_path / "mole", "--every", "0") == 1
    with pytest.raises(SystemExit) as ended:
        code_of("sync")
    assert ended.value.code == 2


def test_a_signal_at_any_line_of_the_wait_for_it_ends_it() -> None:
    """A handler runs in the main thread, which may hold the lock of what it waits for at that moment."""

    def ended_at(line: int) -> bool | None:
        """True if the wait ended by a signal that came at this line of it; None: it has fewer lines."""
        lines = itertools.count()

        def look(frame: FrameType, event: str, argument: object) -> Any:
            if event == "line" and next(lines) == line:
                signal.raise_signal(signal.SIGTERM)
            return look

        with until_signal() as stopping:
            sys.settrace(look)
            try:
                stopping.wait(0.05)
            finally:
                sys.settrace(None)
            return stopping.is_set() if next(lines) > line else None

    ended = list(itertools.takewhile(lambda each: each is not None, map(ended_at, itertools.count())))
    assert len(ended) >= 3
    assert all(ended)


def test_a_signal_that_does_not_interrupt_the_wait_ends_it() -> None:
    """Given to another thread, it comes to a main thread that waits already: as it does at the last moment before."""

    def end() -> None:
        time.sleep(0.2)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        os.kill(os.getpid(), signal.SIGTERM)

    with until_signal() as stopping:
        started_s = time.monotonic()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            other = threading.Thread(target=end)
            other.start()
            assert stopping.wait(60)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        other.join()
    assert time.monotonic() - started_s < 30


@pytest.mark.processes
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_rounds_go_on_until_a_signal(server: LiveServer, tmp_path: Path, number: int) -> None:
    with robot_in(tmp_path, NOWHERE) as mole:
        map_commit(mole, 1)
    command = [sys.executable, "-m", "cairn_client.main", "robot", "sync", str(tmp_path / "mole"), "--every", "0.05"]
    with subprocess.Popen([*command, "--map", server.map_url], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "pushed mole." in process.stderr.readline()
        os.kill(process.pid, number)
        assert process.wait(timeout=30) == 0
    assert len(stored_commits(tmp_path / "server")) == 1


def test_every_help_ends_with_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ([], ["robot"], ["robot", "status"], ["map", "log"], ["serve"]):
        with pytest.raises(SystemExit) if command else pytest.MonkeyPatch.context():
            cairn.main([*command, "--help"])
        assert capsys.readouterr().out.rstrip().splitlines()[-2].startswith("exit codes: 0 done, 1 ")
