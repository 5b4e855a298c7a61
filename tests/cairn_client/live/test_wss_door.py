"""A bridge behind TLS: its certificate is checked, by the issuer that is named or that this machine trusts."""

import json
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import wait_until
from tests.fixtures.server.certificate import make_certificate
from websockets.sync.server import ServerConnection, serve

from cairn_client import main as cairn
from cairn_client.live.live_doors import open_door
from cairn_map.errors import BadInputError

pytestmark = pytest.mark.processes  # openssl makes the certificate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("tls")
    make_certificate(found)
    return found


@pytest.fixture
def url(folder: Path) -> Iterator[str]:
    """A bridge behind TLS that offers one topic."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "cert.pem", folder / "key.pem")

    def handle(link: ServerConnection) -> None:
        channel = {"id": 1, "topic": "/tf", "encoding": "cdr", "schemaName": "tf2_msgs/msg/TFMessage"}
        link.send(json.dumps({"op": "advertise", "channels": [channel]}))
        for _ in link:
            pass

    with serve(handle, "127.0.0.1", 0, ssl=context, subprotocols=["foxglove.sdk.v1"]) as server:  # type: ignore[list-item]
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"wss://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize("is_named", [True, False])
def test_a_bridge_behind_tls_is_reached(
    is_named: bool, url: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_named:
        monkeypatch.setenv("SSL_CERT_FILE", str(folder / "cert.pem"))
    source = open_door(url, ca_file=folder / "cert.pem" if is_named else None)
    source.open(lambda topic: False)
    try:
        wait_until(lambda: source.topics.keys() == {"/tf"})
    finally:
        source.close()


def test_a_certificate_of_an_unknown_issuer_is_refused_with_what_to_do(url: str) -> None:
    source = open_door(url)
    with pytest.raises(BadInputError, match=r"self-signed certificate.*--ca FILE") as caught:
        source.open(lambda topic: False)
    assert caught.value.kind == "bad_certificate"


def test_issuers_that_are_none_and_options_that_do_nothing_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "notes.txt").write_text("no certificate")
    for file in ("absent.pem", "notes.txt"):
        with pytest.raises(BadInputError, match="holds no issuer's certificate") as caught:
            open_door("wss://127.0.0.1:9", ca_file=folder / file)
        assert caught.value.kind == "no_file"
    assert cairn.main(["robot", "inspect", "ws://127.0.0.1:9", "--ca", str(folder / "cert.pem")]) == 2
    assert "has none" in capsys.readouterr().err
