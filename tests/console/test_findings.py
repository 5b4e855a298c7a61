"""Findings on the page: hot spots and marks in one list, seen by all screens, and flown to where they are visible."""

import csv
import io
import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator
from tests.console.browsing import Console, map_tab, serious
from tests.console.hot_room import GEOMETRY, HIGH, SPOTS, WIDE, centre_m, commit_of
from tests.console.hot_room import room as hot_room
from tests.console.room import ADMIN_TOKEN, Room
from tests.fixtures.server.deadline import until

from cairn_client.http.api import MapApi
from cairn_map.wire.access_messages import CreateToken
from cairn_map.wire.mark_messages import MarkRequest, MarkText
from cairn_map.wire.messages import CreateMap, Retract

pytestmark = pytest.mark.browser

FURNACE = "furnace"
HOSTILE = "<img src=x onerror=alert(1)>"
ROLES = ("operator", "reader")
LANDED = "c.findings.flight === null && !c.stage.isFlying && c.cells.waiting === 0"
CELSIUS = "Math.max(...c.findings.all.map(({ celsius }) => celsius))"
CORNERS = [[0.2, 0.2, 0.0], [1.4, 0.2, 0.0], [1.4, 1.4, 0.0]]
"""Corners of a triangle on the floor, m."""
MIDDLE = """(() => {
  const { clientWidth, clientHeight } = c.stage.canvas;
  return c.picker.at(clientWidth / 2, clientHeight / 2)?.centre.toArray() ?? null;
})()"""


@pytest.fixture(scope="module")
def tokens(room: Room) -> dict[str, str]:
    """A map of the room with warm things, and who may do what there."""
    with room.api as api:
        api.create_map(FURNACE, CreateMap(geometry=GEOMETRY))
        commit = commit_of(hot_room(), 0)
        api.push(FURNACE, commit)
        until(lambda: any(entry.id == str(commit.id) for entry in api.log(FURNACE)), "the room is folded")
        return {
            role: api.create_token(f"furnace-{role}", CreateToken(role=role, map=FURNACE)).token  # type: ignore[arg-type]
            for role in ROLES
        } | {"admin": ADMIN_TOKEN}


@contextmanager
def seen_by(role: str, tokens: dict[str, str], chromium: Browser, room: Room) -> Iterator[Console]:
    """A screen of its own."""
    with map_tab(chromium, room, f"#map={FURNACE}", tokens[role]) as console:
        console.until(f"c.findings.spots.spots.length === {len(SPOTS)}", "hot spots are listed")
        yield console


@pytest.fixture(scope="module")
def desk(tokens: dict[str, str], chromium: Browser, room: Room) -> Iterator[Console]:
    """An operator's screen."""
    with seen_by("operator", tokens, chromium, room) as console:
        console.until("c.duties.isOperator", "it is known who looks")
        yield console


def rows(console: Console) -> Locator:
    return console.page.get_by_role("region", name="Findings").locator("ol > li")


def findings(console: Console, column: str) -> list[str]:
    return list(console.tell(f"c.findings.all.map((one) => one.{column})"))


def clear_marks(api: MapApi) -> None:
    """Take all marks out."""
    for entry in api.marks(FURNACE).marks:
        api.put_mark(FURNACE, MarkRequest(of=entry.key))
    until(lambda: not api.marks(FURNACE).marks, "all marks are out")


@pytest.fixture
def without_marks(room: Room, desk: Console) -> Iterator[None]:
    yield
    with room.api as api:
        clear_marks(api)
    desk.until(f"!c.findings.marks.all.length && c.findings.all.length === {len(SPOTS)}", "the page hears of it")


