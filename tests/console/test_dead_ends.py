"""Messages of a page without a map: cause and next step; the commands that they give are run here."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import CHROMIUM, FLAGS, VIEW, Console, serious, tab
from tests.console.room import ADMIN_TOKEN, LOOPBACK, MAP, Room
from tests.fixtures.fusion.bags import small_recording
from tests.fixtures.server.live import free_port

from cairn_client.main import main
from cairn_map.wire.access_messages import CreateToken

pytestmark = pytest.mark.browser

GUEST = "guest"


@pytest.fixture
def bare(chromium: Browser, tmp_path: Path) -> Iterator[Console]:
    """A page of a server that holds nothing, logged in."""
    made = Room(tmp_path, free_port(LOOPBACK))
    made.start()
    try:
        with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
            found = tab(context, made)
            found.open("")
            found.log_in()
            yield found
    finally:
        made.stop()


def run_shown(console: Console, **given: str) -> None:
    """Run the command that the page shows, with these words in the place of those in capitals."""
    words = shlex.split(console.page.locator("pre:visible").first.inner_text())
    assert words[0] == "cairn"
    assert main([given.get(word, word) for word in words[1:]]) == 0


def test_a_server_without_a_map_names_commands_that_make_one_and_fill_it(
    bare: Console, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAIRN_TOKEN", ADMIN_TOKEN)
    monkeypatch.chdir(tmp_path)
    page = bare.page
    page.get_by_role("heading", name="No map yet").wait_for()
    assert serious(bare, "no map") == []
    run_shown(bare)
    page.get_by_role("heading", name="Nothing is in this map yet").wait_for()
    assert serious(bare, "empty map") == []
    small_recording(tmp_path / "recording")
    run_shown(bare, RECORDING=str(tmp_path / "recording"))
    bare.until("c.cells.drawn > 0", "the page shows what came without a reload")
    bare.settled()
    assert page.get_by_role("heading", name="Nothing is in this map yet").is_hidden()


def test_a_link_to_an_unknown_map_never_shows_another_one(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=VIEW, color_scheme="light") as context:
        console = tab(context, room)
        console.open("#map=garage&eye=1,2,3&target=0,0,0")
        console.log_in()
        page = console.page
        page.get_by_role("heading", name="No map garage here").wait_for()
        assert page.locator("canvas").count() == 0
        assert serious(console, "unknown map") == []
        page.get_by_role("link", name=MAP, exact=True).click()
        console.settled()
        assert console.tell("c.name") == MAP
        page.go_back()
        page.get_by_role("heading", name="No map garage here").wait_for()


def test_a_revoked_token_is_said_and_the_view_stays(chromium: Browser, room: Room) -> None:
    with room.api as api, chromium.new_context(viewport=VIEW) as context:
        secret = api.create_token(GUEST, CreateToken(role="reader")).token
        console = tab(context, room)
        console.open(f"#map={MAP}&by=height&eye=1,2,5&target=0,0,1")
        console.log_in(secret)
        console.settled()
        view = console.tell("c.stage.view")
        api.revoke_token(GUEST)
        dialog = console.page.get_by_role("dialog", name="Log in")
        dialog.get_by_text("this token ended, or was revoked").wait_for()
        console.log_in()
        console.settled()
        assert console.tell("[c.look.field, c.stage.view]") == ["height", view]


def test_without_webgl_the_server_draws_the_map(chromium: Browser, room: Room) -> None:
    blind = chromium.browser_type.launch(executable_path=CHROMIUM, args=[FLAGS[0], "--disable-3d-apis"])
    with blind.new_context(viewport=VIEW) as context:
        console = tab(context, room)
        console.open()
        console.log_in()
        page = console.page
        page.get_by_role("heading", name="This browser cannot draw the map").wait_for()
        picture = page.get_by_role("img", name=re.compile("^The map: from "))
        for layer in ("Colour", "Temperature"):
            page.get_by_role("button", name=layer).click()
            page.get_by_role("button", name=layer, pressed=True).wait_for()
            picture.wait_for()
            assert picture.evaluate("(image) => image.naturalWidth") == 640
        page.get_by_role("button", name="From above").click()
        page.get_by_role("img", name="The map: from above").wait_for()
        assert serious(console, "without WebGL") == []
        assert [said for said in console.errors if "401" not in said] == []
    blind.close()
