"""The floor plan: what was seen of a storey, and what lies within it and was not, to the column."""

import itertools
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser
from tests.console.browsing import Console, findings_of_axe, map_tab
from tests.console.hot_room import COLD_K, GEOMETRY, commit_of
from tests.console.room import Room
from tests.fixtures.server.deadline import until

from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

HALL = "hall"
WIDE, HIGH = 32, 25
"""A hall without a roof, 2.56 m by 2.56 m inside and 2 m high: 8 cm a voxel."""
HOLE = set(itertools.product(range(10, 15), range(20, 24)))
"""Part of the floor that no robot saw."""
TABLE = set(itertools.product(range(20, 26), range(4, 9)))
KINDS = "[...c.plan.plan.kinds].reduce((sum, kind) => (sum[kind]++, sum), [0, 0, 0, 0, 0, 0])"
GAP, FLOOR, THING, WALL = 1, 2, 3, 4


def hall() -> dict[tuple[int, int, int], float]:
    places = set(itertools.product(range(WIDE), range(WIDE)))
    world = {(x, y, -1): COLD_K for x, y in places - HOLE - TABLE}
    world |= {(x, y, 9): COLD_K for x, y in TABLE}
    rim = {at for at in itertools.product(range(-1, WIDE + 1), repeat=2) if at not in places}
    return world | {(x, y, z): COLD_K for x, y in rim for z in range(-1, HIGH)}


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    with room.api as api:
        api.create_map(HALL, CreateMap(geometry=GEOMETRY))
        commit = commit_of(hall(), 0)
        api.push(HALL, commit)
        until(lambda: any(entry.id == str(commit.id) for entry in api.log(HALL)), "the hall is folded")
    with map_tab(chromium, room, f"#map={HALL}") as found:
        found.until("c.heights.storeys.floorsM.length === 1 && c.plan.plan?.gapsM2 > 0", "the storey has a plan")
        yield found


def test_each_column_of_a_storey_is_floor_thing_wall_or_a_gap_that_no_one_looked_into(console: Console) -> None:
    counts = console.tell(KINDS)
    rim = (WIDE + 2) ** 2 - WIDE**2
    assert counts[GAP] == len(HOLE)
    assert counts[THING] == len(TABLE), "a table hides its floor, and was seen"
    assert counts[WALL] == rim
    assert counts[FLOOR] == WIDE**2 - len(HOLE) - len(TABLE)
    area_m2 = GEOMETRY.voxel_edge_m**2
    assert console.tell("c.plan.plan.gapsM2") == pytest.approx(len(HOLE) * area_m2)
    assert console.tell("c.plan.plan.seenM2") == pytest.approx((sum(counts[FLOOR : WALL + 1])) * area_m2)


def test_the_plan_says_in_words_what_it_shows_and_a_click_flies_there(console: Console) -> None:
    page = console.page
    page.locator(".host canvas").focus()
    page.keyboard.press("p")
    region = page.get_by_role("region", name="Plan", exact=True)
    region.get_by_text(f"{len(HOLE) * GEOMETRY.voxel_edge_m**2:.1f} m² within it").wait_for()
    assert findings_of_axe(console, "plan") == []
    canvas = region.get_by_role("img")
    box = canvas.bounding_box()
    assert box
    canvas.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
    region.wait_for(state="hidden")
    console.settled()
    middle = WIDE * GEOMETRY.voxel_edge_m / 2
    assert console.tell("c.stage.view.target.slice(0, 2)") == pytest.approx([middle, middle], abs=0.1)
    assert console.errors == []


def test_the_ink_of_a_plan_of_rooms_is_found_without_a_look_at_any_cell(console: Console) -> None:
    """The page asks for it a few times a second."""
    reads = """(() => {
      const { cells } = c, { all } = cells;
      let count = 0;
      Object.defineProperty(cells, "all", { get: () => (count++, all), configurable: true });
      const { range } = c.appearance.planInk;
      Object.defineProperty(cells, "all", { value: all, configurable: true, writable: true, enumerable: true });
      return [range, count];
    })()"""
    assert console.tell(reads) == [[0, 1], 0]


def test_a_cell_without_room_in_the_picture_is_no_gap(console: Console) -> None:
    """Robots saw cells that the page leaves out for want of room."""
    before = console.tell("c.cells.budget")
    try:
        console.tell("(c.cells.budget = 1, c.moved = true)")
        console.until("c.cells.leftOut > 0 && c.plan.plan?.kinds.includes(5)", "cells are left out")
    finally:
        console.tell("(c.cells.budget = a[0], c.moved = true)", before)
        console.settled()


def test_a_profile_shows_a_table_and_a_volume_is_that_of_what_stands_on_the_floor(console: Console) -> None:
    """The floor's upper face is at 0; a table of 6 by 5 voxels ends 10 voxels over it."""
    edge_m = GEOMETRY.voxel_edge_m
    corners = [(18, 2), (28, 2), (28, 11), (18, 11)]
    console.tell("c.measure.switch()")
    try:
        for x, y in corners:
            console.tell("c.measure.add(c.stage.controls.target.clone().set(...a))", x * edge_m, y * edge_m, 0.0)
        panel = console.page.get_by_role("region", name="Measure")
        said = panel.inner_text()
        volume = 6 * 5 * 10 * edge_m**3
        assert f"{volume:.3f} m³" in said
        assert f"{10 * 9 * edge_m**2:.2f} m²" in said
        console.tell("(c.measure.clear(), null)")
        for x in (18, 28):
            console.tell("c.measure.add(c.stage.controls.target.clone().set(...a))", x * edge_m, 6.5 * edge_m, 0.0)
        panel.get_by_role("img", name=f"surfaces from 0.00 m to {10 * edge_m:.2f} m in the map").wait_for()
        console.settled()
        assert console.page.locator(".length").inner_text() == f"{10 * edge_m:.2f} m"
    finally:
        console.tell("(c.measure.clear(), c.measure.switch())")
