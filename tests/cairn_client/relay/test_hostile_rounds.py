"""Rounds of a relay and of `--upstream` with a server that answers nonsense: an error in time, and the rest goes on."""

import gzip
import itertools
import logging
import os
import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.hostile_server import HostileServer, answer, forwarded
from tests.fixtures.client.joined import ADMIN, EVERY_S, Server, mapped
from tests.fixtures.client.made import GEOMETRY, MAP
from tests.fixtures.server.live import until

from cairn_client.cli import relay as relay_command
from cairn_client.http.api import ANSWER_BYTES_MAX
from cairn_client.http.request_deadline import Pace
from cairn_client.relay.carried_commits import CarriedCommits
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import Undelivered, relay_round
from cairn_client.relay.upstream import Upstream
from cairn_map.errors import CairnError
from cairn_map.wire.messages import CreateMap, MapInfo
from cairn_server.operations.upstream import OwnMaps

SHORT = Pace(grace_s=1.0, least_bytes_per_s=1e6)
ODD = "aaa"
"""Map whose answers are nonsense; its name comes before that of the sound one."""
ODD_PATH = f"/maps/{ODD}/commits".encode()
CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
AUTHORS = b",".join(b'"%x":[]' % n for n in range(100_000))
SLOW = "took longer than"
NONSENSE: dict[str, tuple[Callable[[], Iterable[bytes]], str]] = {
    "continue": (lambda: dripped(b"HTTP/1.1 100 Continue\r\n\r\n"), SLOW),
    "drip": (lambda: itertools.chain([CHUNKED], dripped(b"1\r\n \r\n")), SLOW),
    "head": (lambda: itertools.chain([b"HTTP/1.1 200 OK\r\n"], itertools.repeat(b"x: y\r\n" * 1000)), "cannot reach"),
    "coding": (lambda: [answer(gzip.compress(bytes(1 << 20)), "Content-Encoding: gzip")], "is encoded"),
    "bomb": (lambda: [answer(b'{"vector":{' + AUTHORS + b"}}")], "at most"),
    "claims": (lambda: [f"HTTP/1.1 200 OK\r\nContent-Length: {ANSWER_BYTES_MAX + 1}\r\n\r\n".encode()], "claims"),
    "too-short": (lambda: [b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\n{}"], "cannot reach"),
    "too-long": (lambda: [b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\n\r\n{}"], "CommitList"),
}
"""Answers to the question for a map's commits, and what the error says."""
IS_OVER = threading.Event()


def dripped(drop: bytes) -> Iterator[bytes]:
    """A drop each 20 ms until the tests of this file end."""
    while not IS_OVER.wait(0.02):
        yield drop


class Between:
    """A server's answers, but for those to the question for the odd map's commits."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.says: Callable[[], Iterable[bytes]] | None = None

    def __call__(self, request: bytes) -> Iterable[bytes]:
        if self.says is not None and request.startswith(b"GET " + ODD_PATH):
            return self.says()
        return [forwarded(self.port, request)]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with a sound map and an odd one, each with commits."""
    with Server(tmp_path_factory.mktemp("base")) as server:
        for name in (MAP, ODD):
            server.service.maps.create(name, CreateMap(geometry=GEOMETRY))
        mapped(server, tmp_path_factory.mktemp("robot"), "robot", 1, 2)
        server.folded(server.row)
        yield server


@pytest.fixture(scope="module")
def between(base: Server) -> Between:
    return Between(base.port)


@pytest.fixture(scope="module")
def hostile(between: Between) -> Iterator[HostileServer]:
    with HostileServer(between) as server:
        try:
            yield server
        finally:
            IS_OVER.set()


@pytest.mark.parametrize("name", NONSENSE)
def test_a_relays_round_with_nonsense_ends_with_what_it_was(
    hostile: HostileServer, between: Between, tmp_path: Path, name: str
) -> None:
    between.says, said = NONSENSE[name]
    here = CarriedCommits(tmp_path / "here", ODD, size_bytes_max=1 << 20)
    with RelayApi(hostile.url, token=ADMIN, pace=SHORT) as api, pytest.raises(CairnError) as caught:
        hold_between(relay_round(Undelivered()), here, ServerEnd(api, ODD))
    assert said in caught.value.message


@pytest.mark.parametrize("name", ["drip", "coding"])
def test_an_upstream_that_answers_one_map_with_nonsense_holds_up_no_other(
    base: Server, hostile: HostileServer, between: Between, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    between.says, said = NONSENSE[name]
    with Server(tmp_path / "field") as field:
        relay = Upstream(hostile.url, ADMIN, OwnMaps(field.service), every_s=EVERY_S, pace=SHORT)
        field.relays.append(relay)
        until(lambda: len(field.service.store.maps()) == 2, "both maps are made")
        until(lambda: field.ids() == base.ids(), "the sound map's commits came")
        assert said in caplog.text
        between.says = None
        until(lambda: ODD in field.service.sync.upstream._marks(), "the odd map goes on once its answers are sound")


def test_a_relay_that_goes_on_outlives_nonsense_in_between(
    hostile: HostileServer, between: Between, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RelayApi(f"http://127.0.0.1:{between.port}", token=ADMIN) as api:
        sound = answer(api.probe(ODD_PATH.decode()).body)
    asked = itertools.count()

    def says() -> list[bytes]:
        n = next(asked)
        if n == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return list(NONSENSE["coding"][0]()) if n == 1 else [sound]

    between.says = says
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            relay_command.main([f"{hostile.url}/maps/{ODD}", str(tmp_path / "on-the-way"), "--every", "0.01"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert next(asked) == 4
    assert re.search(r"encoded_answer: .* trying again in", caplog.text)


def test_an_upstream_makes_no_more_maps_than_the_setting_allows(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Server(tmp_path / "base") as base, Server(tmp_path / "field", upstream_maps_max=3) as field:
        base.create_map()
        field.create_map()
        with base.api() as api:
            info = api.map_info(MAP)
        invented = [info.model_copy(update={"name": f"m{n:04}"}) for n in range(1000)]
        listed = answer(b"[" + b",".join(one.model_dump_json().encode() for one in (info, *invented)) + b"]")

        def answer_to(request: bytes) -> list[bytes]:
            path = re.sub(rb"/maps/m\d+/", b"/maps/" + MAP.encode() + b"/", request)
            return [listed if request.startswith(b"GET /maps ") else forwarded(base.port, path)]

        with HostileServer(answer_to) as hostile:
            field.relays.append(Upstream(hostile.url, ADMIN, OwnMaps(field.service), every_s=EVERY_S))
            until(lambda: MAP in field.service.sync.upstream._marks(), "a whole round")
            until(lambda: "upstream_maps_max" in caplog.text, "the others are reported")
            before = len(hostile.requests)
            until(lambda: len(hostile.requests) > before + 8, "some more rounds")
            field.leave()
        assert [row.name for row in field.service.store.maps()] == [MAP, "m0000", "m0001"]
        assert caplog.text.count("cannot be joined") == 1
        assert OwnMaps(field.service).open(MapInfo.model_validate(info.model_dump())).held().vector is not None
