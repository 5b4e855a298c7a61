"""Time of a request against a server that drips: bounded as a whole, though each single byte comes in time."""

import contextlib
import itertools
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import product

import pytest
from tests.fixtures.client.hostile_server import HostileServer
from tests.fixtures.client.made import MAP

from cairn_client.http.api import MapApi
from cairn_client.http.request_deadline import PACE, Pace
from cairn_map.errors import UnreachableError
from cairn_map.wire.messages import MissingRequest

SHORT = Pace(grace_s=0.3, least_bytes_per_s=1e6)
"""So short that the dripping servers below, of a byte each 20 ms, would take minutes longer."""
CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
DRIPS: dict[str, tuple[bytes, Callable[[], Iterable[bytes]]]] = {
    "head": (b"HTTP/1.1 200 OK\r\nX: ", lambda: itertools.repeat(b"x")),
    "processing": (b"", lambda: itertools.repeat(b"HTTP/1.1 102 Processing\r\n\r\n")),
    "body": (b"HTTP/1.1 200 OK\r\nContent-Length: 40000\r\n\r\n", lambda: itertools.repeat(b"x")),
    "body-without-length": (b"HTTP/1.1 200 OK\r\n\r\n", lambda: itertools.repeat(b"x")),
    "chunk-size": (CHUNKED + b"1;", lambda: itertools.repeat(b"x")),
    "trailer": (CHUNKED + b"0\r\nX: ", lambda: itertools.repeat(b"x")),
    "error": (b"HTTP/1.1 503 x\r\nContent-Length: 40000\r\n\r\n", lambda: itertools.repeat(b"x")),
}
CALLS: dict[str, Callable[[MapApi], object]] = {
    "probe": lambda api: api.probe("/healthz"),
    "missing": lambda api: list(api.missing(MAP, "mole", MissingRequest())),
}


@contextlib.contextmanager
def dripping(name: str) -> Iterator[str]:
    """URL of a server that answers with drips until the test ends."""
    begin, drops = DRIPS[name]
    is_over = threading.Event()

    def answer_to(request: bytes) -> Iterator[bytes]:
        yield begin
        for drop in drops():
            yield drop
            if is_over.wait(0.02):
                return

    with HostileServer(answer_to) as server:
        try:
            yield server.url
        finally:
            is_over.set()


@pytest.mark.parametrize(
    ("call", "name"), [*product(["probe"], DRIPS), *product(["missing"], ["processing", "trailer", "error"])]
)
def test_a_request_to_a_server_that_drips_ends(call: str, name: str) -> None:
    with dripping(name) as url, MapApi(url, pace=SHORT) as api:
        with pytest.raises(UnreachableError) as caught:
            CALLS[call](api)
        assert caught.value.kind == "no_link" and "took longer than" in caught.value.message


def test_bytes_lengthen_the_time_and_those_of_the_body_count() -> None:
    link_bytes_per_s = 10_000 / 8
    for size_bytes in (0, 1 << 8, 1 << 18, 1 << 26):
        assert PACE.allowed_s(size_bytes) > size_bytes / link_bytes_per_s, "a link of 10 kbit/s is in time"
    slow = Pace(grace_s=2.0, least_bytes_per_s=1e6)
    with dripping("body") as url, MapApi(url, pace=slow) as api, pytest.raises(UnreachableError) as caught:
        api.probe("/x")
    found = re.search(r"longer than \d+ s for a request of which (\d+) bytes", caught.value.message)
    assert found and int(found[1]) > 0
