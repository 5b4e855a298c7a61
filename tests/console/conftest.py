"""A real server with a room in it, and Debian's browser to look at it."""

import os
import shutil
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.cairn_server.live import Process, until
from tests.console.room import GEOMETRY, MAP, mapping, push_measurement

from cairn_client.api import MapApi
from cairn_map.messages import CreateMap
from cairn_server.console_files import STATIC

CHROMIUM = shutil.which("chromium")
LOOPBACK = "127.0.0.1"
ADMIN_TOKEN = "admin-of-the-console-tests"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
"""WebGL without a graphics card, in a container that has no namespaces and little shared memory."""


@dataclass
class Room:
    """The server, which can be stopped and started again at the same address."""

    folder: Path
    port: int
    host: str = LOOPBACK
    process: Process | None = None
    commits: list[str] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://{self.host}:{self.port}"

    @property
    def api(self) -> MapApi:
        return MapApi(self.url, token=ADMIN_TOKEN)

    def start(self) -> None:
        token = self.folder / "token"
        token.write_text(ADMIN_TOKEN)
        place = ("--host", self.host, "--port", str(self.port))
        self.process = Process(self.folder / "server", *place, "--admin-token-file", str(token))
        # A process tells of loopback only.
        assert self.process.url == (self.url if self.host == LOOPBACK else None), self.process.said()

    def stop(self) -> None:
        if self.process is not None:
            self.process.send(15)
            self.process.end()
        self.process = None

    def measure(self, robot: str, stop: int) -> None:
        """A robot pushes what it sees from one stop; returns when it is in the map."""
        with mapping(f"{self.url}/maps/{MAP}", self.folder, robot, token=ADMIN_TOKEN) as made:
            self.commits.append(push_measurement(made, robot, stop))
        with self.api as api:
            until(lambda: any(entry.id == self.commits[-1] for entry in api.log(MAP)), "the commit is folded")


@pytest.fixture(scope="package")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    """Two robots measured from a stop each."""
    if not (STATIC / "index.html").exists():
        pytest.skip("the console is not built: `make console` where npm's packages can be had")
    if CHROMIUM is None and not os.environ.get("CAIRN_REQUIRE_BROWSER"):
        pytest.skip("no chromium here: apt-get install chromium")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = Room(tmp_path_factory.mktemp("console"), port)
    made.start()
    try:
        with made.api as api:
            api.create_map(MAP, CreateMap(geometry=GEOMETRY))
        made.measure("scout", 0)
        made.measure("mole", 1)
        yield made
    finally:
        made.stop()
