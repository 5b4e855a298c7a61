"""Pictures of the page in each state that an operator meets, at each size of screen, dark and light: to be looked at.

    python -m tests.console.states http://127.0.0.1:8750/#map=building pictures/ --sizes 390x844 1280x720 --themes dark

Of any running server without tokens, which is only read. States without a map come of answers in the server's place.
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from playwright.sync_api import Browser, BrowserContext, Route, ViewportSize
from tests.console.browsing import Console, browser

SIZES = ("1440x900", "1280x720", "1024x768", "390x844", "844x390")
THEMES = ("dark", "light")
TABS = ("Findings", "Robots", "Tools", "Time")
PLACES = """[0.4, 0.5, 0.6].flatMap((y) => [0.3, 0.4, 0.5, 0.6, 0.7].map((x) =>
  c.picker.at(x * c.stage.canvas.clientWidth, y * c.stage.canvas.clientHeight)?.point)).filter(Boolean)"""
"""Points of the map at places over all of the picture."""
NO_WEBGL = """const before = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : before.call(this, kind, ...more);
};"""
State = Callable[[Console], None]


def _tell(expression: str) -> State:
    """State that the page's own objects lead to."""
    return lambda console: console.tell(f"({expression}, 0)")


def _measured(console: Console) -> None:
    console.tell(f"(c.measure.switch(), {PLACES}.slice(0, 3).forEach((point) => c.measure.add(point)), 0)")


def _asked(console: Console) -> None:
    console.tell("(c.camera.top(), 0)")
    console.settled()
    console.tell("(c.ask(c.stage.canvas.clientWidth / 2, c.stage.canvas.clientHeight / 2), 0)")


def _marking(console: Console) -> None:
    console.tell(f"(c.findings.mark({PLACES}[0]), 0)")
    console.page.get_by_role("dialog").wait_for()


def _retracting(console: Console) -> None:
    console.tell("(c.time.open(c.time.timeline.commits.findLast(({ out, isRetract }) => !out && !isRetract).entry), 0)")
    console.page.get_by_role("button", name="Show what that takes out").click()
    console.page.get_by_role("button", name=re.compile("out for good$")).wait_for()
    console.page.get_by_text("Looking what it changes").wait_for(state="detached")


def _compared(console: Console) -> None:
    console.tell("(c.time.compare(), 0)")
    console.until("c.time.comparison.changes", "the server compared")


def _keys(console: Console) -> None:
    console.page.keyboard.press("?")
    console.page.get_by_role("dialog").wait_for()


def _tab(name: str) -> State:
    return lambda console: (
        console.page.get_by_role("navigation", name="Panels").get_by_role("button", name=name).click()
    )


AGAIN = _tell("c.setField('colour'), c.time.showNow(), c.team.follow(null), c.forget(), c.camera.home()")
STATES: dict[str, tuple[State, State | None]] = {
    "first": (_tell("0"), None),
    "finding": (_tell("c.findings.flyTo(1)"), None),
    "temperature": (_tell("c.setField('temperature')"), None),
    "age": (_tell("c.setField('age')"), None),
    "asked": (_asked, None),
    "measured": (_measured, _tell("c.measure.clear(), c.measure.switch()")),
    "look": (_tell("c.shelf.open('look')"), _tell("c.shelf.shut('look')")),
    "marking": (_marking, lambda console: console.page.keyboard.press("Escape")),
    "plan": (_tell("c.plan.switch()"), None),
    "past": (_tell("c.time.step(-2)"), None),
    "compared": (_compared, None),
    "retracting": (_retracting, lambda console: console.page.keyboard.press("Escape")),
    "followed": (_tell("c.team.follow(c.team.names[0])"), None),
    "walking": (_tell("c.camera.walk()"), None),
    "keys": (_keys, lambda console: console.page.keyboard.press("Escape")),
}
"""States of a page that shows a map: how each is come to, and left where Escape and the way home are not enough."""


def take_states(console: Console, folder: Path, end: str) -> Iterator[Path]:
    """Pictures of a page that is logged in and shows a map, one a state; names end so. On a phone one a tab, too."""
    has_tabs = console.page.get_by_role("navigation", name="Panels").is_visible()
    tabs = {f"tab-{name.lower()}": (_tab(name), _tab("Map")) for name in TABS} if has_tabs else {}
    for name, (begin, leave) in (STATES | tabs).items():
        begin(console)
        console.settled()
        path = folder / f"{name}-{end}.png"
        console.page.screenshot(path=path)
        yield path
        if leave is not None:
            leave(console)
        if name != "first":
            AGAIN(console)


def take_dead_ends(context: BrowserContext, url: str, folder: Path, end: str) -> Iterator[Path]:
    """Pictures of a page without a map, one a cause; names end so."""

    def answered(status: int, body: str) -> Callable[[Route], None]:
        return lambda route: route.fulfill(status=status, content_type="application/problem+json", body=body)

    denied = answered(401, '{"kind": "not_authenticated", "status": 401, "detail": "this map takes a token"}')
    causes: dict[str, tuple[str, str, Callable[[Route], None] | None, str]] = {
        "no-map": ("", "", answered(200, "[]"), "main.message"),
        "unknown-map": ("#map=garage", "", None, "main.message"),
        "login": ("", "", denied, "dialog"),
        "gone": ("", "", lambda route: route.abort(), "main.message"),
        "no-webgl": ("", NO_WEBGL, None, "main.stills img"),
    }
    for name, (look, script, answer, shows) in causes.items():
        page = context.new_page()
        if script:
            page.add_init_script(script)
        if answer is not None:
            page.route(re.compile("/maps$"), answer)
        page.goto(f"{url}/?test=1{look}")
        page.locator(shows).first.wait_for()
        path = folder / f"{name}-{end}.png"
        page.screenshot(path=path)
        page.close()
        yield path


def size_of(text: str) -> ViewportSize:
    """Size of a screen, from WIDTHxHEIGHT."""
    width, height = map(int, text.split("x"))
    return {"width": width, "height": height}


def take_all(chromium: Browser, address: str, folder: Path, size: str, theme: str) -> Iterator[Path]:
    """Pictures of all states of an open server's map at one size, in one theme."""
    head, _, look = address.partition("#")
    view = size_of(size)
    is_phone = min(view["width"], view["height"]) < 500
    scheme = "dark" if theme == "dark" else "light"
    with chromium.new_context(viewport=view, color_scheme=scheme, has_touch=is_phone) as context:
        console = Console(context.new_page(), None)
        console.page.goto(f"{head.rstrip('/')}/?test=1#{look}")
        console.settled()
        yield from take_states(console, folder, f"{theme}-{size}")
        console.page.close()
        yield from take_dead_ends(context, head.rstrip("/"), folder, f"{theme}-{size}")


def main() -> int:
    """Make them of a server."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("address")
    options.add_argument("folder", type=Path)
    options.add_argument("--sizes", nargs="+", default=SIZES, help="WIDTHxHEIGHT ...")
    options.add_argument("--themes", nargs="+", default=THEMES, choices=THEMES)
    args = options.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    with browser() as chromium:
        for size in args.sizes:
            for theme in args.themes:
                for path in take_all(chromium, args.address, args.folder, size, theme):
                    sys.stdout.write(f"{path}\n")
                    sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
