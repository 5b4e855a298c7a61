"""Bodies are bounded before they are read."""

import socket
import threading
import zlib

import pytest
from tests.fixtures.server.answers import head, raw
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_map.wire.messages import Problem
from cairn_server.http.middleware.body_limit import limit_of
from cairn_server.http.middleware.deadlines import HEAD_BYTES_MAX


@pytest.mark.parametrize("claim", ["67108865", "9" * 18, "9" * 30])
def test_a_body_that_claims_too_much_is_refused_before_it_comes(live: Live, claim: str) -> None:
    row = live.new_map()
    path = f"/maps/{row.name}/commits/{pushed(0, 0).id}"
    answer = raw(live, head(live, "PUT", path, f"Content-Length: {claim}"))
    assert answer.startswith((b"HTTP/1.1 413", b"HTTP/1.1 400"))
    assert live.http.get("/healthz").status_code == 200


@pytest.mark.parametrize("claim", ["-1", "1x", "1,2", "\xb2"])
def test_a_length_that_is_none_is_refused(live: Live, claim: str) -> None:
    answer = raw(live, head(live, "POST", "/maps/x/retracts", f"Content-Length: {claim}"))
    assert answer.startswith((b"HTTP/1.1 413", b"HTTP/1.1 400"))


@pytest.mark.parametrize("route", ["PUT commits/mole.0123456789abcdef.0", "POST retracts", "POST branches"])
def test_a_body_in_chunks_is_refused_at_its_head(live: Live, route: str) -> None:
    # A chunk may have a byte, and parsing it takes as long as parsing a large one: 6 MB a second stopped all others.
    method, path = route.split()
    start = head(live, method, f"/maps/{live.new_map().name}/{path}", "Transfer-Encoding: chunked")
    with socket.create_connection(("127.0.0.1", live.port), timeout=60) as link:
        link.sendall(start)
        got = link.makefile("rb").read()
    assert got.startswith(b"HTTP/1.1 411 ")
    problem = Problem.model_validate_json(got.partition(b"\r\n\r\n")[2])
    assert (problem.status, problem.kind) == (411, "no_length")


def test_a_body_that_ends_early_is_forgotten_and_the_server_goes_on(
    live: Live, caplog: pytest.LogCaptureFixture
) -> None:
    row = live.new_map()
    commit = pushed(0, 0)
    path = f"/maps/{row.name}/commits/{commit.id}"
    raw(live, head(live, "PUT", path, f"Content-Length: {len(commit.data)}") + commit.data[:100])
    raw(live, head(live, "POST", f"/maps/{row.name}/retracts", "Content-Length: 100") + b"{")
    assert live.push(row, commit).status_code == 201
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def test_each_path_has_the_limit_that_it_needs() -> None:
    assert limit_of("/maps/lab/commits/mole.0123456789abcdef.0") == 1 << 26
    assert limit_of("/maps/lab/branches/mole/missing") == 1 << 24
    for path in ("/maps/commits/branches", "/maps/lab/commits/x/y", "/maps/lab/retracts", "/x/maps/lab/commits/y"):
        assert limit_of(path) == 1 << 20


def test_a_small_body_cannot_stand_for_much_evidence(live: Live) -> None:
    bomb = zlib.compress(b"\0" * (1 << 24))
    answer = live.http.put(f"/maps/{live.new_map().name}/commits/{pushed(0, 0).id}", content=b"CRCM\x01" + bomb)
    assert answer.status_code in (400, 413)


@pytest.mark.parametrize("parts", [1, 3])
def test_a_head_of_thousands_of_lines_is_refused_before_it_is_parsed(live: Live, parts: int) -> None:
    start = head(live, "GET", "/healthz")[:-2] + b"a:b\r\n" * 12_000 + b"\r\n"
    with socket.create_connection(("127.0.0.1", live.port), timeout=60) as link:
        link.sendall(start if parts == 1 else start[: HEAD_BYTES_MAX + 1])
        assert link.recv(12) == b"HTTP/1.1 413"


def test_a_head_and_the_body_behind_it_may_be_torn_anywhere(live: Live) -> None:
    row, commit = live.new_map(), pushed(0, 0)
    body = commit.data.ljust(HEAD_BYTES_MAX + 1, b"x")  # refused as a commit, after all of it was read
    start = head(live, "PUT", f"/maps/{row.name}/commits/{commit.id}", f"Content-Length: {len(body)}")
    for cut in range(5):
        with socket.create_connection(("127.0.0.1", live.port), timeout=60) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.sendall(start[: len(start) - cut])
            threading.Event().wait(0.05)  # most likely read by itself; right in any case
            link.sendall(start[len(start) - cut :] + body)
            answer = link.recv(1 << 16)
            assert answer.startswith(b"HTTP/1.1 400") and b"application/problem+json" in answer
