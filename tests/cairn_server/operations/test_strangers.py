"""Silent connections without a token, in the clear and over TLS: acceptance test 9 at a small size."""

import resource
import shutil
import socket
import ssl
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from fastapi import Request
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.certificate import certificate
from tests.fixtures.server.live import Live, until
from tests.fixtures.server.pushes import MOLE, WREN, pushed

from cairn_map.errors import BadInputError
from cairn_server.operations.serve import OTHER_DESCRIPTORS as OTHERS
from cairn_server.operations.serve import connections_within
from cairn_server.settings import Settings

PLACES = 16
"""Of which 4 are for strangers, beside, and 4 for one token."""
SILENT = 40


__all__ = ["certificate"]


@pytest.fixture(
    scope="module",
    params=["plain", pytest.param("tls", marks=pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl"))],
)
def door(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server with few places."""
    certificate: Path = request.getfixturevalue("certificate") if request.param == "tls" else Path()
    secure = {"tls_cert": certificate / "cert.pem", "tls_key": certificate / "key.pem"}
    settings = {"admin_token": ADMIN, "enrolment_token": ENROLLER, "limit_concurrency": PLACES, "head_s": 600}
    folder = tmp_path_factory.mktemp("door")
    with Live(folder, **settings, **(secure if request.param == "tls" else {})) as live:
        if request.param == "tls":
            live.http.close()
            context = ssl.create_default_context(cafile=str(certificate / "cert.pem"))
            live.http = httpx.Client(base_url=f"https://127.0.0.1:{live.port}", timeout=60, verify=context)
        # Each request over a connection of its own: an idle one is a stranger's, and is the first to go.
        live.http.headers["Connection"] = "close"
        yield live


def silent(live: Live, links: ExitStack) -> None:
    """Half a request's first line, or half a handshake, forty times."""
    for _ in range(SILENT):
        link = links.enter_context(socket.create_connection(("127.0.0.1", live.port), timeout=60))
        link.sendall(b"\x16\x03\x01" if live.http.base_url.scheme == "https" else b"GET /hea")


def fresh(live: Live, method: str, path: str, token: str, **options: object) -> httpx.Response:
    """An answer over a connection of its own."""
    return live.http.request(method, path, headers={**bearer(token), "Connection": "close"}, **options)  # type: ignore[arg-type]


def is_served(live: Live) -> bool:
    try:
        return live.http.get("/healthz").status_code == 200
    except httpx.TransportError:
        return False


@pytest.mark.processes  # openssl makes the certificate
def test_robots_and_probes_are_served_beside_any_number_of_silent_connections(door: Live) -> None:
    row = door.new_map()
    tokens = {name: robot_token(door, row, name) for name in ("mole", "wren", "fox")}
    with ExitStack() as links:
        silent(door, links)
        until(lambda: door.app.state.places.taken[0] == 4, "all places of strangers are taken")
        until(lambda: is_served(door), "the newest of them has been there for a moment")
        for n in range(3):
            assert door.http.get("/healthz", headers={"Connection": "close"}).status_code == 200
            for token in tokens.values():
                assert fresh(door, "GET", f"/maps/{row.name}", token).status_code == 200
            path = f"/maps/{row.name}/commits/{pushed(n, 0, MOLE).id}"
            assert fresh(door, "PUT", path, tokens["mole"], content=pushed(n, 0, MOLE).data).status_code == 201
            assert door.app.state.places.taken[0] <= 4
    door.http.close()
    until(lambda: door.app.state.places.taken == (0, 0), "all places are free again")


@pytest.fixture
def plain(tmp_path: Path) -> Iterator[Live]:
    settings = {"admin_token": ADMIN, "enrolment_token": ENROLLER, "limit_concurrency": PLACES}
    with Live(tmp_path, trusted_proxies="127.0.0.1", **settings) as live:
        yield live


def test_a_token_s_streams_and_connections_leave_places_for_other_tokens(tmp_path: Path) -> None:
    settings = {"admin_token": ADMIN, "enrolment_token": ENROLLER, "limit_concurrency": PLACES}
    with Live(tmp_path, **settings) as live, ExitStack() as streams:
        row = live.new_map()
        mole, wren = (robot_token(live, row, name) for name in ("mole", "wren"))
        for _ in range(4):
            client = streams.enter_context(httpx.Client(base_url=live.http.base_url, timeout=60))
            stream = client.stream("GET", f"/maps/{row.name}/events", headers=bearer(mole))
            assert streams.enter_context(stream).status_code == 200
        refused = fresh(live, "GET", f"/maps/{row.name}", mole)
        assert (refused.status_code, kind_of(refused)) == (503, "busy") and refused.headers["Retry-After"]
        assert fresh(live, "GET", f"/maps/{row.name}", wren).status_code == 200
        assert live.service.live.listeners == 4
        # Half of all places are for streams, whoever asks.
        for n in range(5):
            client = streams.enter_context(httpx.Client(base_url=live.http.base_url, timeout=60))
            answer = streams.enter_context(client.stream("GET", f"/maps/{row.name}/events", headers=bearer(ADMIN)))
            assert answer.status_code == (200 if n < 4 else 429)
        assert fresh(live, "GET", f"/maps/{row.name}", wren).status_code == 200


def test_a_robot_of_many_maps_keeps_no_other_robot_out(tmp_path: Path) -> None:
    settings = {"admin_token": ADMIN, "enrolment_token": ENROLLER, "limit_concurrency": PLACES}
    with Live(tmp_path, **settings) as live, ExitStack() as links:
        rows = [live.new_map() for _ in range(PLACES // 4 + 1)]
        wren = robot_token(live, rows[0], "wren")
        tokens = [robot_token(live, row, "mole") for row in rows]
        live.http.close()  # its idle connection is an admin's
        live.http = httpx.Client(base_url=live.http.base_url, timeout=60)
        until(lambda: live.app.state.places.taken[1] == 0, "only the robot's own connections follow")
        for row, token in zip(rows, tokens, strict=True):
            for _ in range(4):
                client = links.enter_context(httpx.Client(base_url=live.http.base_url, timeout=60))
                assert client.get(f"/maps/{row.name}", headers=bearer(token)).status_code in (200, 503)
        assert live.app.state.places.taken[1] == PLACES
        for n in range(3):
            assert (
                fresh(
                    live,
                    "PUT",
                    f"/maps/{rows[0].name}/commits/{pushed(n, 0, WREN).id}",
                    wren,
                    content=pushed(n, 0, WREN).data,
                ).status_code
                == 201
            )


def test_only_a_trusted_proxy_is_believed_about_addresses(
    plain: Live, tmp_path_factory: pytest.TempPathFactory
) -> None:
    seen: list[str] = []
    for live in (plain, None):
        with ExitStack() as own:
            server = live or own.enter_context(Live(tmp_path_factory.mktemp("alone")))

            @server.app.get(f"/seen{len(seen)}")
            async def client_of(request: Request) -> None:
                seen.append(request.client.host if request.client else "")

            server.http.get(f"/seen{len(seen)}", headers={"X-Forwarded-For": "203.0.113.9"})
    assert seen == ["203.0.113.9", "127.0.0.1"]


def test_requests_through_a_proxy_share_by_token_and_not_by_its_connections(plain: Live) -> None:
    row = plain.new_map()
    for n in range(3 * PLACES):
        token = robot_token(plain, row, f"robot{n}")
        answer = plain.http.get(f"/maps/{row.name}", headers={**bearer(token), "X-Forwarded-For": f"203.0.113.{n}"})
        assert answer.status_code == 200
    until(lambda: plain.app.state.places.taken == (0, 0), "no place is taken")


def test_a_proxy_s_address_is_an_address() -> None:
    with pytest.raises(ValueError, match="trusted_proxies"):
        Settings(trusted_proxies="the-proxy")


@pytest.mark.parametrize(("descriptors", "expected"), [(OTHERS + 625, 500), (OTHERS + 500, 400), (OTHERS + 10, 8)])
def test_connections_fit_the_file_descriptors(descriptors: int, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    set_to: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda which: (256, descriptors))
    monkeypatch.setattr(resource, "setrlimit", lambda which, both: set_to.append(both))
    assert connections_within(500) == expected
    assert set_to == [(min(descriptors, OTHERS + 625), descriptors)]


def test_too_few_descriptors_are_refused_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda which: (64, 64))
    monkeypatch.setattr(resource, "setrlimit", lambda which, both: None)
    with pytest.raises(BadInputError) as refused:
        connections_within(500)
    assert refused.value.kind == "bad_setting"
