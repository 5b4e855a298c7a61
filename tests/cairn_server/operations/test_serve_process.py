"""The server as a process: killed, stopped, started twice."""

import random
import signal
import threading
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.live import DEADLINE_S, Process
from tests.fixtures.server.processes import all_folded, client, make_map
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.evidence.grid import cell_of_key
from cairn_server.operations.health_probe import why_not
from cairn_server.store.folder_lock import told_port

pytestmark = pytest.mark.processes


def push_until_killed(
    process: Process, author: Author, first: int, acked: list[Commit], enough: threading.Event
) -> None:
    with client(process) as http:
        for n in range(first, first + 500):
            commit = pushed(n, n % 5, author)
            try:
                http.put(f"/maps/lab/commits/{commit.id}", content=commit.data).raise_for_status()
            except httpx.TransportError:
                return
            acked.append(commit)
            if len(acked) >= 5:
                enough.set()


def test_what_was_acknowledged_is_there_and_folded_after_kill_9(tmp_path: Path) -> None:
    rng = random.Random(5)
    acked: list[Commit] = []
    for start in range(2):
        process = Process(tmp_path)
        if not start:
            with client(process) as http:
                make_map(http)
        enough = threading.Event()
        news: dict[Author, list[Commit]] = {MOLE: [], WREN: []}
        # Numbers go on behind what may have been kept without being acknowledged.
        threads = [
            threading.Thread(target=push_until_killed, args=(process, author, start * 600, found, enough))
            for author, found in news.items()
        ]
        for thread in threads:
            thread.start()
        assert enough.wait(DEADLINE_S)
        threading.Event().wait(rng.uniform(0, 0.05))  # not to synchronise: to kill at any point of a push
        process.send(signal.SIGKILL)
        for thread in threads:
            thread.join()
        process.end()
        acked += [commit for found in news.values() for commit in found]
    process = Process(tmp_path)
    with client(process) as http:
        vector = all_folded(http).coverage
        assert all(commit.id in vector for commit in acked)
        # A push that was not acknowledged may have been kept; the map is the sum of what the vector names.
        known = [pushed(n, n % 5, author) for author in (MOLE, WREN) for n in _numbers(author, vector)]
        bodies = {key: http.get(f"/maps/lab/main/cells/{cell_of_key(key)}").content for key in KEYS}
        assert read(bodies) == sum_of(known)
        assert len(known) - len(acked) <= 4
    process.send(signal.SIGTERM)
    assert process.end() == (0, "")


def _numbers(author: Author, vector: object) -> list[int]:
    return [n for n in range(1200) if CommitId(author, n) in vector]  # type: ignore[operator]


def test_sigterm_ends_with_0_and_what_was_pending_is_folded_after_the_next_start(tmp_path: Path) -> None:
    process = Process(tmp_path)
    commits = [pushed(n, n) for n in range(12)]
    with client(process) as http:
        make_map(http)
        for commit in commits:
            http.put(f"/maps/lab/commits/{commit.id}", content=commit.data).raise_for_status()
        with http.stream("GET", "/maps/lab/events"):  # which has no end of its own, and must not hold it up
            process.send(signal.SIGTERM)
            assert process.end() == (0, "")
    assert not (tmp_path / "cairn.sqlite-wal").exists()
    again = Process(tmp_path)
    with client(again) as http:
        assert all_folded(http).vector == {str(MOLE): [[0, 11]]}
        second = Process(tmp_path)
        assert second.url is None
        code, complaint = second.end()
        assert code == 4
        assert complaint.startswith(f"cairn serve: another server works on {tmp_path}; stop it")
        assert http.get("/healthz").status_code == 200
        assert why_not(told_port(tmp_path) or 0) is None, "the health check finds the server by its folder"
    again.send(signal.SIGINT)
    assert again.end() == (0, "")
