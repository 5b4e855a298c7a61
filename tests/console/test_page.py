"""The operator's page in a real browser, over a real server with a room that robots mapped.

The tests go on with one tab, in the order in which an operator would: in, look, ask, watch, take out, lose the link.
"""

import gzip
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import LOADED_MACHINE, VIEW, Console, tab
from tests.console.casting import occupied, picks_met_first
from tests.console.room import GEOMETRY, MAP, Room

from cairn_server.http.routes.console import STATIC

pytestmark = pytest.mark.browser

PAGE_GZIP_BYTES_MAX = 250_000
FIRST_PICTURE_BYTES_MAX = 500_000
BYTES_PER_VOXEL_MAX = 5
PICKS = 50
UPDATES = 200
HEAP_BYTES_MAX = 1_000_000
"""What the page may hold more after so many updates: were anything of a cell kept, it would be ten times that."""
UPDATE = """async ([times]) => {
  const { cells, stage } = window.cairn.console;
  const cell = cells.all.get("0,0,0");
  const step = () => new Promise((resolve) => setTimeout(resolve, 1));
  for (let n = 0; n < times; n++) {
    cell.dirty = true;
    cell.etag = '"as it was before"';
    cells.fetchMore();
    while (cell.dirty || cell.busy) await step();
  }
  cell.freshMs = 0;
  const { frames } = stage;
  for (stage.draw(); stage.frames === frames; ) await step();
  const { memory, programs } = stage.renderer.info;
  return [memory.geometries, memory.textures, programs.length, document.querySelectorAll("*").length];
}"""


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
        found = tab(context, room)
        yield found


def test_the_page_is_small() -> None:
    files = [path for path in STATIC.rglob("*") if path.suffix in (".html", ".js", ".css", ".svg")]
    assert sum(len(gzip.compress(path.read_bytes(), 9)) for path in files) <= PAGE_GZIP_BYTES_MAX


def test_a_stranger_logs_in_and_sees_the_map(console: Console) -> None:
    console.open()
    console.log_in("not-a-token-of-this-server")
    console.page.get_by_role("alert").get_by_text("token").wait_for()
    console.errors.clear()  # the browser tells of each 401
    start_s = time.monotonic()
    console.log_in()
    console.until("c && c.cells.firstPictureMs !== null", "the first picture")
    assert time.monotonic() - start_s < 2 * LOADED_MACHINE
    assert console.tell("window.cairn.api.received") <= FIRST_PICTURE_BYTES_MAX
    console.settled()
    assert console.picture().std() > 10
    assert console.errors == []


def test_all_of_the_map_is_drawn_voxel_by_voxel(console: Console, room: Room) -> None:
    drawn = console.tell("[...c.cells.all.values()].map((cell) => [cell.key, cell.depth, cell.count])")
    assert {depth for _, depth, count in drawn if count} == {GEOMETRY.depth}
    voxels = occupied(room)
    assert sum(count for *_, count in drawn) == len(voxels.numbers)
    assert console.tell("window.cairn.api.received") < FIRST_PICTURE_BYTES_MAX
    assert console.tell("window.cairn.api.received") <= 2 * BYTES_PER_VOXEL_MAX * len(voxels.numbers)


def test_what_is_picked_is_what_a_ray_meets_first(console: Console, room: Room) -> None:
    size = console.tell("[c.stage.canvas.clientWidth, c.stage.canvas.clientHeight]")
    places = np.random.default_rng(3).integers(0, size, (4 * PICKS, 2))
    assert picks_met_first(console, occupied(room), GEOMETRY, places) >= PICKS


def test_a_click_tells_the_servers_own_numbers_and_who_saw_it(console: Console, room: Room) -> None:
    voxels = occupied(room)
    console.tell("c.camera.top()")
    console.settled()
    middle = console.page.locator(".host canvas").bounding_box()
    assert middle is not None
    with console.page.expect_response(lambda answer: "/main/voxels/" in answer.url) as asked:
        console.page.mouse.click(middle["x"] + middle["width"] / 2, middle["y"] + middle["height"] / 2)
    told = asked.value.json()
    (row,) = np.nonzero((voxels.numbers == told["voxel"]).all(axis=1))[0]
    assert [told["hits"], told["misses"]] == voxels.counts[row].tolist()
    assert told["probability"] == pytest.approx(voxels.probability[row], abs=1e-6)
    heat = next(channel for channel in told["channels"] if channel["kind"] == "temperature")
    if heat["weight"]:
        assert heat["mean"] == pytest.approx([voxels.temperature_k[row]], abs=1e-3)
    assert sum(commit["hits"] for commit in told["commits"]) == told["hits"]
    assert {commit["id"] for commit in told["commits"]} <= set(room.commits)
    panel = console.page.get_by_role("region", name="Voxel")
    panel.get_by_text("Who saw it").wait_for()
    assert ",".join(map(str, told["voxel"])) in panel.inner_text()


