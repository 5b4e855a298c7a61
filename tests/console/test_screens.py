"""Pictures of every mode: made as those of the README are, never blank, and no two modes alike."""

import hashlib
from pathlib import Path

import cv2
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, tab
from tests.console.room import Room
from tests.console.screens import take_screens

pytestmark = pytest.mark.browser


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
