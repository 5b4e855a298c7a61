"""SIGTERM under load: what is under way is answered, all that was acknowledged is there afterwards."""

import asyncio
import signal
import socket
import threading
import time
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from tests.fixtures.server.deadline import until
from tests.fixtures.server.live import DEADLINE_S, Process
from tests.fixtures.server.processes import all_folded, client, make_map
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.evidence.grid import cell_of_key
from cairn_server.http.app import make_app
from cairn_server.operations.serve import StoppableServer, config_of, listen
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import SqliteStore

pytestmark = pytest.mark.processes

STOP_S = 10.0
AUTHORS = [MOLE, WREN, *(Author(RobotName("fox"), Incarnation(f"{n:016x}")) for n in range(2))]


def push_until_stopped(process: Process, author: Author, acked: list[Commit], enough: threading.Event) -> None:
    """As a robot does; a refusal must be one that says to come back later."""
    with client(process) as http:
        for n in range(1000):
            commit = pushed(n, n % 5, author)
            try:
                answer = http.put(f"/maps/lab/commits/{commit.id}", content=commit.data)
            except httpx.TransportError:
                return
            if answer.status_code != 201:
                assert answer.status_code == 503, answer.text
                return
            acked.append(commit)
            if len(acked) >= 8:
                enough.set()


def begun_push(process: Process, commit: Commit) -> socket.socket:
    """A push of which the server has all but the last byte."""
    assert process.url
    link = socket.create_connection(("127.0.0.1", urlsplit(process.url).port or 0), timeout=DEADLINE_S)
    head = (
        f"PUT /maps/lab/commits/{commit.id} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(commit.data)}\r\n\r\n"
    )
    link.sendall(head.encode() + commit.data[:-1])
    return link


def test_sigterm_under_load_loses_nothing_answers_what_is_under_way_and_ends_in_time(tmp_path: Path) -> None:
    process = Process(tmp_path)
    with client(process) as http:
        make_map(http)
    last = pushed(0, 2, Author(RobotName("late"), MOLE.incarnation))
    with begun_push(process, last) as link:
        acked: list[list[Commit]] = [[] for _ in AUTHORS]
        enough = [threading.Event() for _ in AUTHORS]
        threads = [
            threading.Thread(target=push_until_stopped, args=(process, *of_robot))
            for of_robot in zip(AUTHORS, acked, enough, strict=True)
        ]
        for thread in threads:
            thread.start()
        assert all(event.wait(DEADLINE_S) for event in enough)
        begin_s = time.monotonic()
        process.send(signal.SIGTERM)
        link.sendall(last.data[-1:])
        answer = link.recv(100)
        # Behind the others' pushes it may have to wait for its turn, and is told to come again.
        assert answer.startswith((b"HTTP/1.1 201 ", b"HTTP/1.1 503 "))
        late = [last] if answer.startswith(b"HTTP/1.1 201 ") else []
    code, complaints = process.end()
    stopped_s = time.monotonic() - begin_s
    for thread in threads:
        thread.join()
    assert (code, complaints) == (0, "")
    assert stopped_s < STOP_S
    assert not (tmp_path / "cairn.sqlite-wal").exists()
    again = Process(tmp_path)
    with client(again) as http:
        vector = all_folded(http).coverage
        known = [pushed(n, n % 5, author) for author in AUTHORS for n in range(1000) if CommitId(author, n) in vector]
        assert {commit.id for commits in acked for commit in commits} <= {commit.id for commit in known}
        assert (last.id in vector) == bool(late)
        bodies = {key: http.get(f"/maps/lab/main/cells/{cell_of_key(key)}").content for key in KEYS}
        assert read(bodies) == sum_of([*known, *late])
    again.send(signal.SIGTERM)
    assert again.end() == (0, "")


def test_a_push_whose_last_byte_comes_while_the_server_stops_is_answered(tmp_path: Path) -> None:
    process = Process(tmp_path)
    with client(process) as http:
        make_map(http)
    last = pushed(0, 2)
    with begun_push(process, last) as link:
        process.send(signal.SIGTERM)
        until(lambda: not is_listening(process), "the server takes no more connections")
        link.sendall(last.data[-1:])
        assert link.recv(100).startswith(b"HTTP/1.1 201 ")
    assert process.end() == (0, "")
    again = Process(tmp_path)
    with client(again) as http:
        assert last.id in all_folded(http).coverage
    again.send(signal.SIGTERM)
    assert again.end() == (0, "")


def is_listening(process: Process) -> bool:
    """True while the server takes connections."""
    assert process.url
    try:
        socket.create_connection(("127.0.0.1", urlsplit(process.url).port or 0), timeout=DEADLINE_S).close()
    except OSError:
        return False
    return True


def test_a_body_that_never_ends_is_cut_when_the_server_stops(tmp_path: Path) -> None:
    process = Process(tmp_path)
    with client(process) as http:
        make_map(http)
        with begun_push(process, pushed(0, 2)):
            assert http.get("/healthz").status_code == 200
            process.send(signal.SIGTERM)
            assert process.end() == (0, "")


def told_to_stop() -> asyncio.AbstractEventLoop:
    """A new loop of a process that is told to stop just before the loop runs."""
    signal.raise_signal(signal.SIGTERM)
    return asyncio.new_event_loop()


@pytest.mark.parametrize("drain_s", [0.0, 0.01])
def test_a_server_that_is_told_to_stop_before_it_serves_stops_without_a_complaint(
    tmp_path: Path, drain_s: float
) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    with closing(Service(SqliteStore(tmp_path), Settings(folder=tmp_path, drain_s=drain_s))) as service:
        app = make_app(service)
        config = config_of(app, service.settings)
        config.loop = f"{__name__}:told_to_stop"
        with listen("127.0.0.1", 0) as listener, pytest.raises(KeyboardInterrupt, match="SIGTERM"):
            StoppableServer(config, app).run(sockets=[listener])
    assert signal.getsignal(signal.SIGTERM) is handler