def test_another_colouring_asks_nothing_of_the_server_and_looks_otherwise(console: Console) -> None:
    console.page.keyboard.press("h")
    console.settled()
    console.requests.clear()
    pictures = {}
    for key, field in enumerate(["colour", "temperature", "probability", "height", "age", "robot"], start=1):
        console.page.keyboard.press(f"Shift+{key}")
        console.settled()
        pictures[field] = console.picture()
        assert console.page.locator(f'[data-field="{field}"]').get_attribute("aria-pressed") == "true"
    # Who is behind, and who asks to be let in, is asked for every ten seconds, whatever is looked at.
    # A browser looks up the page's icon in its cache with each change of the address.
    by_the_clock = ("/branches", "/keys", "/robots", ".svg")
    assert [url for url in console.requests if not url.endswith(by_the_clock)] == []
    for field in ("temperature", "probability", "height", "robot"):
        assert np.abs(pictures[field].astype(int) - pictures["colour"]).mean() > 3, field
    console.page.keyboard.press("Shift+1")


@pytest.mark.parametrize(("slider", "way"), [("Ceiling", 1), ("Floor", -1)])
def test_ceiling_and_floor_hide_what_is_beyond_them(console: Console, slider: str, way: int) -> None:
    farthest = f"Math.max(...a[0].map(([x, y]) => {way} * (c.picker.at(x, y)?.centre.z ?? {-9 * way})))"
    places = [[x, y] for x in range(200, 700, 60) for y in range(150, 500, 50)]
    whole = console.tell(farthest, places)
    console.page.get_by_label(slider).fill("100")
    console.settled()
    assert console.tell(farthest, places) < whole
    assert console.tell(farthest, places) <= way * console.tell(f"c.look.{slider.lower()}M")
    address = console.tell("c.address")
    console.page.get_by_label(slider).fill("200" if way > 0 else "0")
    assert f"{slider.lower()}=" in address
    assert f"map={MAP}" in address


