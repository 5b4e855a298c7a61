"""The server speaks https with a certificate that it is given, and the client asks for the right one."""

import asyncio
import gc
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
from asyncio.sslproto import SSLProtocol
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.server.certificate import certificate
from tests.fixtures.server.live import Process

from cairn_client.http.api import MapApi
from cairn_map.errors import UnreachableError
from cairn_map.wire.messages import CreateMap
from cairn_server.access.connection_places import ConnectionPlaces
from cairn_server.http.middleware.deadlines import PunctualProtocol
from cairn_server.http.middleware.secure_start import SecureStart
from cairn_server.operations.health_probe import why_not

__all__ = ["certificate"]

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(not shutil.which("openssl"), reason="the openssl command makes the certificate"),
]


@pytest.fixture(scope="module")
def url(certificate: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server with it."""
    files = ("--tls-cert", str(certificate / "cert.pem"), "--tls-key", str(certificate / "key.pem"))
    process = Process(tmp_path_factory.mktemp("data"), *files)
    assert process.url
    yield process.url
    process.send(signal.SIGTERM)
    assert process.end() == (0, "")


def test_a_client_that_knows_the_certificate_works_over_https(url: str, certificate: Path) -> None:
    assert url.startswith("https://")
    with MapApi(url, ca_file=certificate / "cert.pem") as api:
        assert api.create_map("lab", CreateMap()).name == "lab"


def test_the_health_probe_finds_it_alive(url: str) -> None:
    assert why_not(int(url.rpartition(":")[2])) is None


def test_a_websocket_that_ended_before_its_deadline_leaves_no_error_line(certificate: Path, tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text("head_s = 1.0\n")
    files = ("--tls-cert", str(certificate / "cert.pem"), "--tls-key", str(certificate / "key.pem"))
    process = Process(tmp_path / "data", *files, "--settings", str(settings))
    assert process.url
    port = int(process.url.rpartition(":")[2])
    upgrade = (
        b"GET /maps/lab/live HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    context = ssl.create_default_context(cafile=str(certificate / "cert.pem"))

    def link() -> ssl.SSLSocket:
        plain = socket.create_connection(("127.0.0.1", port), timeout=30)
        return context.wrap_socket(plain, server_hostname="127.0.0.1")

    with link() as refused:
        refused.sendall(upgrade)
        assert refused.recv(100).startswith(b"HTTP/1.1 403")
    # A silent link is cut when the same time has passed, so the deadline of the one before is over.
    with link() as silent:
        assert silent.recv(100) == b""
    process.send(signal.SIGTERM)
    assert process.end() == (0, "")


def test_the_environment_names_the_certificate_for_every_command(url: str, certificate: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cairn_client.main", "map", "create", f"{url}/maps/desk"],
        env={**os.environ, "SSL_CERT_FILE": str(certificate / "cert.pem")},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "map desk" in done.stdout


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_client_that_does_not_know_the_certificate_says_what_to_do(url: str) -> None:
    with MapApi(url) as api, pytest.raises(UnreachableError, match="SSL_CERT_FILE"):
        api.maps()
    gc.collect()  # the HTTP library leaves the socket of a failed handshake to it


def test_what_is_no_tls_is_not_served(url: str) -> None:
    with MapApi(url.replace("https", "http")) as api, pytest.raises(UnreachableError):
        api.maps()


def test_a_certificate_that_is_none_or_of_another_key_is_refused(certificate: Path, tmp_path: Path) -> None:
    (tmp_path / "none.pem").write_text("no certificate")
    for cert in (tmp_path / "none.pem", tmp_path / "missing.pem"):
        process = Process(tmp_path / "data", "--tls-cert", str(cert), "--tls-key", str(certificate / "key.pem"))
        assert process.url is None
        code, complaint = process.end()
        assert (code, "[bad_setting]" in complaint) == (1, True), complaint


def _protocols() -> int:
    """Count of protocols that are still in memory; by their type, for a proxy of what is gone answers no question."""
    return sum(issubclass(type(one), SSLProtocol) for one in gc.get_objects())


def test_a_handshake_that_is_broken_off_leaves_no_buffer_behind(certificate: Path) -> None:
    """asyncio's error holds its own frame, and that 256 kB: strangers who broke off 6000 handshakes took 1.5 GB."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate / "cert.pem", certificate / "key.pem")

    async def break_off() -> int:
        loop = asyncio.get_running_loop()
        places = ConnectionPlaces(40)
        server = await loop.create_server(
            lambda: SecureStart(PunctualProtocol.__new__(PunctualProtocol), context, places, 5.0), "127.0.0.1", 0
        )
        for hello in (b"", b"\x16\x03\x01", b"no hello at all"):
            for _ in range(10):
                _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
                writer.write(hello)
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        while places.taken != (0, 0):
            await asyncio.sleep(0.01)
        # Far more at once than there are places: most are cut before their handshake begins.
        links = []
        for n in range(600):
            link = socket.socket()
            link.setblocking(False)
            link.bind((f"127.0.{1 + n // 200}.{1 + n % 200}", 0))
            link.connect_ex(server.sockets[0].getsockname())
            links.append(link)
        await asyncio.sleep(0.5)
        assert _protocols() <= places.taken[0] <= 10
        for link in links:
            link.close()
        while places.taken != (0, 0):
            await asyncio.sleep(0.01)
        server.close()
        await asyncio.sleep(0.1)
        return _protocols()

    gc.collect()
    gc.disable()
    try:
        assert asyncio.run(break_off()) == 0
    finally:
        gc.enable()
