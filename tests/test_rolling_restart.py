"""A rolling restart: servers of one site are replaced one after the other behind the proxy that is shipped.

Clients push and ask all the time and try nothing a second time: no request fails, and no acknowledged commit is lost.
What this does not show: a server that is killed, whose requests on their way a proxy answers with 502.
"""

import itertools
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
import yaml
from tests.crash.lives import commit_of
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.caddy import CADDYFILE, HOST, Proxy, caddy_before, needs_caddy
from tests.fixtures.server.live import Process, free_port, until
from tests.fixtures.server.postgres import WHEEL, new_database, programs_of
from tests.fixtures.sources import ROOT
from tests.replicas.fault_run import postgres_in

from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName
from cairn_map.wire.messages import CreateMap

pytestmark = [pytest.mark.processes, pytest.mark.slow]

MAPS = ["lab", "hall"]
DRAIN_S = 8
"""More than the proxy's look at /healthz each second, and less than the drain of compose.scale.yaml."""
SEEN_S = 3
"""Time in which the proxy has surely seen that a new server is there, as docs/scale.md asks before the next is stopped:
Caddy 2.6 lets a GET wait while it knows no server that is well, and answers a PUT 503 at once."""


@dataclass(slots=True)
class Crowd:
    """Robots and readers at work, each request once."""

    proxy: Proxy
    answers: Counter[str] = field(default_factory=Counter)
    acked: list[tuple[str, CommitId]] = field(default_factory=list)
    _ended: threading.Event = field(default_factory=threading.Event)
    _threads: list[threading.Thread] = field(default_factory=list)

    def start(self) -> None:
        """Begin with three robots and a reader on each map."""
        for number in range(6):
            self._run(lambda http, number=number: self._push(http, number))  # type: ignore[misc]
        for name in MAPS:
            self._run(lambda http, name=name: self._read(http, name))  # type: ignore[misc]

    def end(self) -> None:
        """End all of them."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def goes_on(self) -> None:
        """Return when as many requests more were answered as make a rest of some seconds."""
        before = self.answers.total()
        until(lambda: self.answers.total() > before + 200, "requests are answered")

    def _run(self, ask: Callable[[httpx.Client], Iterator[str]]) -> None:
        def run() -> None:
            with httpx.Client(verify=self.proxy.tls, timeout=30.0, base_url=self.proxy.url) as http:
                for answer in ask(http):
                    self.answers[answer] += 1
                    if self._ended.wait(0.01):
                        return

        thread = threading.Thread(target=run)
        self._threads.append(thread)
        thread.start()

    def _push(self, http: httpx.Client, number: int) -> Iterator[str]:
        name, author = MAPS[number % 2], Author(RobotName(f"robot{number}"), Incarnation(f"{number:016x}"))
        for n in itertools.count():
            commit = commit_of(author, n)
            answer = _answer(http, "PUT", f"/maps/{name}/commits/{commit.id}", commit.data)
            if answer == "PUT 201":
                self.acked.append((name, commit.id))
            yield answer

    def _read(self, http: httpx.Client, name: str) -> Iterator[str]:
        for path in itertools.cycle([f"/maps/{name}", "/servers", f"/maps/{name}/main/cells"]):
            yield _answer(http, "GET", path)


def _answer(http: httpx.Client, method: str, path: str, body: bytes | None = None) -> str:
    try:
        answer = http.request(method, path, content=body)
        return f"{method} {answer.status_code}" + ("" if answer.is_success else f" {answer.text}")
    except httpx.TransportError as exc:
        return f"{method} {type(exc).__name__}"


@needs_caddy
def test_servers_are_replaced_one_by_one_and_no_request_fails(tmp_path: Path) -> None:
    with postgres_in(programs_of(WHEEL)) as postgres:
        store = new_database(postgres).url
        folding = Process(tmp_path / "folder", "--store", store, "--fold-only")
        ports = [free_port(HOST), free_port(HOST)]

        def started(number: int, turn: int) -> Process:
            options = ("--no-fold", "--drain", str(DRAIN_S), "--port", str(ports[number]))
            return Process(tmp_path / f"server{number}-{turn}", "--store", store, *options)

        servers = [started(0, 0), started(1, 0)]
        urls = [f"{HOST}:{port}" for port in ports]
        with (
            caddy_before(urls, tmp_path) as proxy,
            httpx.Client(verify=proxy.tls, base_url=proxy.url) as http,
        ):
            for name in MAPS:
                http.put(f"/maps/{name}", json=CreateMap(geometry=SMALL).model_dump(mode="json")).raise_for_status()
            crowd = Crowd(proxy)
            crowd.start()
            try:
                for number in range(2):
                    crowd.goes_on()
                    servers[number].send(signal.SIGTERM)
                    assert servers[number].end()[0] in (0, -signal.SIGTERM)
                    crowd.goes_on()  # by the other one alone
                    servers[number] = started(number, 1)
                    time.sleep(SEEN_S)
                crowd.goes_on()
            finally:
                crowd.end()
            assert set(crowd.answers) == {"PUT 201", "GET 200"}, crowd.answers
            held = [http.get(f"/maps/{name}/commits/{commit}").status_code for name, commit in crowd.acked]
            assert held == [200] * len(held) and len(held) > 300
        for process in (*servers, folding):
            process.send(signal.SIGTERM)
            process.end()


def test_the_servers_drain_for_longer_than_the_proxy_needs_to_notice() -> None:
    compose = yaml.safe_load((ROOT / "docker" / "compose.scale.yaml").read_text())
    drain_s = compose["services"]["server-1"]["environment"]["CAIRN_DRAIN_S"]
    assert "health_uri /healthz" in CADDYFILE.read_text() and "health_interval 1s" in CADDYFILE.read_text()
    assert DRAIN_S < drain_s < int(compose["services"]["server-1"]["stop_grace_period"].removesuffix("s")) / 2


def test_a_server_that_drains_says_so_and_answers_and_a_second_signal_ends_it(tmp_path: Path) -> None:
    server = Process(tmp_path, "--drain", "600")
    with httpx.Client(base_url=server.url or "") as http:
        assert http.get("/healthz").status_code == 200
        server.send(signal.SIGTERM)
        until(lambda: http.get("/healthz").status_code == 503, "it says so")
        assert http.get("/readyz").status_code == 503
        assert http.put("/maps/lab", json={}).status_code == 201
        server.send(signal.SIGTERM)
        assert server.end()[0] in (0, -signal.SIGTERM)
