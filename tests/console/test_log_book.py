"""A log that is longer than what the page shows of it: who changed a cell long ago is read from it, and from where."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import SMALL_VIEW, Console, tab
from tests.console.room import Room
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_map.commits.commit import make_commit
from cairn_map.evidence.grid import cell_of_key
from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

LONG = "long"
COMMITS = 300
"""More than the strip of commits shows."""
SCANS = 64
"""Enough for the counts of `surface_evidence`."""


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    """A map of which the first commit was wren's, and all others mole's, who saw another cell."""
    with room.api as api:
        api.create_map(LONG, CreateMap(geometry=SMALL))
        for n in range(COMMITS):
            author, key = (MOLE, KEYS[0]) if n else (WREN, KEYS[1])
            cells = {key: surface_evidence(n % 3, SMALL)}
            meta = pushed(max(n - 1, 0), 0, author, cells=cells, scans=SCANS).meta
            pose = meta.scans[-1].model_copy(update={"t_map_rig": (n / 100, 0.5, 0.4)})
            api.push(LONG, make_commit(meta.model_copy(update={"scans": (*meta.scans[:-1], pose)}), cells, SMALL))
        until(lambda: len(api.log(LONG, limit=1000)) == COMMITS, "all commits are folded")
    with chromium.new_context(viewport=SMALL_VIEW) as context:  # type: ignore[arg-type]
        found = tab(context, room)
        found.open(f"#map={LONG}")
        found.log_in()
        found.settled()
        yield found


def test_who_changed_a_cell_long_ago_is_known(console: Console) -> None:
    console.until("c.book.known.size === 300 && !c.book.isReading", "the whole log is read")
    console.page.keyboard.press("6")
    told = console.tell("[...c.cells.all.values()].map(({ key, lm }) => [key, c.book.robotAt(lm)])")
    names = {",".join(map(str, cell_of_key(key))): robot for key, robot in ((KEYS[0], "mole"), (KEYS[1], "wren"))}
    assert dict(told) == names


def test_trails_lead_through_the_places_of_commits_from_before_the_page_was_opened(console: Console) -> None:
    console.until("c.team.marks.get('mole')?.places.length === 299", "mole's trail")
    trail = console.tell("c.team.marks.get('mole').places")
    assert trail == [[n / 100, 0.5, 0.4] for n in range(1, COMMITS)]
    assert console.tell("c.team.marks.get('wren').places") == [[0, 0.5, 0.4]]
    drawn = console.tell("[...c.team.marks.get('mole').trail.geometry.attributes.position.array.slice(-3)]")
    assert drawn == pytest.approx(trail[-1])


def test_what_lies_beyond_the_log_that_is_read_is_said(console: Console) -> None:
    console.tell("(c.book.isBefore = () => true, c.appearance.refreshRange(c.team.names))")
    console.page.get_by_role("region", name="Legend").get_by_text("20\u202f000 entries of the log").wait_for()
