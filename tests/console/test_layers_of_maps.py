"""Layers on the page: each is chosen by its name, drawn as what it is, and shows the marks of its map."""

from collections.abc import Iterator
from itertools import product

import numpy as np
import pytest
from playwright.sync_api import Browser
from tests.console import ground
from tests.console.browsing import CHROMIUM, FLAGS, VIEW, Console, findings_of_axe, map_tab, tab
from tests.console.hot_room import GEOMETRY, commit_of
from tests.console.hot_room import room as warm_room
from tests.console.room import ADMIN_TOKEN, Room
from tests.fixtures.server.deadline import until
from tests.fixtures.server.pushes import pushed

from cairn_client.folders.map_folder import open_map
from cairn_map.commits.commit import Commit
from cairn_map.evidence.channels import class_colours, classes_channel
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import CellKey, Geometry, split_voxels
from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.mark_messages import MarkRequest, MarkText
from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

SITE = "site"
FINE, GROUND, THINGS = f"{SITE}.fine", f"{SITE}.ground", f"{SITE}.things"
CLASSES = Geometry(voxel_edge_um=80_000, depth=4, channels=(classes_channel(("wall", "chair")),))
SURE, UNSURE = 5, 1
"""Votes for a wall, and for a chair that one camera saw once."""
GROUND_SHOWN = """[...c.cells.all.values()].flatMap((cell) => Array.from({ length: cell.count }, (_, row) => {
  const { heightM, difficulty, slopeDeg, stepM } = c.ground.reading(cell, row);
  const [x, y] = [0, 1].map((axis) => cell.cell[axis] * 2 ** cell.depth + cell.bytes[12 * row + axis]);
  return [x, y, heightM, difficulty, slopeDeg, stepM, cell.depth];
}))"""
"""Column, height, difficulty, slope in degrees and step of each node."""
COLOURED = 1
"""Flag of nodes into which their ground is written: decode/pack.ts."""
IS_UNWRITTEN = f"(bytes) => bytes.every((byte, n) => n % 12 !== 7 || !(byte & {COLOURED}))"


def things_commit(n: int) -> Commit:
    """A wall, and a chair before it that hardly leads."""
    numbers = np.array([*product(range(12), [8], range(10)), *product(range(4, 8), range(2, 5), range(3))])
    votes = np.where(numbers[:, 1] == 8, SURE, UNSURE)
    is_wall = numbers[:, 1] == 8
    sums = np.stack([np.where(is_wall, votes, 0), np.where(is_wall, 0, votes), votes], axis=1)
    keys, places = split_voxels(numbers, CLASSES)
    counts = np.stack([np.full_like(votes, SURE), np.zeros_like(votes)], axis=1)
    cells = {
        CellKey(int(key)): packed_evidence(places[keys == key], counts[keys == key], sums[keys == key], CLASSES)
        for key in np.unique(keys)
    }
    return pushed(n, 0, geometry=CLASSES, cells=cells, scans=SURE, sensors=("tof", "left", "right"))


@pytest.fixture(scope="module")
def site(room: Room) -> Room:
    """A map with a mark, and three layers: of finer cubes, of the ground, and of classes."""
    with room.api as api:
        api.create_map(SITE, CreateMap(geometry=GEOMETRY))
        api.put_mark(SITE, MarkRequest(mark=MarkText(kind="door", name="north door", place_m=(1.0, 1.0, 1.0))))
        layers = {FINE: commit_of(warm_room(), 0), GROUND: ground.ground_commit(1), THINGS: things_commit(2)}
        for name, grid in ((FINE, GEOMETRY), (GROUND, ground.GEOMETRY), (THINGS, CLASSES)):
            api.add_layer(SITE, AddLayer(name=name.split(".")[1], geometry=grid))
            api.push(name, layers[name])
            mine = str(layers[name].id)
            until(lambda name=name, mine=mine: any(each.id == mine for each in api.log(name)), "the commit is folded")
    return room


@pytest.fixture(scope="module")
def console(site: Room, chromium: Browser) -> Iterator[Console]:
    with map_tab(chromium, site, f"#map={FINE}") as found:
        yield found


def chosen(console: Console, layer: str) -> None:
    """Choose a layer, and return when it is drawn."""
    console.page.get_by_role("combobox", name="Layer").select_option(layer)
    console.until(f"c.name === '{layer}'", "the layer is open")
    console.settled()


def test_a_layer_is_chosen_by_its_name_and_has_the_marks_of_its_map(console: Console) -> None:
    layer = console.page.get_by_role("combobox", name="Layer")
    assert layer.input_value() == FINE
    said = layer.locator("option").all_inner_texts()
    assert said == ["evidence: 0.08 m", "fine: 0.08 m", "ground: level, 0.20 m", "things: 3 classes, 0.08 m"]
    choice = console.page.get_by_role("combobox", name="Map")
    assert choice.input_value() == SITE
    assert SITE in choice.evaluate("(each) => [...each.options].map(({ value }) => value)")
    assert console.tell("c.cells.drawn") > 0
    console.until("c.findings.all.some(({ title }) => title.includes('north door'))", "the map's mark is listed")
    layer.select_option(SITE)
    console.page.get_by_role("heading", name="Nothing is in this map yet").wait_for()


