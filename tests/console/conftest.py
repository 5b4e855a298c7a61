"""A real server with a room in it, and Debian's browser to look at it."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import CHROMIUM, VIEW, Console, browser, tab
from tests.console.room import ADMIN_TOKEN, GEOMETRY, MAP, mapping, push_measurement
from tests.fixtures.server.live import Process, free_port, until

from cairn_client.http.api import MapApi
from cairn_map.wire.messages import CreateMap
from cairn_server.http.routes.console_files import STATIC

LOOPBACK = "127.0.0.1"


@dataclass
class Room:
    """The server, which can be stopped and started again at the same address."""

    folder: Path
    port: int
    host: str = LOOPBACK
    name: str = MAP
    options: tuple[str, ...] = ()
    """More arguments of the server."""
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
        self.process = Process(self.folder / "server", *place, "--admin-token-file", str(token), *self.options)
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


def skip_without_page() -> None:
    """Skip a test where there is no page or no browser to show it."""
    if not (STATIC / "index.html").exists():
        pytest.skip("the console is not built: `make console` where npm's packages can be had")
    if CHROMIUM is None and not os.environ.get("CAIRN_REQUIRE_BROWSER"):
        pytest.skip("no chromium here: apt-get install chromium")


@pytest.fixture(scope="package")
def chromium(room: Room) -> Iterator[Browser]:
    """One browser for all, each test with a profile of its own in it."""
    with browser() as made:
        yield made


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    """A tab that shows the room, the same for all tests of a file."""
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:  # type: ignore[arg-type]
        found = tab(context, room)
        found.open()
        found.log_in()
        found.settled()
        found.errors.clear()  # the browser tells that a stranger was refused
        yield found


@pytest.fixture(scope="package")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    """Two robots measured from a stop each."""
    skip_without_page()
    made = Room(tmp_path_factory.mktemp("console"), free_port(LOOPBACK))
    made.start()
    try:
        with made.api as api:
            api.create_map(MAP, CreateMap(geometry=GEOMETRY))
        made.measure("scout", 0)
        made.measure("mole", 1)
        yield made
    finally:
        made.stop()
