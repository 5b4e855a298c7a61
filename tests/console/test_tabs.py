"""Many tabs at once hear of a commit; and a page that comes over plain http from another address than loopback works.

There browsers give a page less than on https or loopback: no clipboard, no Web Crypto, no Brotli.
"""

import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import LOADED_MACHINE, SMALL_VIEW, tab
from tests.console.room import GEOMETRY, LOOPBACK, MAP, Room
from tests.fixtures.server.live import free_port

from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

TABS = 8
DRAWN_S = 3


def test_eight_tabs_hear_of_a_commit_and_draw_it(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=SMALL_VIEW) as context:
        tabs = [tab(context, room) for _ in range(TABS)]
        for number, each in enumerate(tabs):
            each.open()
            if number == 0:
                each.page.get_by_label("computer").check()  # the others have the token from it
                each.log_in()
            each.settled()
        before = max(each.tell("c.cells.head") for each in tabs)
        room.measure("scout", 4)
        start_s = time.monotonic()
        for each in tabs:
            each.until(f"c.cells.head > {before} && c.cells.waiting === 0", "the commit is drawn in every tab")
        assert time.monotonic() - start_s < DRAWN_S * LOADED_MACHINE
        assert [each.errors for each in tabs[1:]] == [[]] * (TABS - 1)


@pytest.fixture
def lan_room(room: Room, tmp_path: Path) -> Iterator[Room]:
    """A room whose server listens where other machines would reach it, and keeps no more than the map."""
    assert room.host == LOOPBACK
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it only asks which address would
            host = probe.getsockname()[0]
        except OSError:
            host = LOOPBACK
    if host == LOOPBACK:
        pytest.skip("no network interface but loopback here")
    made = Room(tmp_path, free_port(host), host, options=("--keep-evidence", "0"))
    made.start()
    try:
        with made.api as api:
            api.create_map(MAP, CreateMap(geometry=GEOMETRY, epoch_s=120))
        made.measure("scout", 0)
        yield made
    finally:
        made.stop()


def test_over_plain_http_on_a_lan_the_page_is_whole_and_tells_what_is_gone(chromium: Browser, lan_room: Room) -> None:
    with chromium.new_context(viewport=SMALL_VIEW) as context:
        console = tab(context, lan_room)
        console.open()
        console.log_in()
        console.settled()
        assert console.tell("isSecureContext") is False
        console.errors.clear()  # the browser tells of the 401 before
        before = console.tell("c.cells.head")
        assert console.picture().std() > 5
        lan_room.measure("scout", 1)
        console.until(f"c.cells.head > {before} && c.cells.waiting === 0", "a new commit is drawn")
        console.ask_middle()
        # This server keeps no commit's evidence once it is in the map.
        console.page.get_by_text("Commits before are not kept any more: of them only the sum is known.").wait_for()
        # The scans are of October 2025, and in a map with epochs each channel says when it was measured.
        voxel = console.page.get_by_role("region", name="Voxel").inner_text()
        assert re.search(
            r"temperature\s+\S+ °C ± \S+ °C \(\d+ samples?, 2025-10-09 \d\d:\d\d:\d\d UTC, \d+ d ago\)", voxel
        )
        copy = console.page.get_by_role("region", name="Take away").get_by_role("button", name="Copy").first
        copy.click()
        console.page.get_by_role("button", name="Copied").wait_for()
        assert console.errors == []