def test_a_map_without_layers_has_no_choice_of_them(chromium: Browser, room: Room) -> None:
    with map_tab(chromium, room, f"#map={room.name}") as other:
        assert other.page.get_by_role("combobox", name="Layer").count() == 0


def test_a_level_is_drawn_as_the_ground_that_its_elevation_has(console: Console, site: Room) -> None:
    chosen(console, GROUND)
    console.until("c.ground.seen === c.cells.shows", "the ground is known")
    shown = np.array(console.tell(GROUND_SHOWN), dtype=np.float64)
    assert (shown[:, 6] == ground.GEOMETRY.depth).all(), "all is drawn to its voxels"
    truth = open_map(f"{site.url}/maps/{GROUND}", token=ADMIN_TOKEN).elevation()
    first = np.rint(np.array(truth.origin_m) / truth.edge_m - 0.5)
    lowest: dict[tuple[int, int], np.ndarray] = {}
    for row in shown[np.isfinite(shown[:, 2])]:
        column = int(row[0] - first[0]), int(row[1] - first[1])
        if column not in lowest or row[2] < lowest[column][2]:
            lowest[column] = row
    assert len(lowest) == ground.WIDE * ground.FAR == np.isfinite(truth.height_m).sum()
    at = tuple(np.array(list(lowest)).T[::-1])
    rows = np.array(list(lowest.values()))
    assert np.abs(rows[:, 2] - truth.height_m[at]).max() < 0.002
    slopes = np.degrees(truth.slope_rad[at])
    assert (np.isnan(rows[:, 4]) == np.isnan(slopes)).all()
    assert np.nanmax(np.abs(rows[:, 4] - slopes)) < 0.5
    assert np.abs(rows[:, 5] - truth.step_m[at]).max() < 0.005
    difficulty = np.minimum(truth.difficulty()[at], 2.55)
    is_clear = truth.obstacle_m[at] == 0
    assert np.abs(rows[:, 3] - difficulty)[is_clear].max() < 0.03
    # The kerb and the post are too much for a vehicle, and flat ground and the ramp are not.
    hard = {(int(x), int(y)) for x, y in rows[rows[:, 3] > 1][:, :2]}
    assert {(ground.KERB, 6), ground.POST} <= hard
    assert not {(9, 8), (ground.RAMP + 6, 6)} & hard
    # The deck of the bridge stays, and what one of eleven saw is no surface.
    flat = shown[shown[:, 0] < ground.RAMP]
    assert (flat[:, 2] > 1.7).sum() == len(ground.BRIDGE) * 6
    assert not ((flat[:, 2] > 1.1) & (flat[:, 2] < 1.3)).any()


def test_what_is_written_into_the_ground_is_of_the_moment_that_is_shown_alone(console: Console) -> None:
    """Moments at which a cell is the same share its bytes, as the server gave them."""
    chosen(console, GROUND)
    console.until("c.ground.seen === c.cells.shows", "the ground is known")
    drawn = console.tell(GROUND_SHOWN)
    # After the only commit nothing is another one.
    console.tell("c.time.show(4e9)")
    console.settled()
    console.tell("c.time.show(null)")
    console.settled()
    console.until("c.ground.seen === c.cells.shows", "the ground is known again")
    kept, cells = console.tell("[[...c.cells.past.views.values()], c.cells.all.size]")
    assert len(kept) == 2 * cells, "of each cell two moments"
    assert console.tell("c.cells.past.shares.size") == cells
    assert console.tell(f"[...c.cells.past.views.values()].every({IS_UNWRITTEN})")
    assert console.tell(GROUND_SHOWN) == drawn


def test_a_cell_that_is_unknown_at_a_moment_keeps_no_other_from_being_fetched_ahead(console: Console) -> None:
    chosen(console, GROUND)
    page = console.page
    first, *others = console.tell("(c.cells.past.forget(), [...c.cells.all.keys()])")
    ahead = "c.cells.lookAhead({ atS: 4e9, key: 'then' }).catch(({ kind }) => kind)"
    refusal = {"kind": "not_known", "title": "unknown", "detail": "that time is not kept apart"}
    views = f"**/cells/{first}.view?*"
    page.route(views, lambda route: route.abort())
    assert console.tell(ahead) == "unreachable"
    assert console.tell("c.cells.past.views.size") == 0, "a server that does not answer is asked once"
    page.unroute(views)
    page.route(views, lambda route: route.fulfill(status=409, json=refusal, content_type="application/problem+json"))
    assert console.tell(ahead) is None
    page.unroute(views)
    console.errors.clear()  # the browser reports both answers
    assert [name.split("/")[0] for name in console.tell("[...c.cells.past.views.keys()]")] == others


