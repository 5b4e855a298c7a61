"""Names of a server: those that it was given, those of its certificate, or those of its address and machine."""

import shutil
import socket
from pathlib import Path

import pytest
from tests.fixtures.server.certificate import certificate  # noqa: F401 - a fixture

from cairn_map.errors import BadInputError
from cairn_server.access.own_names import OwnNames
from cairn_server.access.server_certificate import ServerCertificate
from cairn_server.settings import Settings

MACHINE = socket.gethostname().lower()


def test_given_names_stand_alone() -> None:
    names = OwnNames.of(Settings(public_urls="https://Maps.Example.org http://10.0.0.1:8750/maps"))
    given = {"https://maps.example.org:443", "http://10.0.0.1:8750"}
    assert names.origins("http", ("127.0.0.1", 8750)) == given


def test_without_any_the_address_of_the_connection_counts_and_the_name_of_the_machine() -> None:
    names = OwnNames.of(Settings())
    far = names.origins("http", ("192.168.1.5", 8750))
    assert {"http://192.168.1.5:8750", f"http://{MACHINE}:8750"} <= far
    assert not {"http://localhost:8750", "http://127.0.0.1:8750"} & far
    assert "http://localhost:8750" in names.origins("http", ("127.0.0.1", 8750))
    assert "http://[fd00::1]:8750" in names.origins("http", ("fd00:0::1", 8750))
    assert "http://192.168.1.5:8750" in names.origins("http", ("::ffff:192.168.1.5", 8750))


@pytest.mark.processes  # openssl makes the certificate
@pytest.mark.skipif(not shutil.which("openssl"), reason="the openssl command makes the certificate")
def test_a_certificate_says_who_the_server_is(certificate: Path) -> None:  # noqa: F811 - the fixture
    names = OwnNames.of(Settings(), ServerCertificate(certificate / "cert.pem", certificate / "key.pem"))
    assert names.origins("https", ("192.168.1.5", 8750)) == {"https://127.0.0.1:8750"}
    with pytest.raises(BadInputError, match="--tls-cert"):
        ServerCertificate(certificate / "none.pem", certificate / "key.pem")


def test_what_is_no_url_is_no_public_name() -> None:
    with pytest.raises(ValueError, match="http://HOST:PORT"):
        Settings(public_urls="maps.example.org")
