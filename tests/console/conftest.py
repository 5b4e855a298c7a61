"""A real server with a room in it, and Debian's browser to look at it."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, Console, browser, skip_without_page, tab
from tests.console.room import GEOMETRY, LOOPBACK, MAP, Room
from tests.fixtures.server.live import free_port

from cairn_map.wire.messages import CreateMap


@pytest.fixture(scope="package")
def chromium(room: Room) -> Iterator[Browser]:
    """One browser for all, each test with a profile of its own in it."""
    with browser() as made:
        yield made


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    """A tab that shows the room, the same for all tests of a file."""
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
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