def test_hot_spots_are_listed_once_each_the_hottest_first_with_all_that_is_known(desk: Console) -> None:
    heat = [kelvin - 273.15 for _, kelvin in SPOTS.values()]
    assert findings(desk, "celsius") == pytest.approx(heat, abs=0.05)
    assert findings(desk, "number") == [1, 2, 3, 4]
    assert findings(desk, "spot.voxels") == [len(voxels) for voxels, _ in SPOTS.values()]
    rows(desk).first.get_by_role("button").click()
    rows(desk).first.get_by_text("0.8 m over the floor").wait_for()
    rows(desk).first.get_by_text("by mole").wait_for()
    assert serious(desk, "a finding is chosen") == []
    assert desk.errors == []


@pytest.mark.parametrize("ceiling", ["", "&ceiling=1.5"])
def test_a_flight_ends_where_the_thing_is_seen_with_the_ceiling_on_or_off(
    ceiling: str, tokens: dict[str, str], chromium: Browser, room: Room
) -> None:
    with seen_by("reader", tokens, chromium, room) as console:
        console.open(f"#map={FURNACE}{ceiling}")
        console.page.reload()
        console.settled()
        console.until(f"c.findings.all.length === {len(SPOTS)}", "hot spots are listed")
        console.page.locator(".host canvas").focus()
        for number, (name, (voxels, _)) in enumerate(SPOTS.items(), 1):
            console.page.keyboard.press(str(number))
            console.until(LANDED, f"the eye is there: {name}")
            met = console.tell(MIDDLE)
            assert met is not None, name
            off_m = min(np.linalg.norm(np.subtract(met, centre_m(voxel))) for voxel in voxels)
            if ceiling:
                assert console.tell("c.look.ceilingM === null") == (name == "lamp"), "cut again behind the lamp"
            assert off_m <= 2 * GEOMETRY.voxel_edge_m * np.sqrt(3), (name, met)
            x, y, z = console.tell("c.stage.view.eye")
            width_m, height_m = (side * GEOMETRY.voxel_edge_m for side in (WIDE, HIGH))
            assert 0 < x < width_m and 0 < y < width_m and (ceiling or 0 < z < height_m), (name, x, y, z)
        assert [said for said in console.errors if "403" not in said] == []


@pytest.mark.usefixtures("without_marks")
def test_a_mark_by_a_click_is_on_another_screen_with_its_pin_and_may_be_changed_and_taken_out(
    desk: Console, tokens: dict[str, str], chromium: Browser, room: Room
) -> None:
    with seen_by("reader", tokens, chromium, room) as other:
        page = desk.page
        page.get_by_role("button", name="Mark place").click()
        desk.click_about([(0, 0)])
        dialog = page.get_by_role("dialog", name="Mark this place")
        dialog.get_by_label("Name").fill(HOSTILE)
        dialog.get_by_label("Kind").fill("person")
        dialog.get_by_label("Note").fill("moves its arm")
        assert serious(desk, "a mark is made") == []
        dialog.get_by_role("button", name="Save").click()
        dialog.wait_for(state="detached")
        other.until("c.findings.marks.all.length === 1", "the mark is on the other screen")
        other.page.get_by_role("log").get_by_role("button", name=f"furnace-operator marked “{HOSTILE}”").wait_for()
        rows(other).filter(has_text=HOSTILE).get_by_role("button").click()
        rows(other).get_by_text("moves its arm").wait_for()
        rows(other).get_by_text("person by furnace-operator").wait_for()
        other.page.locator(".pin[data-state=mark]").wait_for()
        assert other.page.locator("img").count() == 0
        # Who may only look is not offered anything else, and is refused.
        for name in ("Mark place", "Edit …", "Take out"):
            assert other.page.get_by_role("button", name=name, exact=True).locator("visible=true").count() == 0
        posted = (
            "fetch(`maps/furnace/main/marks`, {method: 'POST', body: '{}', headers: {Authorization: `Bearer ${a[0]}`}})"
        )
        assert other.tell(f"{posted}.then((r) => r.status)", tokens["reader"]) == 403
        rows(desk).filter(has_text=HOSTILE).get_by_role("button").first.click()
        rows(desk).get_by_role("button", name="Edit …").click()
        dialog = page.get_by_role("dialog", name="Edit this mark")
        dialog.get_by_label("Name").fill("person at the door")
        dialog.get_by_role("button", name="Save").click()
        other.page.get_by_text("person at the door").first.wait_for()
        rows(desk).filter(has_text="person at the door").get_by_role("button").first.click()
        rows(desk).get_by_role("button", name="Take out").click()
        other.until("c.findings.marks.all.length === 0", "it is gone from the other screen")
        assert desk.errors == []