def test_a_plan_and_a_report_have_the_ground_that_was_found_after_the_cells_came(console: Console) -> None:
    chosen(console, GROUND)
    console.until("c.ground.seen === c.cells.shows", "the ground is known")
    console.until("c.plan.plan?.colours.some(Boolean)", "the plan has the ground")
    report = "c.plan.pictures(120, 80).map(({ canvas }) => canvas.toDataURL())"
    whole = console.tell(report)
    unwritten = f"""(() => {{
      for (const {{ bytes }} of c.cells.all.values()) {{
        for (let at = 7; at < bytes.length; at += 12) bytes[at] &= ~{COLOURED};
      }}
      c.ground.madeOf = new WeakMap();
      c.ground.seen = -1;
    }})()"""
    console.tell(f"({unwritten}, c.plan.madeOf = '', c.plan.nextMs = 0, c.plan.tick(), null)")
    console.until("c.plan.plan?.colours.some(Boolean)", "the plan is made again")
    console.tell(f"({unwritten}, null)")
    assert console.tell(report) == whole


def test_a_level_is_coloured_by_what_hinders_a_vehicle_and_asked_of_it(console: Console) -> None:
    chosen(console, GROUND)
    fields = console.page.get_by_role("group", name="Colour by").get_by_role("button").all_inner_texts()
    assert fields == ["Height", "Probability", "Age", "Robot", "Difficulty", "Slope", "Step"]
    console.page.get_by_role("button", name="Difficulty").click()
    legend = console.page.get_by_role("region", name="Legend")
    legend.get_by_role("heading", name="Difficulty for a usual vehicle").wait_for()
    legend.get_by_text("above 1").first.wait_for()
    assert "by=difficulty" in console.tell("c.address")
    console.ask_middle()
    voxel = console.page.get_by_role("region", name="Voxel", exact=True)
    voxel.get_by_text("Ground at").wait_for()
    voxel.get_by_text("largest step").wait_for()
    voxel.get_by_text("10 of 10 scans hit it").wait_for()
    console.page.keyboard.press("p")
    console.page.get_by_role("img", name="Plan from straight above").wait_for()
    assert findings_of_axe(console, "a level") == []
    console.page.keyboard.press("Escape")
    assert console.errors == []


def test_classes_have_a_legend_and_the_voxel_names_its_own(console: Console) -> None:
    chosen(console, THINGS)
    console.page.get_by_role("button", name="Class").click()
    legend = console.page.get_by_role("region", name="Legend")
    legend.get_by_role("heading", name="Class with the most votes").wait_for()
    assert legend.get_by_role("listitem").all_inner_texts() == ["wall", "chair", "other"]
    legend.get_by_text("unsure").wait_for()
    first = legend.get_by_role("listitem").first.locator(".flat").first
    wall, chair, _ = class_colours(3).tolist()
    assert first.evaluate("(e) => getComputedStyle(e).backgroundColor") == f"rgb({', '.join(map(str, wall))})"
    shown = console.tell(
        """[...c.cells.all.values()].flatMap(({ cell, bytes, count, depth }) => Array.from({ length: count },
          (_, row) => [bytes[12 * row + 1] + cell[1] * 2 ** depth, ...bytes.slice(12 * row + 4, 12 * row + 7)]))"""
    )
    pale = [round((part + 300) / 3) for part in chair]
    assert {tuple(rgb) for y, *rgb in shown if y == 8} == {tuple(wall)}
    assert {tuple(rgb) for y, *rgb in shown if y < 8} == {tuple(pale)}
    voxel = console.page.get_by_role("region", name="Voxel", exact=True)
    # From above, on the chair; then on the wall.
    for y, name in ((3.5, "chair (unsure)"), (8.5, "wall")):
        console.tell(f"c.stage.place({{ eye: [0.48, {y * 0.08 - 0.01}, 4], target: [0.48, {y * 0.08}, 0] }})")
        console.settled()
        console.page.locator(".host canvas").focus()
        console.page.keyboard.press("Enter")
        voxel.locator(".reading strong", has_text=name).wait_for()
        voxel.get_by_text("(5 votes" if name == "wall" else "(1 vote").first.wait_for()
    assert findings_of_axe(console, "classes") == []
    assert console.errors == []


def test_without_webgl_the_server_draws_the_level_by_what_hinders_a_vehicle(chromium: Browser, site: Room) -> None:
    blind = chromium.browser_type.launch(executable_path=CHROMIUM, args=[FLAGS[0], "--disable-3d-apis"])
    with blind.new_context(viewport=VIEW) as context:
        console = tab(context, site)
        console.open(f"#map={GROUND}")
        console.log_in()
        page = console.page
        page.get_by_role("heading", name="This browser cannot draw the map").wait_for()
        assert page.get_by_role("button", name="Colour").count() == 0
        pictures = set()
        for layer in ("Height", "Slope", "Step", "Difficulty"):
            page.get_by_role("button", name=layer).click()
            page.get_by_role("button", name=layer, pressed=True).wait_for()
            picture = page.get_by_role("img", name="The map: from above")
            picture.wait_for()
            assert picture.evaluate("(image) => image.naturalWidth") == 640
            pictures.add(picture.screenshot())
        assert len(pictures) == 4
        assert [said for said in console.errors if "401" not in said] == []
    blind.close()
