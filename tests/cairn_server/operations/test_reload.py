"""SIGHUP: certificate and tokens are read again without a stop, and what is not good changes nothing."""

import shutil
import signal
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.access import bearer
from tests.fixtures.server.certificate import make_certificate
from tests.fixtures.server.live import Live, Process, until
from tests.fixtures.server.processes import client
from tests.fixtures.server.prometheus_text import value

from cairn_server.settings import Settings

DAY_S = 86_400
OLD, NEW, ENROLLER, NEXT_ENROLLER = "old-admin" * 3, "new-admin" * 3, "enroller" * 3, "next-enroller" * 3


def secret_file(path: Path, *secrets: str) -> Path:
    """A file of secrets, a line each, that others do not read."""
    path.write_text("".join(f"{secret}\n" for secret in secrets))
    path.chmod(0o600)
    return path


@contextmanager
def served(folder: Path, *options: str) -> Iterator[Process]:
    """A server as a process, which ends well."""
    process = Process(folder, *options)
    assert process.url, process.end()
    yield process
    process.send(signal.SIGTERM)
    assert process.end()[0] == 0


def reloaded(process: Process, count: int) -> None:
    """Send SIGHUP, and return when the log has so many lines about it."""
    process.send(signal.SIGHUP)
    until(lambda: process.log().count("reload: ") >= count, "it read its files again")


def status(http: httpx.Client, path: str, secret: str) -> int:
    return http.get(path, headers=bearer(secret)).status_code


@pytest.mark.processes
def test_tokens_change_hands_without_a_stop(tmp_path: Path) -> None:
    admin, enroller = secret_file(tmp_path / "admin", OLD), secret_file(tmp_path / "enroller", ENROLLER)
    options = ("--admin-token-file", str(admin), "--enrolment-token-file", str(enroller))
    with served(tmp_path / "data", *options) as process, client(process) as http:

        def taken() -> list[bool]:
            both = [status(http, "/maps", secret) == 200 for secret in (OLD, NEW)]
            return both + [status(http, "/maps", secret) == 403 for secret in (ENROLLER, NEXT_ENROLLER)]

        assert taken() == [True, False, True, False]
        secret_file(admin, OLD, NEW)
        secret_file(enroller, ENROLLER, NEXT_ENROLLER)
        reloaded(process, 1)
        assert taken() == [True, True, True, True]
        secret_file(admin, NEW)
        secret_file(enroller, NEXT_ENROLLER)
        reloaded(process, 2)
        assert taken() == [False, True, False, True]
        # None of these is good: no secret, one too short, the enroller's, no file; each is said, and changes nothing.
        for n, wrong in enumerate(("", "short", NEXT_ENROLLER)):
            secret_file(admin, wrong)
            reloaded(process, 3 + n)
            assert taken() == [False, True, False, True]
        admin.unlink()
        reloaded(process, 6)
        assert taken() == [False, True, False, True]
        said = process.said()
        assert said.count("reload: the tokens stay as they were") == 4
        assert not any(secret in said for secret in (OLD, NEW, ENROLLER, NEXT_ENROLLER))
        lines = http.get("/audit", headers=bearer(NEW)).json()
        assert [line["detail"] for line in lines if line["what"] == "reload"] == ["admin token, enrolment token"] * 2


def test_servers_of_one_store_refuse_nobody_while_each_step_is_done_on_all_before_the_next(tmp_path: Path) -> None:
    """Steps of a rotation: both secrets, then the new one alone; clients change between the steps."""
    both, new = Settings(admin_token=f"{OLD}\n{NEW}"), Settings(admin_token=NEW)
    with Live(tmp_path / "a", admin_token=OLD) as a, Live(tmp_path / "b", admin_token=OLD) as b:
        servers = (a, b)

        def is_taken_everywhere(secret: str) -> bool:
            return all(status(server.http, "/maps", secret) == 200 for server in servers)

        for step, used in ((both, OLD), (new, NEW)):
            for server in servers:
                server.service.holders.use_secrets(step)
                assert is_taken_everywhere(used)
        assert [status(server.http, "/maps", OLD) for server in servers] == [401, 401]


def shown_certificate(process: Process) -> str:
    assert process.url
    host, _, port = process.url.removeprefix("https://").partition(":")
    return ssl.get_server_certificate((host, int(port)))


@pytest.mark.processes
@pytest.mark.skipif(not shutil.which("openssl"), reason="the openssl command makes the certificate")
def test_a_renewed_certificate_is_shown_and_a_wrong_one_is_not(tmp_path: Path) -> None:
    (tls := tmp_path / "tls").mkdir()
    make_certificate(tls)
    cert, key = tls / "cert.pem", tls / "key.pem"
    first = cert.read_text()
    options = ("--tls-cert", str(cert), "--tls-key", str(key), "--metrics-open")
    with served(tmp_path / "data", *options) as process:
        assert shown_certificate(process) == first

        def left_s() -> float:
            assert process.url
            text = httpx.get(f"{process.url}/metrics", verify=False).text
            return value(text, "cairn_certificate_expiry_seconds")

        assert 1 * DAY_S < left_s() <= 2 * DAY_S
        # The certificate alone is another one: it does not go with the key, and the old pair stays.
        (other := tmp_path / "other").mkdir()
        make_certificate(other, days=30)
        cert.write_bytes((other / "cert.pem").read_bytes())
        reloaded(process, 1)
        assert shown_certificate(process) == first
        assert "reload: the certificate stays as it was: --tls-cert" in process.said()
        key.write_bytes((other / "key.pem").read_bytes())
        reloaded(process, 2)
        assert shown_certificate(process) == (other / "cert.pem").read_text()
        assert 29 * DAY_S < left_s() <= 30 * DAY_S
