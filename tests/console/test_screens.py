"""Pictures of every mode: made as those of the README are, never blank, and no two modes alike."""

import hashlib
from pathlib import Path

import cv2
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import OVERFLOWING, VIEW, Console, tab
from tests.console.room import Room
from tests.console.screens import take_screens
from tests.console.states import STATES, TABS, size_of, take_states

pytestmark = pytest.mark.browser

PHONE = "390x844"
COVERED = """() => document.querySelector("dialog[open]") ? [] :
    [...document.querySelectorAll(".view button, .tabs button")].filter((e) => {
      if (!e.checkVisibility({visibilityProperty: true})) return false;
      const {x, y, width, height} = e.getBoundingClientRect();
      const met = document.elementFromPoint(x + width / 2, y + height / 2);
      return !e.contains(met) && !met?.closest(".plan");
    }).map((e) => e.textContent)"""
"""Buttons over the map whose middle another thing lies over; the plan lies over all of them."""


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_every_mode_has_its_picture(chromium: Browser, room: Room, tmp_path: Path, theme: str) -> None:
    with chromium.new_context(viewport=VIEW, color_scheme=theme) as context:
        console = tab(context, room)
        console.open()
        console.page.get_by_label("Token").wait_for()
        console.errors.clear()  # the browser tells of the 401 before
        console.log_in()
        console.settled()
        paths = take_screens(console, tmp_path, theme)
        assert console.errors == []
    assert len({hashlib.sha256(path.read_bytes()).digest() for path in paths}) == len(paths) == 16
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 8, path.name


def test_every_state_has_a_picture_on_a_phone_with_nothing_cut_off(
    chromium: Browser, room: Room, tmp_path: Path
) -> None:
    with chromium.new_context(viewport=size_of(PHONE), color_scheme="dark", has_touch=True) as context:
        console = Console(context.new_page(), room)
        console.open("#map=room")
        console.log_in()
        console.settled()
        console.errors.clear()
        pictures = {}
        for path in take_states(console, tmp_path, PHONE):
            pictures[path.stem] = hashlib.sha256(path.read_bytes()).digest()
            assert console.page.evaluate(OVERFLOWING) == [], path.stem
            assert console.page.evaluate(COVERED) == [], path.stem
        assert console.errors == []
    assert len(pictures) == len(STATES) + len(TABS)
    assert len(set(pictures.values())) >= len(pictures) - 3, "no finding, no hot spot: some states are alike"