def test_what_is_shown_is_what_is_saved(console: Console, room: Room) -> None:
    voxels = occupied(room)
    panel = console.page.get_by_role("region", name="Take away")
    console.page.get_by_label("Ceiling").fill("100")
    ceiling_m = console.tell("c.look.ceilingM")
    with console.page.expect_download() as saved:
        panel.get_by_role("button", name="NPZ").click()
    with np.load(saved.value.path()) as arrays:
        shown = (voxels.numbers[:, 2] + 0.5) * GEOMETRY.voxel_edge_m <= ceiling_m
        assert len(arrays["points"]) == shown.sum()
    assert 0 < shown.sum() < len(shown)
    panel.get_by_text(f"{MAP}.npz: ").wait_for()
    assert f"--ceiling={ceiling_m}" in panel.inner_text()
    console.page.get_by_label("Ceiling").fill("200")
    panel.get_by_label("Level").select_option(str(GEOMETRY.depth - 1))
    with console.page.expect_download() as saved:
        panel.get_by_role("button", name="PLY").click()
    nodes = len(np.unique(voxels.numbers // 2, axis=0))
    assert f"element vertex {nodes}\n".encode() in Path(saved.value.path()).read_bytes()
    panel.get_by_label("Level").select_option(str(GEOMETRY.depth))
    assert console.errors == []


def test_a_new_measurement_is_drawn_within_seconds(console: Console, room: Room) -> None:
    before = console.tell("c.cells.head")
    room.measure("scout", 3)
    seconds = console.until(f"c.cells.head > {before} && c.cells.waiting === 0", "the new commit is drawn")
    assert seconds < 3 * LOADED_MACHINE
    console.page.keyboard.press("h")  # all of it in the picture, else what lies beside it comes coarsely
    console.settled()
    assert console.tell("c.cells.drawn") == len(occupied(room).numbers)
    names = console.page.get_by_role("region", name="Robots").inner_text()
    assert "scout" in names
    assert "mole" in names


def test_who_follows_a_robot_sees_what_it_sees(console: Console, room: Room) -> None:
    picture = cv2.imencode(".png", np.full((30, 40, 3), 200, np.uint8))[1].tobytes()
    with room.api as api:
        api.put_view(MAP, "scout", picture)
    console.page.get_by_title("Follow scout").click()
    shown = console.page.get_by_alt_text("What scout sees")
    shown.wait_for()
    assert shown.evaluate("(image) => [image.naturalWidth, image.naturalHeight]") == [40, 30]
    drawn = console.page.get_by_alt_text("The map as scout would see it")
    drawn.wait_for()
    assert drawn.evaluate("(image) => image.naturalWidth") >= 320
    stale = console.page.get_by_role("region", name="Robots").get_by_text("amber borders")
    stale.wait_for()
    console.until("c.unseen.lines.geometry.attributes.position?.count > 0", "what it is missing is drawn")
    console.page.keyboard.press("Escape")
    shown.wait_for(state="hidden")
    console.until("c.unseen.lines.geometry.attributes.position.count === 0", "nobody is followed")
    drawn.wait_for(state="hidden")
    console.page.keyboard.press("h")
    console.settled()


def test_clicks_measure_lengths_and_areas(console: Console) -> None:
    console.page.keyboard.press("m")
    middle = console.page.locator(".host canvas").bounding_box()
    assert middle is not None
    x, y = middle["x"] + middle["width"] / 2, middle["y"] + middle["height"] / 2
    clicks = ((0, 0), (60, 0), (60, 50), (30, 20), (0, 50))
    for count, (right, down) in enumerate(clicks, start=1):
        console.page.mouse.click(x + right, y + down)
        if count < 3:
            continue
        corners = np.array(console.tell("c.measure.points.map((point) => point.toArray())"))
        assert corners.shape == (count, 3)
        length_m = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        area_m2 = np.linalg.norm(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)) / 2
        said = console.page.get_by_role("region", name="Measure").inner_text()
        assert f"{length_m:.2f} m" in said
        assert f"{area_m2:.2f} m²" in said
    console.page.get_by_role("region", name="Measure").get_by_role("button", name="Clear").click()
    console.page.locator(".host canvas").focus()
    console.page.keyboard.press("m")
    assert console.tell("[c.measure.isOn, c.measure.points.length]") == [False, 0]


def test_two_hundred_updates_of_a_cell_leave_nothing_behind(console: Console) -> None:
    console.settled()
    engine = console.page.context.new_cdp_session(console.page)

    def held_after(updates: int) -> tuple[list[int], float]:
        counts: list[int] = console.page.evaluate(UPDATE, [updates])
        engine.send("HeapProfiler.collectGarbage")
        heap = engine.send("Runtime.getHeapUsage")
        return counts, heap["usedSize"] + heap.get("backingStorageSize", 0)

    assert console.tell("c.cells.all.get('0,0,0').count") > 1000
    (first, first_bytes), (last, last_bytes) = held_after(UPDATES // 10), held_after(UPDATES)
    assert last == first
    assert last_bytes < first_bytes + HEAP_BYTES_MAX


def test_a_commit_is_taken_out_only_after_it_was_shown_and_confirmed(console: Console, room: Room) -> None:
    before = console.tell("c.cells.drawn")
    console.page.get_by_role("button", name=f"commit {room.commits[1]}").focus()
    console.page.keyboard.press("Enter")
    confirm = console.page.get_by_role("button", name="out for good")
    assert confirm.is_disabled()
    console.page.get_by_role("button", name="Show what that takes out").click()
    console.page.get_by_text("1 commit:").wait_for()
    confirm.click()
    console.page.get_by_text("Done: 1 taken out").wait_for()
    console.page.get_by_role("button", name="Close").click()
    console.until(f"c.cells.drawn !== {before}", "the map without the commit")
    console.settled()
    assert console.tell("c.cells.drawn") == len(occupied(room).numbers)


def test_a_span_of_a_robot_is_taken_out(console: Console, room: Room) -> None:
    before = len(occupied(room).numbers)
    with room.api as api:
        retracted = {entry.id for entry in api.log(MAP) if entry.kind == "-"}
    first = len(room.commits)
    room.measure("scout", 4)
    room.measure("scout", 5)
    console.until(f"c.strip.entries.size >= {first + 2 + len(retracted)}", "both are in the log")
    page = console.page
    page.get_by_role("button", name=f"commit {room.commits[first]}").focus()
    page.keyboard.press("Enter")
    preview, confirm = (page.get_by_role("button", name=name) for name in ("Show what", "out for good"))
    preview.click()
    page.get_by_text("1 commit:").wait_for()
    page.get_by_label("What", exact=True).select_option("later")
    assert confirm.is_disabled(), "that was not shown"
    preview.click()
    page.get_by_text("2 commits:").wait_for()
    assert page.locator("dialog .said li").all_inner_texts() == room.commits[first:]
    confirm.click()
    page.get_by_text("Done: 2 taken out").wait_for()
    page.get_by_role("button", name="Close").click()
    console.until(f"c.cells.drawn === {before}", "the map as it was before both")
    assert len(occupied(room).numbers) == before


def test_the_keys_are_listed_and_turn_the_view(console: Console) -> None:
    console.page.keyboard.press("?")
    console.page.get_by_role("dialog", name="Keys").wait_for()
    console.page.keyboard.press("Escape")
    eye = console.tell("c.stage.view.eye")
    console.page.locator(".host canvas").focus()
    console.page.keyboard.press("ArrowLeft")
    assert console.tell("c.stage.view.eye") != eye


def test_a_lost_server_is_said_and_a_new_start_goes_on(console: Console, room: Room) -> None:
    assert console.errors == []
    drawn = console.tell("c.cells.drawn")
    room.stop()
    console.page.get_by_text("No link: the map is as it was").wait_for()
    assert console.tell("c.cells.drawn") == drawn
    room.start()
    console.page.locator('.link[data-state="live"]').wait_for()
    room.measure("mole", 5)
    console.until(f"c.cells.drawn !== {drawn} && c.cells.waiting === 0", "a commit after the new start")
    console.page.keyboard.press("h")
    console.settled()
    assert console.tell("c.cells.drawn") == len(occupied(room).numbers)
