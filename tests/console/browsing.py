"""The console in a browser, and what its test door (`?test=1`) tells of it."""

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Page, ViewportSize, sync_playwright
from tests.console.room import ADMIN_TOKEN, Room

from cairn_server.http.routes.console import STATIC

CHROMIUM = shutil.which("chromium")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
"""WebGL without a graphics card, in a container that has no namespaces and little shared memory."""
SETTLED = """c && c.cells.all.size > 0 && c.cells.waiting === 0 && c.cells.running === 0
  && !c.cells.needsPlan && !c.moved && !c.spread.isBehind(c.cells.head)
  && !c.stage.isMoving"""
SMALL_PLAN = "c && (c.plan.small.style.visibility = a[0])"
"""Hides or shows the small plan, which lies over the picture's edge."""
DEADLINE_S = 60.0
LOADED_MACHINE = 10
"""Factor on the console's time limits: a machine that runs other tests at the same time is so much slower."""
VIEW: ViewportSize = {"width": 1280, "height": 720}
SMALL_VIEW: ViewportSize = {"width": 480, "height": 360}
TABLET: ViewportSize = {"width": 1024, "height": 768}
UPRIGHT: ViewportSize = {"width": 768, "height": 1024}
OVERFLOWING = """() => [...document.querySelectorAll("header, aside, footer, main, button, .legend")]
    .filter((e) => e.offsetParent && (e.getBoundingClientRect().right > innerWidth + 1
        || (e.matches("aside, button, .legend") && e.scrollWidth > e.clientWidth + 1)))
    .map((e) => `${e.tagName} ${e.className} ${e.textContent.slice(0, 40)}`)"""
"""Parts of the page that are wider than their place."""


class Console:
    """One tab."""

    def __init__(self, page: Page, room: Room | None) -> None:
        self.page = page
        page.set_default_timeout(1000 * DEADLINE_S)
        self.room = room
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        page.on("request", lambda request: self.requests.append(request.url))

    def open(self, look: str | None = None) -> None:
        """Open a map; without a look that of the room, all of it: no ceiling is cut off."""
        assert self.room is not None
        shown = f"#map={self.room.name}&ceiling=off" if look is None else look
        self.page.goto(f"{self.room.url}/?test=1{shown}")

    def log_in(self, token: str = ADMIN_TOKEN) -> None:
        self.page.get_by_label("Token").fill(token)
        self.page.get_by_role("button", name="Log in").click()

    def tell(self, expression: str, *arguments: Any) -> Any:
        """What the page's own objects say: `c` is the console, `a` the arguments."""
        return self.page.evaluate(
            f"(a) => {{ const c = window.cairn?.console; return {expression}; }}", list(arguments)
        )

    def until(self, expression: str, what: str) -> float:
        """Look again until it is so; seconds that took. A page without its console yet has nothing to say."""
        start_s = time.monotonic()
        while not self.tell(f"c && ({expression})"):
            assert time.monotonic() < start_s + DEADLINE_S, f"not in {DEADLINE_S} s: {what}; {self.errors}"
            self.page.wait_for_timeout(20)
        return time.monotonic() - start_s

    def settled(self) -> None:
        """Return when all that is wanted is there, and drawn."""
        self.until(SETTLED, "everything is drawn")
        frames = self.tell("(c.stage.draw(), c.stage.frames)")
        self.until(f"c.stage.frames > {frames}", "a frame follows")

    def click_about(self, steps: Sequence[tuple[int, int]]) -> None:
        """Click the map, so many pixels right of and below its middle."""
        box = self.page.locator(".host canvas").bounding_box()
        assert box is not None
        for right, down in steps:
            self.page.mouse.click(box["x"] + box["width"] / 2 + right, box["y"] + box["height"] / 2 + down)

    def ask_middle(self) -> None:
        """Ask what is in the middle of the picture, from above, where there is something."""
        self.page.locator(".host canvas").focus()
        self.page.keyboard.press("t")
        self.settled()
        self.page.keyboard.press("Enter")

    def picture(self) -> npt.NDArray[np.uint8]:
        """(H, W, 3) what the canvas shows."""
        self.tell(SMALL_PLAN, "hidden")
        data = np.frombuffer(self.page.locator(".host canvas").screenshot(), np.uint8)
        self.tell(SMALL_PLAN, "")
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image is not None
        return image[..., ::-1].astype(np.uint8)


@contextmanager
def browser() -> Iterator[Browser]:
    """Debian's chromium with a profile of its own."""
    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield made
        made.close()


def tab(context: BrowserContext, room: Room) -> Console:
    """A tab of an operator who keeps all tools open in a column; a context's own page has none open."""
    made = Console(context.new_page(), room)
    made.page.add_init_script("localStorage.setItem('cairn.tools', localStorage.getItem('cairn.tools') ?? 'all')")
    return made


@contextmanager
def map_tab(chromium: Browser, room: Room, address: str, token: str = ADMIN_TOKEN) -> Iterator[Console]:
    """A tab in which a map is drawn; `address` is what its link has after the `?`, from the # on."""
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
        found = tab(context, room)
        found.open(address)
        found.log_in(token)
        found.settled()
        found.errors.clear()  # the browser tells that a stranger was refused
        yield found


def skip_without_page() -> None:
    """Skip a test where there is no page or no browser to show it."""
    if not (STATIC / "index.html").exists():
        pytest.skip("the console is not built: `make console` where npm's packages can be had")
    if CHROMIUM is None and not os.environ.get("CAIRN_REQUIRE_BROWSER"):
        pytest.skip("no chromium here: apt-get install chromium")


def serious(console: Console, where: str) -> list[str]:
    """Serious findings of axe-core in the page as it is."""
    return [each for each in findings_of_axe(console, where) if "serious" in each or "critical" in each]


def findings_of_axe(console: Console, where: str) -> list[str]:
    """All findings of axe-core in the page as it is."""
    violations = Axe().run(console.page).response["violations"]
    return [
        f"{where}: {each['id']}, {each['impact']}, at {len(each['nodes'])}: {each['nodes'][0]['html'][:160]}"
        for each in violations
    ]
