"""Pictures of the page in every mode, dark and light, on a screen and on a tablet: for the README, and to be looked at.

    python -m tests.console.screens http://127.0.0.1:8750/#map=building pictures/

Of any running server without tokens; `test_screens` makes the same of the tests' room.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from tests.console.browsing import TABLET, UPRIGHT, VIEW, Console, browser

FIELDS = ("colour", "temperature", "probability", "height", "age", "robot")
VOXELS_IN_SIGHT = """Array.from({length: 100}, (_, n) => [120 + 54 * (n % 10), 120 + 38 * Math.floor(n / 10)])
    .filter(([x, y]) => {
        const { left, top } = document.querySelector(".host canvas").getBoundingClientRect();
        return c.picker.at(x, y)?.isVoxel && document.elementFromPoint(left + x, top + y)?.matches(".host canvas");
    })"""
SIZES = (VIEW, TABLET, UPRIGHT)


def take_screens(console: Console, folder: Path, theme: str) -> list[Path]:
    """Pictures of a page that is logged in, one a mode; named by mode, theme and width."""
    made: list[Path] = []

    def shoot(name: str, width: int = VIEW["width"]) -> None:
        console.settled()
        made.append(folder / f"{name}-{theme}-{width}.png")
        console.page.screenshot(path=made[-1])

    def click(place: tuple[int, int]) -> None:
        console.page.locator(".host canvas").click(position={"x": place[0], "y": place[1]})

    page = console.page
    for key, field in enumerate(FIELDS, start=1):
        page.keyboard.press(f"Shift+{key}")
        with_low_ceiling(console, lambda field=field: shoot(field))  # type: ignore[misc]
    page.keyboard.press("Shift+2")
    page.get_by_label("Only").check()
    shoot("band")
    page.get_by_label("Only").uncheck()
    page.keyboard.press("x")
    shoot("hottest")
    page.keyboard.press("Shift+1")
    page.keyboard.press("w")
    shoot("walk")
    console.settled()
    seen = console.tell(VOXELS_IN_SIGHT)
    click(seen[0])
    page.get_by_role("region", name="Voxel").get_by_text("Who saw it").wait_for()
    shoot("asked")
    page.keyboard.press("m")
    for place in (seen[0], seen[len(seen) // 2], seen[-1]):
        click(place)
    shoot("measured")
    page.keyboard.press("m")
    page.get_by_role("button", name="Clear").click()
    page.keyboard.press("h")
    page.locator("[data-robot]:not(:disabled)").first.click()
    page.get_by_alt_text("would see it").wait_for()
    for view in SIZES:
        page.set_viewport_size(view)
        page.wait_for_timeout(300)
        shoot("followed", view["width"])
    page.set_viewport_size(VIEW)
    page.locator(".host canvas").focus()
    page.keyboard.press("Escape")
    page.get_by_role("region", name="Take away").scroll_into_view_if_needed()
    shoot("taken-away")
    page.locator(".commit").first.click()
    page.get_by_role("button", name="Show what that takes out").click()
    page.get_by_text("commit:").or_(page.locator(".said .error")).first.wait_for()
    shoot("retract")
    page.keyboard.press("Escape")
    return made


def with_low_ceiling(console: Console, shoot: Callable[[], None]) -> None:
    """Without its ceiling a room is seen into."""
    console.page.get_by_label("Ceiling").fill("120")
    console.page.locator(".host canvas").focus()
    console.page.keyboard.press("h")
    console.page.evaluate("document.activeElement.blur()")
    shoot()
    console.page.get_by_label("Ceiling").fill("200")
    console.page.locator(".host canvas").focus()


def main() -> int:
    """Make them of a server."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("url")
    options.add_argument("folder", type=Path)
    args = options.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    head, _, look = args.url.partition("#")
    with browser() as made:
        for theme in ("dark", "light"):
            with made.new_context(viewport=VIEW, color_scheme=theme) as context:
                console = Console(context.new_page(), None)
                console.page.goto(f"{head.rstrip('/')}/?test=1#{look}")
                console.settled()
                for path in take_screens(console, args.folder, theme):
                    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
