"""The container's health check: what it says of a server, of none, and of another program."""

import socket
import threading
from pathlib import Path

from tests.fixtures.server.live import Live

from cairn_server.operations.health_probe import why_not
from cairn_server.store.folder_lock import LOCK_NAME, tell_port, told_port


def test_a_server_is_alive(live: Live) -> None:
    assert why_not(live.port) is None


def test_the_port_is_the_one_that_the_folders_server_told_last(tmp_path: Path) -> None:
    assert told_port(tmp_path) is None
    (tmp_path / LOCK_NAME).touch()
    assert told_port(tmp_path) is None
    for port in (54321, 80):
        tell_port(tmp_path, port)
        assert told_port(tmp_path) == port
    tell_port(tmp_path / "nowhere", 80)


def test_where_nobody_listens_it_says_so() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        assert "refused" in str(why_not(free.getsockname()[1]))


def test_another_program_is_not_taken_for_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            link, _ = listener.accept()
            with link:
                link.recv(4096)
                link.sendall(b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        assert why_not(listener.getsockname()[1]) == "/healthz says 503"
        thread.join()
