"""A picture that reads: rooms from above, heights over the floor, shape without colour, and a colour bar that stays."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import SMALL_VIEW, VIEW, Console, map_tab, tab
from tests.console.campus import make_copies
from tests.console.casting import Occupied, occupied
from tests.console.room import GEOMETRY, MAP, Room

pytestmark = pytest.mark.browser

KELVIN = 273.15
EDGE_M = GEOMETRY.voxel_edge_m
CUT_M = 2.2
"""Over the floor, where no roof is lower."""
PLACES = [[x, y] for x in range(60, 700, 12) for y in range(60, 620, 12)]
CENTRES = "a[0].map(([x, y]) => c.picker.at(x, y)?.centre.toArray() ?? null)"
HEATS = """a[0].map(([x, y]) => { const p = c.picker.at(x, y); if (!p) return null;
  const { bytes } = p.cell, at = 12 * p.row;
  return [bytes[at + 7] & 2, bytes[at + 10] + 256 * bytes[at + 11]]; })"""
"""Flag and hottest temperature: decode/pack.ts."""
NEARER = """a[0].map(([x, y]) => {
  const away = (right, down) => c.picker.at(x + right, y + down)?.point.distanceTo(c.stage.camera.position) ?? 1e3;
  return away(0, 0) - Math.min(...[-1, 0, 1].flatMap((right) => [-1, 0, 1].map((down) => away(right, down))));
})"""
"""Depth of each pixel less that of the nearest one around it, m."""
EDGES = 20
FLAT_MAX = 0.95
"""Least brightness that is left on a flat floor."""
OVER = (0xFF, 0x6A, 0xD5)
"""The same constant as in palettes.ts."""
TOWER, STOREY_CELLS = "tower", 1
"""A map of two rooms, one so many cells over the other: the roof of the lower one is the floor of the upper one."""
GROUND = (0x0E, 0x11, 0x16)
LINE = (0xFF, 0x3D, 0x7F)
"""Colour of measures."""


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room) -> Iterator[Console]:
    with map_tab(chromium, room, f"#map={MAP}") as found:
        yield found


@pytest.fixture(scope="module")
def voxels(room: Room) -> Occupied:
    return occupied(room)


def centres(console: Console) -> npt.NDArray[np.float64]:
    """(N, 3) centres of what is seen at places of the picture."""
    return np.array([each for each in console.tell(CENTRES, PLACES) if each])


def floor_m(voxels: Occupied) -> float:
    """Upper face of the layer with the most voxels of the lower half."""
    z = voxels.numbers[:, 2]
    layers, counts = np.unique(z[z < z.mean()], return_counts=True)
    return float((layers[counts.argmax()] + 1) * EDGE_M)


def test_a_fresh_page_shows_rooms_from_above(console: Console, voxels: Occupied) -> None:
    floor = floor_m(voxels)
    assert console.tell("c.heights.storeys.floorsM") == [pytest.approx(floor)]
    ceiling = console.tell("c.look.ceilingM")
    assert floor + 1.2 <= ceiling <= floor + CUT_M + 0.001
    assert not console.tell("c.look.cells")
    assert console.tell("c.grid.lines.visible") is False
    z = centres(console)[:, 2]
    assert z.max() <= ceiling + 1e-6
    # Floor, and furniture that is lower than a table.
    assert np.mean(z <= floor + 0.8) >= 0.25


def test_a_chip_undoes_the_cut_and_a_reload_keeps_that(console: Console, voxels: Occupied) -> None:
    page = console.page
    ceiling = console.tell("c.look.ceilingM")
    page.get_by_role("button", name=f"Ceiling off above {ceiling - floor_m(voxels):.1f} m: show it").click()
    console.settled()
    assert console.tell("c.look.ceilingM") is None
    assert centres(console)[:, 2].max() > ceiling
    console.until("location.hash.includes('ceiling=off')", "the address is kept")
    page.reload()
    console.settled()
    assert console.tell("c.look.ceilingM") is None
    page.get_by_role("button", name="Ceiling on: cut it off").click()
    console.settled()
    assert console.tell("c.look.ceilingM") == pytest.approx(ceiling)
    assert "ceiling" not in console.tell("c.address")


def test_heights_are_told_over_the_floor(console: Console, voxels: Occupied) -> None:
    page, floor = console.page, floor_m(voxels)
    said = page.locator("output[for=ceiling]").inner_text()
    assert float(said.removesuffix(" m")) == pytest.approx(console.tell("c.look.ceilingM") - floor, abs=0.006)
    console.tell("c.setField('height')")
    legend = page.get_by_role("region", name="Legend")
    legend.get_by_text("Height over the floor").wait_for()
    z = np.sort((voxels.numbers[:, 2] + 0.5) * EDGE_M)
    ends = [float(legend.get_by_label(f"{end} end").input_value()) for end in ("Lower", "Upper")]
    wanted = [z[int(0.02 * len(z))] - floor, z[int(0.99 * (len(z) - 1))] - floor]
    assert ends == pytest.approx(wanted, abs=0.051)
    page.locator(".host canvas").hover(position={"x": 400, "y": 330})
    page.locator(".pointer", has_text="over the floor").wait_for()


def legend_of(console: Console) -> tuple[list[str], str]:
    """Ends and words of the colour bar."""
    legend = console.page.get_by_role("region", name="Legend")
    ends = [legend.get_by_label(f"{end} end").input_value() for end in ("Lower", "Upper")]
    return ends, legend.inner_text()


def test_the_colour_bar_is_the_same_from_wherever_one_looks(
    console: Console, chromium: Browser, room: Room, voxels: Occupied
) -> None:
    console.tell("c.setField('temperature')")
    console.settled()
    ends, said = legend_of(console)
    hottest = re.search(r"hottest (\S+) °C", said)
    assert hottest, said
    assert float(hottest[1]) == pytest.approx(float(np.nanmax(voxels.temperature_k)) - KELVIN, abs=0.051)
    assert float(ends[1]) < float(hottest[1])
    with chromium.new_context(viewport=SMALL_VIEW, color_scheme="light") as context:
        other = tab(context, room)
        other.open(f"#map={MAP}&by=temperature&ceiling=0.5&eye=0.5,0.5,1.5&target=3,3,1")
        other.log_in()
        other.settled()
        assert legend_of(other)[0] == ends


def test_what_is_over_the_bar_has_the_colour_of_its_end(console: Console, voxels: Occupied) -> None:
    page = console.page
    console.tell("c.setField('temperature')")
    page.keyboard.press("t")
    middle_k = float(np.nanmedian(voxels.temperature_k))
    console.tell("(c.look.ranges.temperature = a[0], c.apply())", [middle_k - KELVIN - 0.5, middle_k - KELVIN])
    console.settled()
    seen = [(place, each) for place, each in zip(PLACES, console.tell(HEATS, PLACES), strict=True) if each]
    x, y = np.array([place for place, _ in seen]).T
    warm, steps = np.array([each for _, each in seen]).T
    kelvin, colours = 150 + 0.02 * steps, console.picture()[y, x].astype(int)
    hot = (warm > 0) & (kelvin > middle_k + 0.2)
    inside = (warm > 0) & (np.abs(kelvin - middle_k + 0.25) < 0.2)
    assert min(hot.sum(), inside.sum()) > 20
    red, green, blue = colours.T
    is_over = (np.abs(green / red - OVER[1] / OVER[0]) < 0.06) & (np.abs(blue / red - OVER[2] / OVER[0]) < 0.06)
    assert np.mean(is_over[hot]) > 0.9, "that of the block, as far as it is lit"
    assert np.mean(is_over[inside]) < 0.1
    page.get_by_label("Lower end").fill("90")
    page.get_by_label("Lower end").press("Enter")
    page.get_by_text("The lower end must be below the upper one.").wait_for()
    assert console.tell("c.look.ranges.temperature")[0] == pytest.approx(middle_k - KELVIN - 0.5)
    page.get_by_role("button", name="Locked").click()


def test_a_band_is_open_above_and_never_turned_round(console: Console) -> None:
    page = console.page
    page.get_by_label("Only").check()
    assert console.tell("c.look.band") == [30, None]
    assert "band=30,&" in console.tell("c.address") + "&"
    page.get_by_label("Band to").fill("20")
    page.get_by_label("Band to").blur()
    page.get_by_text("begins above its end").wait_for()
    assert console.tell("c.look.band") == [30, None]
    page.get_by_label("Band to").fill("")
    page.get_by_label("Band to").blur()
    page.get_by_text("begins above its end").wait_for(state="hidden")
    page.get_by_label("Only").uncheck()


def pictures(console: Console, look: str) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """The picture without shading by depth, and with it."""
    found = []
    for strength in (0, 1):
        console.tell(f"({look}, c.stage.dome.strength = {strength})")
        console.settled()
        found.append(console.picture())
    return found[0], found[1]


def test_shape_is_seen_without_colour(console: Console) -> None:
    page = console.page
    page.keyboard.press("w")
    page.get_by_label("Cubes").check()  # a pixel shows just what is picked there
    # One colour for all heights: only light is left.
    plain, shaded = pictures(
        console, "Object.assign(c.look, { field: 'height', ranges: { height: [-1e4, 1e4] } }), c.apply()"
    )
    light = shaded.sum(axis=2) / np.maximum(plain.sum(axis=2, dtype=float), 1)
    drawn = np.abs(plain.astype(int) - GROUND).max(axis=2) > 40
    assert np.median(light[drawn]) > 0.95, "most of the picture is as bright as it was"
    # In motion one pixel's light counts for four: edges are as dark, and flat faces as bright, but for their rims.
    console.tell("(c.stage.restsMs = performance.now() + 4000, c.stage.draw())")
    frames = console.tell("c.stage.frames")
    console.until(f"c.stage.frames > {frames}", "a frame in motion")
    moving = console.picture().sum(axis=2) / np.maximum(plain.sum(axis=2, dtype=float), 1)
    console.tell("(c.stage.restsMs = 0, c.stage.draw())")
    assert np.mean(np.abs(moving - light)[drawn] < 0.05) > 0.8
    assert moving[drawn].mean() == pytest.approx(light[drawn].mean(), abs=0.02)
    assert np.mean(moving[drawn] < 0.6) > 0.5 * np.mean(light[drawn] < 0.6)
    steps_m = []
    for which in (drawn & (light < 0.6), drawn & (light > 0.98)):
        places = np.argwhere(which)[:, ::-1]
        assert len(places) > 100
        some = np.random.default_rng(1).choice(places, EDGES)
        steps_m.append(np.minimum(console.tell(NEARER, some.tolist()), 2 * EDGE_M).mean())
    assert steps_m[0] > 3 * steps_m[1], "what is darker lies behind an edge, or in a hollow"
    console.tell("(delete c.look.ranges.height, c.setField('colour'))")
    page.get_by_label("Cubes").uncheck()
    page.locator(".host canvas").focus()
    page.keyboard.press("Escape")


def test_a_flat_floor_stays_as_bright_as_it_is(console: Console, voxels: Occupied) -> None:
    floor = floor_m(voxels)
    numbers = voxels.numbers[voxels.numbers[:, 2] == round(floor / EDGE_M) - 1]
    middle = (np.median(numbers[:, :2], axis=0) + 0.5) * EDGE_M
    console.tell(
        "c.stage.place(a[0])", {"eye": [*middle, floor + 1.8], "target": [middle[0], middle[1] + 0.001, floor]}
    )
    plain, shaded = pictures(console, "c.setField('height')")
    z = np.array([each[2] if each else np.inf for each in console.tell(CENTRES, PLACES)])
    x, y = np.array(PLACES)[np.abs(z - floor + EDGE_M / 2) < EDGE_M / 4].T
    assert len(x) > 50
    assert shaded[y, x].mean() >= FLAT_MAX * plain[y, x].mean()
    console.tell("c.setField('colour')")


def test_lines_are_drawn_over_the_shading(console: Console) -> None:
    page = console.page
    page.keyboard.press("h")
    console.settled()
    corners = [[300, 300], [420, 300], [420, 400]]
    console.tell("a[0].forEach(([x, y]) => { const p = c.picker.at(x, y); if (p) c.measure.add(p.point); })", corners)
    assert console.tell("c.measure.points.length") >= 2
    plain, shaded = pictures(console, "0")
    lines = [(each == LINE).all(axis=2) for each in (plain, shaded)]
    assert lines[0].sum() > 50
    assert (lines[0] == lines[1]).all()
    assert (plain != shaded).any(), "the rest is shaded"
    console.tell("c.measure.clear()")
    assert console.errors == []


def test_a_storey_is_shown_alone(chromium: Browser, room: Room, voxels: Occupied) -> None:
    rise_m = STOREY_CELLS * EDGE_M * 2**GEOMETRY.depth
    floor = floor_m(voxels)
    with room.api as api, chromium.new_context(viewport=VIEW) as context:
        make_copies(api, MAP, TOWER, steps=[(0, 0, 0), (0, 0, STOREY_CELLS)])
        tower = tab(context, room)
        tower.open(f"#map={TOWER}")
        tower.log_in()
        tower.settled()
        tower.until("c.heights.storeys.floorsM.length === 2", "both floors are found")
        assert tower.tell("c.heights.storeys.floorsM") == pytest.approx([floor, floor + rise_m])
        assert floor + rise_m + 1.2 <= tower.tell("c.look.ceilingM") <= floor + rise_m + CUT_M + 0.001
        tower.page.get_by_role("button", name="Lowest").click()
        tower.settled()
        z = centres(tower)[:, 2]
        assert floor - 0.3 - 1e-6 <= z.min() < floor < z.max() <= floor + CUT_M + 1e-6
        tower.page.get_by_role("button", name=f"+{rise_m:.1f} m").click()
        tower.settled()
        assert centres(tower)[:, 2].min() >= floor + rise_m - 0.3 - 1e-6
        tower.page.get_by_role("button", name="All storeys").click()
        assert tower.tell("c.look.floorM") is None
        api.delete_map(TOWER)
