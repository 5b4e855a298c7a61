"""https before the map server, as `docker/compose.yaml` sets it up: the same Caddyfile in Debian's Caddy.

What this does not show: the containers' network, and certificates of others.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import yaml
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.caddy import CADDYFILE, HOST, Proxy, caddy_before, needs_caddy
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.pushes import pushed
from tests.fixtures.sources import ROOT
from websockets.sync.client import connect
from websockets.typing import Origin

from cairn_client.http.api import MapApi
from cairn_map.errors import UnreachableError
from cairn_map.wire.messages import CreateMap
from cairn_server.settings import Settings

pytestmark = pytest.mark.processes

COMPOSE, SCALE = ROOT / "docker" / "compose.yaml", ROOT / "docker" / "compose.scale.yaml"
ADMIN_TOKEN = "admin-of-the-proxy-test"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    folder = tmp_path_factory.mktemp("proxy")
    (folder / "token").write_text(ADMIN_TOKEN)
    server = Process(folder / "data", "--admin-token-file", str(folder / "token"))
    assert server.url
    try:
        with caddy_before([server.url.removeprefix("http://")], folder) as found:
            yield found
    finally:
        server.send(signal.SIGTERM)
        server.end()


def api_of(site: Proxy) -> MapApi:
    """The server as a client asks it through the proxy."""
    return MapApi(site.url, token=ADMIN_TOKEN, ca_file=site.authority)


@needs_caddy
def test_the_page_comes_over_https_and_http_leads_to_it(site: Proxy) -> None:
    answer = httpx.get(f"{site.url}/", verify=site.tls)
    assert answer.status_code == 200
    assert "cairn" in answer.text
    assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    led = httpx.get(f"{site.http_url}/")
    assert led.status_code == 308
    assert led.headers["Location"].startswith(f"https://{HOST}")


@needs_caddy
def test_who_does_not_know_the_authority_does_not_talk(site: Proxy) -> None:
    with pytest.raises(UnreachableError, match=r"(?i)certificate"):
        MapApi(site.url, token=ADMIN_TOKEN).maps()


@needs_caddy
def test_commits_and_live_news_pass_through_it(site: Proxy) -> None:
    commit = pushed(0, 0)
    with api_of(site) as api:
        api.create_map("lab", CreateMap(geometry=SMALL))
        address = f"wss{site.url.removeprefix('https')}/maps/lab/live"
        headers = {"Authorization": f"Bearer {ADMIN_TOKEN}"}
        with connect(address, ssl=site.tls, additional_headers=headers, origin=Origin(site.url)) as live:
            api.push("lab", commit)
            told = json.loads(live.recv(timeout=30))
            while told.get("head", 0) == 0 and not told.get("cells"):
                told = json.loads(live.recv(timeout=30))
        until(lambda: bool(api.cell_index("lab").cells), "the commit is folded")
        assert api.commit("lab", commit.id)[0] == commit.data


@needs_caddy
def test_a_copy_is_pulled_through_it_with_the_authority_in_the_environment(site: Proxy, tmp_path: Path) -> None:
    with api_of(site) as api:
        api.create_map("hall", CreateMap(geometry=SMALL))
        api.push("hall", pushed(0, 1))
        until(lambda: bool(api.cell_index("hall").cells), "the commit is folded")
        count = len(api.cell_index("hall").cells)
    env = {**os.environ, "SSL_CERT_FILE": str(site.authority), "CAIRN_TOKEN": ADMIN_TOKEN}
    command = [sys.executable, "-m", "cairn_client.main", "clone", f"{site.url}/maps/hall", "hall"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"hall: {count} cells")


@needs_caddy
def test_the_caddyfile_is_written_as_caddy_would(tmp_path: Path) -> None:
    written = subprocess.run(["caddy", "fmt", str(CADDYFILE)], capture_output=True, text=True, timeout=60, check=False)
    assert written.stdout == CADDYFILE.read_text()


def test_the_compose_file_names_what_is_there() -> None:
    compose = yaml.safe_load(COMPOSE.read_text())
    server, proxy = compose["services"]["server"], compose["services"]["proxy"]
    assert (COMPOSE.parent / server["build"]["context"] / server["build"]["dockerfile"]).exists()
    assert proxy["profiles"] == ["tls"]
    for service in (server, proxy):
        assert service["cap_drop"] == ["ALL"] and service["read_only"]
        assert service["mem_limit"] and service["pids_limit"]
        for place in service["volumes"]:
            source = place.partition(":")[0]
            assert source in compose["volumes"] or source.startswith(("./Caddyfile", "${CAIRN_CERTS"))
    assert server["ports"] == ["${CAIRN_PUBLISH:-127.0.0.1:8750}:8750"], "only this machine reaches it unless told"
    assert set(compose["volumes"]) == {"data", "proxy", "certs"}
    asked = {word.partition("}")[0].partition(":")[0] for word in CADDYFILE.read_text().split("{$")[1:]}
    assert set(proxy["environment"]) <= asked
    assert "server:8750" in CADDYFILE.read_text()


def test_the_compose_file_of_many_servers_names_what_is_there() -> None:
    compose = yaml.safe_load(SCALE.read_text())
    services = compose["services"]
    servers = {name: each for name, each in services.items() if each["image"] == "cairn-server-scale"}
    assert {name: each["environment"]["CAIRN_FOLDING"] for name, each in servers.items()} == {
        "server-1": "elsewhere",
        "server-2": "elsewhere",
        "folder": "only",
    }
    for server in servers.values():
        settings = {name.removeprefix("CAIRN_").lower() for name in server["environment"] if name.startswith("CAIRN_")}
        assert settings <= set(Settings.model_fields)
        assert server["cap_drop"] == ["ALL"] and server["read_only"]
        one = yaml.safe_load(COMPOSE.read_text())["services"]["server"]
        assert all(server[name] == one[name] for name in ("entrypoint", "mem_limit", "stop_grace_period"))
        build = {**one["build"], "args": {**one["build"]["args"], "LOCK": "scale.lock"}}
        assert server["build"] == build and "ARG LOCK=" in (SCALE.parent / "Dockerfile").read_text()
    assert not any("ports" in each for name, each in services.items() if name != "proxy")
    upstreams = services["proxy"]["environment"]["CAIRN_UPSTREAM"].split()
    assert (
        {place.partition(":")[0] for place in upstreams}
        == {"server-1", "server-2"}
        == set(services["proxy"]["depends_on"])
    )
    for service in services.values():
        for place in service["volumes"]:
            source = place.partition(":")[0]
            assert source in {*compose["volumes"], "/data"} or source.startswith(("./Caddyfile", "${CAIRN_CERTS"))
    Settings.model_validate({"store": servers["folder"]["environment"]["CAIRN_STORE"], "folding": "only"}).check_store()
