"""http on a port of https and the reverse, and certificates that do not hold: each is said by its cause, everywhere."""

import gc
import shutil
import signal
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.certificate import certificate
from tests.fixtures.server.live import Process

from cairn_client.cli.doctor.checks import CheckResult, certificate_check
from cairn_client.http import api as client_api
from cairn_client.http.api import MapApi
from cairn_client.http.url_scheme import unreachable
from cairn_map.errors import UnreachableError

__all__ = ["certificate"]

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(not shutil.which("openssl"), reason="the openssl command makes the certificate"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(autouse=True)
def collected() -> Iterator[None]:
    """The HTTP library leaves the socket of a failed handshake to the collector."""
    yield
    gc.collect()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server without TLS."""
    process = Process(tmp_path_factory.mktemp("plain"))
    assert process.url
    yield process.url
    process.send(signal.SIGTERM)
    process.end()


@pytest.fixture(scope="module")
def secure(certificate: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server with TLS."""
    files = ("--tls-cert", str(certificate / "cert.pem"), "--tls-key", str(certificate / "key.pem"))
    process = Process(tmp_path_factory.mktemp("secure"), *files)
    assert process.url
    yield process.url
    process.send(signal.SIGTERM)
    process.end()


@pytest.mark.parametrize(
    "command", [("map", "ls"), ("map", "create", "/maps/lab"), ("token", "list"), ("clone", "/maps/lab", "copy")]
)
def test_every_command_says_which_scheme_the_server_speaks(
    plain: str, secure: str, command: tuple[str, ...], tmp_path: Path
) -> None:
    for n, (wrong, right) in enumerate(
        ((secure.replace("https:", "http:"), secure), (plain.replace("http:", "https:"), plain))
    ):
        (folder := tmp_path / str(n)).mkdir()
        paths = [wrong + word if word.startswith("/") else word for word in command]
        said = cairn(*paths, *([] if len(paths) > 2 else [wrong]), folder=folder, code=5)
        assert f"write {right}/ [other_scheme]" in said


def test_the_doctor_says_it_too_and_not_that_the_server_is_to_be_started(
    plain: str, secure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong, right in ((secure.replace("https:", "http:"), secure), (plain.replace("http:", "https:"), plain)):
        with pytest.raises(AssertionError) as report:
            cairn("doctor", wrong, folder=tmp_path)
        assert f"write {right}/" in str(report.value)
        assert "-> give that URL" in str(report.value)


def test_a_proxy_s_answer_in_plain_words_is_understood(certificate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Words(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(400, "Client sent an HTTP request to an HTTPS server.")

        def log_message(self, format: str, *arguments: object) -> None:
            """Nothing."""

    monkeypatch.setattr(client_api, "speaks_tls", lambda url: True)
    with ThreadingHTTPServer(("127.0.0.1", 0), Words) as proxy:
        threading.Thread(target=proxy.serve_forever).start()
        url = f"http://127.0.0.1:{proxy.server_address[1]}"
        try:
            with MapApi(url) as api, pytest.raises(UnreachableError, match=r"write https://127\.0\.0\.1") as told:
                api.maps()
        finally:
            proxy.shutdown()
    assert told.value.kind == "other_scheme"


def test_a_link_that_worked_is_not_looked_at_again_when_it_breaks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    process = Process(tmp_path)
    assert process.url
    asked: list[str] = []
    monkeypatch.setattr(client_api, "speaks_tls", lambda url: bool(asked.append(url)))
    with MapApi(process.url) as api:
        api.maps()
        process.send(signal.SIGKILL)
        process.end()
        with pytest.raises(UnreachableError) as told:
            api.maps()
    assert told.value.kind == "no_link"
    assert asked == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("certificate verify failed: certificate has expired", "has ended; renew it"),
        ("certificate verify failed: certificate is not yet valid", "not valid yet"),
        ("certificate verify failed: IP address mismatch, certificate is not valid for", "of another name or address"),
        ("certificate verify failed: self-signed certificate", "SSL_CERT_FILE"),
    ],
)
def test_a_certificate_that_does_not_hold_says_why(text: str, words: str) -> None:
    error = unreachable(OSError(f"[SSL: CERTIFICATE_VERIFY_FAILED] {text}"), "https://maps/")
    assert words in error.message


def test_the_doctor_says_how_long_the_certificate_holds(
    secure: str,
    certificate: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate / "cert.pem"))
    said = cairn("doctor", secure, folder=tmp_path)
    assert "warn  certificate   valid for 2.0 days, until 2" in said
    assert "SIGHUP" in said
    assert certificate_check(30 * 86_400.0).verdict is CheckResult.OK