@pytest.mark.usefixtures("without_marks")
def test_what_one_operator_saw_or_dismissed_is_so_on_all_screens_until_it_is_much_hotter(
    desk: Console, tokens: dict[str, str], chromium: Browser, room: Room
) -> None:
    assert findings(desk, "state") == ["new"] * 4
    cool = desk.tell(CELSIUS)
    with seen_by("reader", tokens, chromium, room) as other:
        rows(desk).nth(0).get_by_role("button").first.click()
        rows(desk).get_by_role("button", name="Seen").click()
        desk.until("c.findings.all[3].state === 'seen'", "it is seen")
        rows(desk).nth(0).get_by_role("button").first.click()
        rows(desk).get_by_role("button", name="Dismiss").click()
        states = "c.findings.all.map((one) => one.state).join()"
        other.until(f"{states} === 'new,new,seen,dismissed'", "the other screen says so, too")
        assert rows(other).count() == 3
        other.page.get_by_text("1 dismissed.").wait_for()
        assert other.page.locator(".pin").count() == 3
        # A lamp that burns is no lamp that was dismissed.
        lamp, kelvin = SPOTS["lamp"]
        with room.api as api:
            commit = commit_of(dict.fromkeys(lamp, kelvin + 60), 1)
            api.push(FURNACE, commit)
            other.until(f"{states} === 'new,new,new,seen'", "it is new again")
            news = other.page.get_by_role("log")
            news.get_by_role("button", name="mole mapped 1 cell").wait_for()
            assert "New hot spot" not in news.inner_text(), "it is one that is known"
            api.retract(FURNACE, commits=[str(commit.id)]) if False else None
        desk.until(f"{states} === 'new,new,new,seen'", "it is new again here")
        rows(desk).nth(3).get_by_role("button").first.click()
        rows(desk).get_by_role("button", name="Make new again").click()
        other.until(f"{states} === 'new,new,new,new'", "the word is out")
        with room.api as api:
            api.retract(FURNACE, Retract(commits=[str(commit.id)]))
        desk.until(f"{CELSIUS} === {cool}", "the lamp is out")
    assert desk.errors == []


@pytest.mark.usefixtures("without_marks")
def test_findings_leave_as_a_table_and_as_geojson_in_the_maps_frame(desk: Console, room: Room) -> None:
    with room.api as api:
        text = MarkText(kind="door", name="=1+1", place_m=(1.0, 0.5, 1.25), note='two "lines"\nof it')
        api.put_mark(FURNACE, MarkRequest(mark=text))
    desk.until(f"c.findings.all.length === {len(SPOTS) + 1}", "the mark is here")
    files = {}
    for name in ("CSV", "GeoJSON"):
        with desk.page.expect_download() as coming:
            desk.page.get_by_role("button", name=name, exact=True).click()
        files[name] = coming.value.path().read_text(encoding="utf-8")
    table = list(csv.DictReader(io.StringIO(files["CSV"], newline="")))
    assert [float(row["number"]) for row in table] == [1, 2, 3, 4, 5]
    door = next(row for row in table if row["kind"] == "door")
    assert (door["name"], door["note"], door["author"]) == ("'=1+1", 'two "lines"\nof it', "admin")
    assert [float(door[f"{axis}_m"]) for axis in "xyz"] == [1.0, 0.5, 1.25]
    features = json.loads(files["GeoJSON"])["features"]
    assert [feature["geometry"]["coordinates"] for feature in features] == [
        [float(row[f"{axis}_m"]) for axis in "xyz"] for row in table
    ]


