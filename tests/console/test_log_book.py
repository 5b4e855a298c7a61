"""A log that is longer than what the page shows of it: who changed a cell long ago is read from it, and from where.

Pages of the log may end early, and links break: what is told of the log is the whole of it all the same.
"""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Route
from tests.console.browsing import VIEW, Console, tab
from tests.console.room import Room
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_client.http.api import MapApi
from cairn_map.commits.commit import RETRACTS_MAX, make_commit
from cairn_map.evidence.grid import cell_of_key
from cairn_map.wire.messages import CreateMap, LogEntry, Retract

pytestmark = pytest.mark.browser

LONG = "long"
COMMITS = 300
"""More than the strip of commits shows."""
RETRACTS = 5
"""Retracts that name so many commits each that a page of the log ends before the last one."""
LOG = COMMITS + RETRACTS
FINCH = "finch.0123456789abcdef"
"""A robot of which nothing came yet: what is named of it is taken out when it comes."""
SCANS = 64
"""Enough for the counts of `surface_evidence`."""

SEEDS = 40
SHORT_PAGES = """async (seeds) => {
  const Book = window.cairn.console.book.constructor;
  const told = [];
  for (let seed = 1; seed <= seeds; seed++) {
    let state = seed;
    const below = (most) => (state = (state * 48271) % 2147483647) % most;
    const entry = (seq) => ({ seq, id: `mole.0.${seq}`, kind: "+", captured_s: null, place_m: null });
    const head = below(4000), some = 1 + below(300);
    // Of each page as many entries as this server likes: one at least, while there are any.
    const json = async (path) => {
      const after = Number(new URLSearchParams(path.split("?")[1]).get("after"));
      const count = Math.min(head - after, below(3) ? 1000 : 1 + below(some));
      return Array.from({ length: Math.max(count, 0) }, (_, n) => entry(after + 1 + n));
    };
    const book = new Book({ json }, "any");
    // An event that tells of few of the entries since what is known.
    const early = below(2) * below(1 + head);
    if (early) await book.newest(early, 240);
    if (below(2)) book.add(Array.from({ length: Math.min(head, 100) }, (_, n) => entry(head - n)));
    else await book.newest(head, 240);
    const hadGap = early > 0 && book.isBefore(early) && book.robotAt(early) !== null;
    const from = 1 + below(Math.max(head, 1));
    await book.reachBack(from);
    const wanted = Array.from({ length: head }, (_, n) => n + 1).filter((seq) => seq >= from);
    const lacks = wanted.find((seq) => book.robotAt(seq) === null || book.isBefore(seq));
    told.push({ seed, head, early, from, hadGap, lacks: lacks ?? null });
  }
  return told;
}"""
"""Logs that a small server of its own tells, by seed; the first entry that the page should know and does not."""
LOST_LOG = """async () => {
  const Book = window.cairn.console.book.constructor;
  let asked = 0;
  const book = new Book({ json: async () => (asked++, []) }, "any");
  const entry = { id: "mole.0.1", kind: "+", captured_s: null, place_m: null };
  book.add(Array.from({ length: 11 }, (_, n) => ({ ...entry, seq: 5000 + n })));
  await book.newest(5010, 240);
  await book.reachBack(1);
  const { isReading, known: { size } } = book;
  book.forget();
  return { asked, isReading, known: size, after: book.known.size };
}"""


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    """A map of which the first commit was wren's, and all others mole's, who saw another cell; retracts are between."""
    with room.api as api:
        api.create_map(LONG, CreateMap(geometry=SMALL))
        for n in range(COMMITS):
            author, key = (MOLE, KEYS[0]) if n else (WREN, KEYS[1])
            cells = {key: surface_evidence(n % 3, SMALL)}
            meta = pushed(max(n - 1, 0), 0, author, cells=cells, scans=SCANS).meta
            pose = meta.scans[-1].model_copy(update={"t_map_rig": (n / 100, 0.5, 0.4)})
            api.push(LONG, make_commit(meta.model_copy(update={"scans": (*meta.scans[:-1], pose)}), cells, SMALL))
            if not n:
                until(lambda: len(api.log(LONG)) == 1, "wren's commit is folded first")
                for first in range(0, RETRACTS * RETRACTS_MAX, RETRACTS_MAX):
                    names = [f"{FINCH}.{number}" for number in range(first, first + RETRACTS_MAX)]
                    api.retract(LONG, Retract(commits=names))
                until(lambda: len(log_of(api)) == 1 + RETRACTS, "the retracts are folded")
        until(lambda: len(log_of(api)) == LOG, "all commits are folded")
        assert len(api.log(LONG, limit=1000)) < 1 + RETRACTS, "a page ends early"
    with chromium.new_context(viewport=VIEW) as context:
        found = tab(context, room)
        found.open(f"#map={LONG}")
        found.log_in()
        found.settled()
        yield found


def log_of(api: MapApi) -> list[LogEntry]:
    """The whole log."""
    found: list[LogEntry] = []
    while page := api.log(LONG, after=found[-1].seq if found else 0, limit=1000):
        found += page
    return found


def test_who_changed_a_cell_long_ago_is_known(console: Console) -> None:
    console.until(f"c.book.known.size === {LOG} && !c.book.isReading", "the whole log is read")
    console.page.keyboard.press("Shift+6")
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


def test_however_short_pages_are_and_whatever_was_left_out_all_from_an_entry_on_is_known(console: Console) -> None:
    told = console.page.evaluate(SHORT_PAGES, SEEDS)
    assert [each for each in told if each["lacks"] is not None] == []
    assert {each["hadGap"] for each in told} == {True, False}


def test_a_log_that_ends_before_what_is_known_of_it_is_read_no_more(console: Console) -> None:
    told = console.page.evaluate(LOST_LOG)
    assert told == {"asked": 2, "isReading": False, "known": 11, "after": 0}


def test_what_lies_beyond_the_log_that_is_read_is_said(console: Console) -> None:
    console.page.keyboard.press("Shift+6")
    console.tell("(c.book.isBefore = () => true, c.appearance.refreshRange(c.team.names))")
    console.page.get_by_role("region", name="Legend").get_by_text("20\u202f000 entries of the log").wait_for()


def test_entries_that_a_restored_server_lost_are_shown_no_more(console: Console) -> None:
    lost = LOG + 50
    console.tell(
        "((e) => (c.book.add([e]), c.strip.add([e])))({ ...c.strip.entries.get(c.cells.head), seq: a[0] })", lost
    )
    assert console.tell("[c.book.known.has(a[0]), c.strip.entries.has(a[0])]", lost) == [True, True]
    console.tell("c.feed.heard({ type: 'hello', resumed: false, cursor: 'of another log', robots: [] })")
    console.until(f"!c.book.known.has({lost}) && !c.strip.entries.has({lost})", "the log that was known is forgotten")
    console.until(f"c.book.known.size === {LOG} && c.strip.entries.size && !c.book.isReading", "and read again")


def test_a_log_is_read_to_its_beginning_when_a_page_of_it_did_not_come(console: Console) -> None:
    refused = []
    back = re.compile(rf"/maps/{LONG}/log\?after=0&")

    def refuse(route: Route) -> None:
        refused.append(route.request.url)
        route.abort()

    console.page.route(back, refuse)
    console.page.reload()
    console.until("c.cells.error !== null", "the page tells of trouble")
    assert 0 < console.tell("c.book.known.size") < LOG
    console.page.unroute(back)
    console.until(f"c.book.known.size === {LOG} && !c.book.isReading", "the whole log is read")
    assert refused
