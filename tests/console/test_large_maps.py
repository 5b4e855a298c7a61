"""A map larger than the budget: it comes to rest, asks for nothing then, and says what it leaves out."""

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, Console, tab
from tests.console.campus import make_campus
from tests.console.room import MAP, Room

pytestmark = pytest.mark.browser

CAMPUS = "campus"
CELLS = 660
SLACK = 1.15
"""The same constant as in scene/detail.ts."""
PLANS = 20
MADE_AGAIN = f"""(() => {{
  const before = [...c.cells.all.values()].map(({{ wanted }}) => wanted).join();
  for (let n = 0; n < {PLANS}; n++) c.replan();
  return [...c.cells.all.values()].map(({{ wanted }}) => wanted).join() === before && !c.cells.isFetching;
}})()"""
DEPTHS = "[...c.cells.all.values()].filter(({ count }) => count).map(({ depth }) => depth)"
UNSHOWN = "[...c.cells.all.values()].filter((cell) => !cell.count && !cell.isEmpty).length"
BUDGET, TINY = 8000, 1000
"""Fewer nodes than the coarse views of the campus have, and than it has cells at two nodes each."""


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    with room.api as api, chromium.new_context(viewport=VIEW) as context:
        make_campus(api, MAP, CAMPUS, cells=CELLS)
        found = tab(context, room)
        try:
            found.open(f"#map={CAMPUS}")
            found.log_in()
            found.settled()
            yield found
        finally:
            api.delete_map(CAMPUS)


def views(console: Console) -> list[str]:
    """Requests for cells."""
    return [url for url in console.requests if "/main/cells" in url or "/main/views" in url]


def assert_at_rest(console: Console) -> None:
    """Nothing is asked for, however often the plan is made, and the picture stays the same."""
    console.requests.clear()
    before = console.picture()
    assert console.tell(MADE_AGAIN)
    console.settled()
    assert views(console) == []
    assert (console.picture() == before).all()


def test_a_campus_comes_to_rest_and_all_of_it_is_shown(console: Console) -> None:
    assert console.tell("c.stage.isSoftware")
    assert console.tell("c.cells.all.size") >= CELLS
    assert console.tell("c.cells.firstPictureMs") > 0
    assert console.tell("c.cells.drawn") <= SLACK * console.tell("c.cells.budget")
    assert console.tell(UNSHOWN) == 0
    assert console.page.get_by_text("not shown").is_hidden()
    console.until("Math.min(c.team.askAtMs, c.duties.askAtMs) > performance.now() + 1e4", "10 s without a request")
    assert_at_rest(console)


def test_cells_become_coarser_before_any_is_left_out(console: Console) -> None:
    before, least = console.tell("c.cells.drawn"), min(console.tell(DEPTHS))
    assert before > SLACK * BUDGET
    console.tell(f"(c.cells.budget = {BUDGET}, c.replan())")
    console.settled()
    assert console.tell("c.cells.drawn") <= SLACK * BUDGET
    assert console.tell(UNSHOWN) == 0
    assert min(console.tell(DEPTHS)) < least
    assert_at_rest(console)


def test_cells_without_room_are_counted_in_words(console: Console) -> None:
    console.tell(f"(c.cells.budget = {TINY}, c.replan())")
    console.settled()
    left = console.tell(UNSHOWN)
    assert 0 < left < CELLS
    console.page.get_by_text(f"{left} cells not shown: come closer").wait_for()
    shown, hidden = console.tell("""[true, false].map((shows) => [...c.cells.all.values()]
      .filter((cell) => (cell.count > 0) === shows && !cell.isEmpty && c.stage.frustum.intersectsBox(cell.box))
      .map(({ box }) => box.distanceToPoint(c.stage.camera.position)))""")
    assert np.max(shown) <= np.min(hidden), "the nearest are shown"
    assert_at_rest(console)