def test_an_alarm_is_seen_and_in_the_title_until_it_is_quiet(desk: Console) -> None:
    page = desk.page
    hot = max(findings(desk, "celsius"))
    page.get_by_text("What counts, and alarm").click()
    page.get_by_label("Alarm from").fill("70")
    page.keyboard.press("Enter")
    banner = page.get_by_role("alert")
    banner.get_by_text(f"{hot:.1f} °C").wait_for()
    assert page.title().startswith("⚠")
    assert serious(desk, "an alarm") == []
    banner.get_by_role("button", name="Show").click()
    desk.until(LANDED, "the eye is there")
    banner.get_by_role("button", name="Quiet").click()
    banner.wait_for(state="hidden")
    assert not page.title().startswith("⚠")
    page.get_by_label("Alarm from").fill("")
    page.get_by_label("Hot spots from").fill("60")
    page.keyboard.press("Enter")
    desk.until("c.findings.all.every(({ celsius }) => celsius >= 60)", "cooler ones are no findings")
    page.get_by_label("Hot spots from").fill("30")
    page.keyboard.press("Enter")
    desk.until(f"c.findings.all.length === {len(SPOTS)}", "all are back")


def test_a_reload_keeps_what_is_measured_and_chosen_and_back_undoes_the_flight(desk: Console) -> None:
    page = desk.page
    page.keyboard.press("Escape")
    desk.tell("c.camera.home()")
    desk.tell("c.findings.choose(null)")
    desk.tell("a[0].forEach((p) => c.measure.add(c.stage.controls.target.clone().set(...p)))", CORNERS)
    desk.settled()
    before = desk.tell("c.stage.view")
    rows(desk).nth(1).get_by_role("button").click()
    desk.until(LANDED, "the eye is there")
    desk.settled()
    desk.until("/find=/.test(location.hash) && location.href === c.address", "the address is that of the view")
    measured = page.get_by_role("region", name="Measure")
    words, there = measured.inner_text(), desk.tell("c.stage.view")
    assert "m³" in words
    page.reload()
    desk.settled()
    desk.until("c.findings.all.some(({ id }) => id === c.findings.chosen)", "it is chosen still")
    assert rows(desk).nth(1).get_by_role("button").first.get_attribute("aria-pressed") == "true"
    for part in ("eye", "target"):
        assert desk.tell("c.stage.view")[part] == pytest.approx(there[part], abs=0.011), "no flight again"
    measured.get_by_text("m³").wait_for()
    assert measured.inner_text() == words
    page.go_back()
    desk.until("c.findings.chosen === null", "Back is followed")
    desk.settled()
    for part in ("eye", "target"):
        assert desk.tell("c.stage.view")[part] == pytest.approx(before[part], abs=0.011)
    assert desk.tell("c.measure.points.length") == len(CORNERS)
    measured.get_by_role("button", name="Clear").click()
    desk.until("!/points=/.test(c.address)", "nothing is measured")


def test_a_thousand_marks_are_dots_and_the_first_of_them_pins(desk: Console) -> None:
    places = [list(place) for place in itertools.product(range(10), repeat=3)]
    told = """(c.findings.marks.hear(a[0].map((place, n) => ({ key: `mole.0123456789abcdef.9:${n}`,
      mark: { kind: "note", name: `note ${n}`, place_mm: place.map((each) => 300 * each), time_ms: n } })), []), 0)"""
    desk.tell(told, places)
    desk.until("c.findings.all.length > 1000", "marks are findings")
    desk.until("document.querySelectorAll('.pin').length === 40", "the first are pins")
    assert desk.tell("c.findings.pins.dots.geometry.getAttribute('position').count") == 1000 + len(SPOTS) - 40
    assert rows(desk).count() == 100
    desk.tell("(c.findings.marks.hear([], ['mole.0123456789abcdef.9']), 0)")
    desk.until(f"c.findings.all.length === {len(SPOTS)}", "they are gone")
