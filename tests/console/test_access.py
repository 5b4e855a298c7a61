"""Who sees little, has no mouse, or a clock that is wrong, works with the page, too."""

import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Route
from tests.console.browsing import OVERFLOWING, TABLET, UPRIGHT, VIEW, Console, serious, tab
from tests.console.room import ADMIN_TOKEN, MAP, Room

pytestmark = pytest.mark.browser

FIELDS = ("colour", "temperature", "probability", "height", "age", "robot")
OFFLINE_S = 100
PNG = b"\x89PNG\r\n\x1a\n"
HOURS_MS = 5 * 3_600_000
FOCUSED = """() => {
  const e = document.activeElement;
  e.dataset.stop ??= String(document.querySelectorAll("[data-stop]").length);
  return `${e.dataset.stop} ${e === document.body || getComputedStyle(e).outlineStyle !== "none" ? "" : e.outerHTML}`;
}"""


@pytest.fixture(params=["dark", "light"])
def console(request: pytest.FixtureRequest, chromium: Browser, room: Room) -> Iterator[Console]:
    with chromium.new_context(viewport=VIEW, color_scheme=request.param) as context:
        found = tab(context, room)
        found.open()
        yield found


def test_axe_finds_nothing_serious_in_any_mode_or_panel(console: Console, room: Room) -> None:
    page = console.page
    page.get_by_role("dialog", name="Log in").wait_for()
    found = serious(console, "login")
    console.log_in("not-a-token-of-this-server")
    page.get_by_role("alert").get_by_text("token").wait_for()
    found += serious(console, "refused")
    console.log_in()
    console.settled()
    for key, field in enumerate(FIELDS, start=1):
        page.keyboard.press(f"Shift+{key}")
        found += serious(console, field)
    console.ask_middle()
    page.get_by_role("region", name="Voxel").get_by_text("Who saw it").wait_for()
    page.get_by_label("Ceiling").fill("120")
    page.get_by_role("button", name="Clip to what is in view").click()
    page.keyboard.press("m")
    console.click_about([(0, 0), (60, 0), (60, 50)])
    page.get_by_title("Follow scout").click()
    page.get_by_alt_text("The map as scout would see it").wait_for()
    for view in (VIEW, TABLET, UPRIGHT):
        page.set_viewport_size(view)
        found += serious(console, f"all panels in use, {view['width']} px")
        assert page.evaluate(OVERFLOWING) == [], view
    page.set_viewport_size(VIEW)
    for name, opener in (("Keys", "?"), ("Share", "Share")):
        page.get_by_role("button", name=opener, exact=True).click()
        page.get_by_role("dialog", name=name).wait_for()
        found += serious(console, name)
        page.keyboard.press("Escape")
    page.get_by_role("button", name=f"commit {room.commits[0]}").click()
    page.get_by_role("button", name="Show what that takes out").click()
    page.get_by_text("1 commit:").wait_for()
    found += serious(console, "retract")
    assert found == []


@pytest.mark.parametrize("console", ["dark"], indirect=True)
def test_an_operator_works_by_keyboard_alone(console: Console) -> None:
    page = console.page
    page.get_by_label("Token").wait_for()
    page.keyboard.type(ADMIN_TOKEN)
    page.keyboard.press("Enter")
    console.settled()
    stops = page.evaluate(
        "() => [...document.querySelectorAll('button, input, select, pre, canvas, [tabindex]')]"
        ".filter((e) => e.tabIndex >= 0 && !e.disabled && e.checkVisibility()).length"
    )
    reached: set[str] = set()
    for _ in range(2 * stops):
        page.keyboard.press("Tab")
        reached.add(page.evaluate(FOCUSED))
    assert [each for each in reached if "<" in each] == [], "whoever has the focus is seen to have it"
    assert len(reached) >= stops
    page.locator(".host canvas").focus()
    for key, said in (("Shift+2", "Temperature"), ("Shift+3", "Probability")):
        page.keyboard.press(key)
        assert page.get_by_role("button", name=said, exact=True).get_attribute("aria-pressed") == "true"
    page.keyboard.press("[")
    assert console.tell("c.look.ceilingM") is not None
    page.keyboard.press("]")
    page.keyboard.press("t")
    console.settled()
    page.keyboard.press("Enter")
    page.get_by_role("region", name="Voxel").get_by_text("Who saw it").wait_for()
    page.get_by_title("Follow scout").focus()
    page.keyboard.press("Enter")
    assert page.get_by_title("Follow scout").get_attribute("aria-pressed") == "true"
    page.keyboard.press("Escape")
    assert page.get_by_title("Follow scout").get_attribute("aria-pressed") == "false"


@pytest.mark.parametrize("console", ["dark"], indirect=True)
def test_a_tablet_whose_clock_is_wrong_knows_who_is_online(console: Console, room: Room) -> None:
    console.page.add_init_script(f"Date.now = ((now) => () => now() + {HOURS_MS})(Date.now)")
    console.open()
    console.log_in()
    shown_s = time.time()
    with room.api as api:
        api.put_view(MAP, "scout", PNG)
    console.until(f"c.team.signs.get('scout')?.view_s >= {shown_s}", "the page hears of the view")
    robot = console.page.get_by_role("listitem").filter(has=console.page.get_by_title("Follow scout"))
    robot.get_by_text("online").wait_for()
    assert "h ago" not in robot.inner_text()
    place = "c.team.marks.get('scout').position.toArray()"
    before = console.tell(place)
    told = console.tell("c.team.signs.get('scout')")
    told["time_s"] -= OFFLINE_S
    told["status"] = None
    console.page.route("**/branches", lambda route: _answer_seen_at(route, told["time_s"]))
    console.tell("c.team.hear(a[0])", told)
    robot.get_by_text("offline").wait_for()
    console.page.locator(".label.offline", has_text="scout").wait_for(state="attached")
    assert console.tell(place) == before, "it stays where it was last"


def _answer_seen_at(route: Route, time_s: float) -> None:
    """As if the server had heard of nobody since."""
    answer = route.fetch()
    route.fulfill(response=answer, json=[branch | {"last_seen_s": time_s} for branch in answer.json()])
