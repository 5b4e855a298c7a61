"""Links that dribble are cut, and slow ones are not."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from tests.fixtures.server.answers import head
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import pushed

from cairn_map.errors import BadInputError
from cairn_server.operations.serve import main

HEAD_S, GRACE_S, RATE = 0.4, 0.6, 50_000.0


@pytest.fixture(scope="module")
def hasty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with little patience."""
    with Live(tmp_path_factory.mktemp("hasty"), head_s=HEAD_S, body_grace_s=GRACE_S, body_bytes_per_s=RATE) as server:
        yield server


def connected(live: Live) -> socket.socket:
    link = socket.create_connection(("127.0.0.1", live.port), timeout=30)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return link


def is_open(link: socket.socket) -> bool:
    """True if the server still listens; its answer is dropped."""
    link.setblocking(False)
    try:
        return bool(link.recv(1 << 16))
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        link.settimeout(30)


def dribbled(link: socket.socket, data: bytes, *, every_s: float) -> float:
    """Seconds until the server cut a link that brings a byte now and then; infinite if it took all of them."""
    start_s, pause = time.monotonic(), threading.Event()
    for n in range(len(data)):
        try:
            link.sendall(data[n : n + 1])
        except OSError:
            return time.monotonic() - start_s
        pause.wait(every_s)
        if not is_open(link):
            return time.monotonic() - start_s
    return float("inf")


def test_a_head_that_comes_a_byte_at_a_time_is_cut(hasty: Live) -> None:
    with connected(hasty) as link:
        assert HEAD_S / 2 < dribbled(link, b"GET /healthz HTTP/1.1\r\n" + b"X: y\r\n" * 99, every_s=0.02) < 8 * HEAD_S


def test_a_connection_that_says_nothing_is_cut(hasty: Live) -> None:
    with connected(hasty) as link:
        until(lambda: not is_open(link), "the silent connection is cut")


def test_a_second_head_on_a_connection_has_no_more_time_than_the_first(hasty: Live) -> None:
    with connected(hasty) as link:
        link.sendall(head(hasty, "GET", "/healthz"))
        assert link.recv(1 << 16).startswith(b"HTTP/1.1 200")
        assert dribbled(link, b"GET /healthz HTTP/1.1\r\n" + b"X: y\r\n" * 99, every_s=0.02) < 8 * HEAD_S


def test_a_body_that_comes_a_byte_at_a_time_is_cut(hasty: Live) -> None:
    path = f"/maps/{hasty.new_map().name}/commits/{pushed(0, 0).id}"
    with connected(hasty) as link:
        link.sendall(head(hasty, "PUT", path, "Content-Length: 100000"))
        assert GRACE_S / 2 < dribbled(link, b"x" * 500, every_s=0.02) < 8 * GRACE_S


@pytest.mark.slow
def test_a_slow_body_above_the_least_rate_takes_the_time_that_it_takes(hasty: Live) -> None:
    row, pause = hasty.new_map(), threading.Event()
    size, step = 120_000, 4_000

    def slowly() -> Iterator[bytes]:
        for _ in range(size // step):
            yield b" " * step
            pause.wait(step / RATE * 0.7)

    start_s = time.monotonic()
    headers = {"Content-Type": "application/json", "Content-Length": str(size)}
    answer = hasty.http.post(f"/maps/{row.name}/retracts", content=slowly(), headers=headers)
    assert answer.status_code == 422  # it came whole, and is no message
    assert time.monotonic() - start_s > 2 * GRACE_S


@pytest.mark.slow
def test_a_link_that_does_not_take_its_answer_is_cut(hasty: Live) -> None:
    with connected(hasty) as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        question = head(hasty, "GET", "/openapi.json")
        threading.Thread(target=_sent_in_vain, args=(link, question * 400), daemon=True).start()
        protocols = hasty._server.server_state.connections
        until(lambda: any(p.transport.get_write_buffer_size() for p in list(protocols)), "an answer waits")  # type: ignore[union-attr]
        until(lambda: not protocols, "the link is cut")


def _sent_in_vain(link: socket.socket, data: bytes) -> None:
    with suppress(OSError):
        link.sendall(data)


@pytest.mark.parametrize("line", ["limit_concurrency = 0", "body_bytes_per_s = 0", "tls_cert = 'only.pem'"])
def test_settings_that_serve_nobody_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text(line)
    with pytest.raises(BadInputError) as refused:
        main(["--port", "0", "--settings", str(tmp_path / "settings.toml")])
    assert refused.value.kind == "bad_setting"


@pytest.mark.parametrize(
    "rest", ["Content-Length: 5\r\n\r\nhello", "X: " + "a" * 20_000 + "\r\n\r\n"], ids=["body", "long"]
)
def test_a_websocket_whose_handshake_is_none_is_cut(hasty: Live, rest: str) -> None:
    key = "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
    start = head(hasty, "GET", "/maps/lab/live", "Upgrade: websocket", "Connection: Upgrade", *key)
    with connected(hasty) as link:
        link.sendall(start[:-2] + rest.encode())
        while link.recv(1 << 16):  # b"" once it is cut; its time is up otherwise
            pass
