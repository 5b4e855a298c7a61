"""Sizes of screens, from a wide one to a phone on its side: the map has most of each; fingers hit what they aim at."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, ViewportSize
from tests.console.browsing import OVERFLOWING, TABLET, VIEW, Console, findings_of_axe
from tests.console.room import Room

pytestmark = pytest.mark.browser

PHONE: ViewportSize = {"width": 390, "height": 844}
PHONE_ASIDE: ViewportSize = {"width": 844, "height": 390}
WIDE: ViewportSize = {"width": 1440, "height": 900}
LEAST_SHARES = ((WIDE, 0.70), (VIEW, 0.70), (TABLET, 0.60), (PHONE, 0.85), (PHONE_ASIDE, 0.85))
SHARE = """() => {
  const lanes = document.createElement("div");
  lanes.style.height = "540px";
  document.querySelector(".axis").append(lanes);
  let [inside, all] = [0, 0];
  for (let x = 2; x < innerWidth; x += 6) for (let y = 2; y < innerHeight; y += 6) {
    all++;
    if (document.elementFromPoint(x, y)?.closest(".view")) inside++;
  }
  lanes.remove();
  return inside / all;
}"""
"""Part of the screen that is map, with what is written in the picture, and an axis of time that has thirty lanes."""
SMALL = """(least) => [...document.querySelectorAll("button, select, summary, input, a[href]")]
  .filter((e) => e.checkVisibility({visibilityProperty: true}) && !e.closest(".strip"))
  .map((e) => [e, (e.type === "checkbox" ? e.closest("label") : e).getBoundingClientRect()])
  .filter(([, {width, height}]) => Math.min(width, height) < least)
  .map(([e, {width, height}]) => `${width}x${height} ${e.outerHTML.slice(0, 80)}`)"""
THEMES: tuple[Literal["dark", "light"], ...] = ("light", "dark")
GROUNDS = {"dark": (14, 17, 22), "light": (238, 240, 243)}
TABS = ("Findings", "Robots", "Tools", "Time", "Map")


@pytest.fixture(scope="module")
def fresh(chromium: Browser, room: Room) -> Console:
    """A profile that was never here, on a touch screen."""
    context = chromium.new_context(viewport=VIEW, color_scheme="dark", has_touch=True)
    found = Console(context.new_page(), room)
    found.open()
    found.log_in()
    found.settled()
    return found


@pytest.mark.parametrize(
    ("size", "least"), LEAST_SHARES, ids=lambda each: str(each.get("width", "")) if isinstance(each, dict) else ""
)
def test_the_map_has_most_of_the_screen_and_nothing_is_cut_off(
    fresh: Console, size: ViewportSize, least: float, tmp_path: Path
) -> None:
    fresh.page.set_viewport_size(size)
    fresh.settled()
    assert fresh.page.evaluate(SHARE) >= least
    assert fresh.page.evaluate(OVERFLOWING) == []
    bright = []
    for theme in THEMES:
        fresh.page.emulate_media(color_scheme=theme)
        fresh.tell("c.theme()")
        fresh.settled()
        path = tmp_path / f"first-{size['width']}-{theme}.png"
        fresh.page.screenshot(path=path)
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        bright.append(picture.mean())
        drawn = fresh.picture()
        assert drawn.std() > 8, f"{theme}: the map is in the picture"
        assert np.abs(drawn[-2, 2].astype(int) - GROUNDS[theme]).max() <= 1, "around it is the page's ground"
    assert bright[0] > bright[1] + 60, "light is light"


@pytest.mark.parametrize("size", [PHONE, PHONE_ASIDE], ids=["upright", "aside"])
def test_a_phones_sheet_shows_one_panel_at_a_time_with_targets_for_fingers(fresh: Console, size: ViewportSize) -> None:
    page = fresh.page
    page.set_viewport_size(size)
    panels = page.get_by_role("navigation", name="Panels")
    shown = {"Findings": "Findings", "Robots": "Robots", "Tools": "Look", "Time": "Commits"}
    for name in TABS:
        panels.get_by_role("button", name=name).click()
        for tab_name, region in shown.items():
            assert page.get_by_role("region", name=region, exact=True).is_visible() == (tab_name == name), (
                name,
                region,
            )
        assert page.evaluate(SMALL, 44) == [], name
        assert page.evaluate(OVERFLOWING) == [], name
        if size is PHONE:
            assert findings_of_axe(fresh, name) == []
        if name != "Map":
            half = page.evaluate(SHARE)
            panels.get_by_role("button", name="Larger sheet").click()
            assert page.evaluate(SHARE) < half - 0.2, name
            panels.get_by_role("button", name="Smaller sheet").click()


def test_a_tap_on_the_map_opens_its_reading_and_escape_puts_it_away(fresh: Console) -> None:
    page = fresh.page
    for size in (PHONE, VIEW):
        page.set_viewport_size(size)
        fresh.ask_middle()
        card = page.get_by_role("region", name="Voxel")
        card.get_by_text("over the floor").wait_for()
        assert not page.get_by_role("region", name="Look").is_visible(), "a card by itself"
        page.keyboard.press("Escape")
        card.wait_for(state="hidden")


def test_a_tools_button_opens_its_card_and_shuts_it_and_a_column_stays(fresh: Console) -> None:
    page = fresh.page
    page.set_viewport_size(VIEW)
    shelf = page.get_by_role("navigation", name="Tools")
    assert page.evaluate(SMALL, 24) == []
    for name, region in (("Look", "Look"), ("Measure", "Measure"), ("Export", "Take away")):
        shelf.get_by_role("button", name=name).click()
        page.get_by_role("region", name=region).wait_for()
        assert page.evaluate(SHARE) > 0.45, "a card, not a column"
        assert page.evaluate(OVERFLOWING) == [], name
        shelf.get_by_role("button", name=name).click()
        page.get_by_role("region", name=region).wait_for(state="hidden")
    assert findings_of_axe(fresh, "tools") == []
    shelf.get_by_role("button", name="All").click()
    page.keyboard.press("Escape")
    page.get_by_role("region", name="Look").wait_for()
    page.reload()
    page.get_by_role("region", name="Look").wait_for()
    shelf.get_by_role("button", name="All").click()
    assert fresh.errors[1:] == [], "but for the 401 of a stranger"
