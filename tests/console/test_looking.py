"""What is looked at looks as it is told: a band of temperatures, a legend whose ends are kept, as much as has room."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Browser, Route
from tests.console.browsing import VIEW, Console, tab
from tests.console.casting import occupied
from tests.console.room import GEOMETRY, Room
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import MOLE, pushed

from cairn_client.http.api import MapApi
from cairn_map.evidence.grid import cell_key
from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

KELVIN = 273.15
PLACES = [[x, y] for x in range(150, 560, 6) for y in range(80, 420, 6)]
"""Pixels of the canvas with nothing written over them; enough for any map that earlier tests leave in the room."""
PICKED_VOXELS = """a[0].map(([x, y]) => { const p = c.picker.at(x, y);
  return p?.isVoxel ? p.node.map((n, axis) => n + p.cell.cell[axis] * 2 ** p.depth) : null; })"""
BAND_C = (18.5, 40.0)
"""Of the room's surfaces most are colder, and a hot plate is hotter."""
SURE_K = 0.06
"""A view tells temperatures to a tenth; nearer to an end of the band than this either side is right."""
GREY_SPREAD_MAX = 40
"""Of red, green and blue outside of the band: an eighth of the palette's colour is left."""

STAIR, FIRST, NEXT, LAST, BEYOND, SCANS = "stair", (0, 0, 0), (1, 0, 3), (1, 0, 6), (1, 0, 9), 64
"""A map whose later cells lie higher than its first, and beside it; scans enough for its counts."""
SIDEWAYS = "&by=height&boxes=1&eye=0.2,-0.6,0.9&target=0.2,0.2,0.2"

BUDGET_SHARE, SLACK = 0.3, 1.15
"""Of the map's voxels; and how much more may be shown before cells are made coarser: scene/detail.ts."""
NEARER = 0.75
"""Voxels lie by so much nearer to the eye than coarser nodes, on the average; measured: 0.4 and 0.5."""
COARSE = GEOMETRY.depth - 3
SHOWN = """[...c.cells.all.values()].filter(({ count }) => count).map((cell) =>
  [cell.depth, cell.count, cell.box.distanceToPoint(c.stage.camera.position)])"""


def voxels_at(console: Console, places: list[list[int]]) -> dict[int, tuple[int, int, int]]:
    """Numbers on the lattice of the voxels in sight, by place."""
    found = console.tell(PICKED_VOXELS, places)
    return {n: (each[0], each[1], each[2]) for n, each in enumerate(found) if each}


def inside_of_faces(console: Console, places: list[list[int]]) -> dict[int, tuple[int, int, int]]:
    """As `voxels_at`, where the pixels around a place show the same voxel: at an edge its colour is blended."""
    seen = voxels_at(console, places)
    for right, down in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        left = list(seen)
        near = voxels_at(console, [[places[n][0] + right, places[n][1] + down] for n in left])
        seen = {n: seen[n] for at, n in enumerate(left) if near.get(at) == seen[n]}
    return seen


def colours_at(console: Console, places: list[list[int]]) -> npt.NDArray[np.int64]:
    """(N, 3) red, green, blue."""
    x, y = np.array(places).T
    return console.picture()[y, x].astype(np.int64)


def test_only_what_is_within_the_band_keeps_its_colour(console: Console, room: Room) -> None:
    page = console.page
    voxels = occupied(room)
    kelvin_of = dict(zip(map(tuple, voxels.numbers.tolist()), voxels.temperature_k, strict=True))
    page.get_by_label("Cubes").check()  # a pixel shows just what is picked there
    console.tell("c.findings.pins.element.style.display = 'none'")
    page.get_by_label("Cell borders").uncheck()
    page.get_by_label("Ceiling").fill("120")
    page.locator(".host canvas").focus()
    page.keyboard.press("Shift+2")
    page.keyboard.press("t")
    console.settled()
    seen = inside_of_faces(console, PLACES)
    places = [PLACES[n] for n in seen]
    kelvin = np.array([kelvin_of[voxel] for voxel in seen.values()])
    before = colours_at(console, places)
    for label, end in zip(("Band from, °C", "Band to, °C"), BAND_C, strict=True):
        page.get_by_label(label).fill(f"{end:g}")
    page.get_by_label("Only").check()
    console.settled()
    assert console.tell("c.look.band") == list(BAND_C)
    after = colours_at(console, places)
    low_k, high_k = (end + KELVIN for end in BAND_C)
    inside = (kelvin >= low_k + SURE_K) & (kelvin <= high_k - SURE_K)
    colder, hotter = kelvin < low_k - SURE_K, kelvin > high_k + SURE_K
    assert min(inside.sum(), colder.sum(), hotter.sum()) >= 10
    outside = np.isnan(kelvin) | colder | hotter
    assert np.mean((after == before).all(axis=1)[inside]) > 0.95
    assert np.mean((np.ptp(after, axis=1) <= GREY_SPREAD_MAX)[outside]) > 0.95
    assert np.mean((after != before).any(axis=1)[outside]) > 0.95
    page.get_by_label("Only").uncheck()
    console.settled()
    assert (colours_at(console, places) == before).all()
    console.tell("c.findings.pins.element.style.display = ''")
    page.get_by_label("Ceiling").fill("200")


def test_only_so_many_voxels_are_drawn_and_the_finest_are_where_the_eye_is(console: Console, room: Room) -> None:
    nothing = {"status": 200, "body": b"", "headers": {"Cairn-View-Depth": str(COARSE)}}
    console.page.route("**/main/views", lambda route: route.fulfill(**nothing))  # as if no view were ready
    console.requests.clear()
    console.page.reload()
    console.settled()
    console.page.unroute("**/main/views")
    asked = [url.rpartition("/cells/")[2] for url in console.requests if ".view?" in url]
    cells = console.tell("c.cells.all.size")
    first = [each.split(".view?depth=") for each in asked[:cells]]
    assert len({cell for cell, _ in first}) == cells, "all of the map comes before any of it comes finer"
    assert {int(depth) for _, depth in first} == {COARSE}
    assert {int(each.rpartition("=")[2]) for each in asked[cells:]} == {GEOMETRY.depth}
    whole = len(occupied(room).numbers)
    budget = int(BUDGET_SHARE * whole)
    assert console.tell("c.cells.drawn") == whole
    low, high = np.array(console.tell("[c.cells.tightBounds.min.toArray(), c.cells.tightBounds.max.toArray()]"))
    middle = (low + high) / 2
    for corner in (low, high):
        eye = corner + 0.5 * (corner - middle)
        # Plans are made when the eye moves.
        console.tell("(c.cells.budget = a[0], c.stage.place(a[1]))", budget, {"eye": [*eye], "target": [*middle]})
        console.settled()
        depth, count, distance_m = np.array(console.tell(SHOWN)).T
        assert 0.5 * budget < count.sum() <= SLACK * budget
        finest = depth == GEOMETRY.depth
        farness_m = [np.average(distance_m[which], weights=count[which]) for which in (finest, ~finest)]
        assert farness_m[0] < NEARER * farness_m[1]
    console.tell("c.cells.budget = 150000")


@pytest.fixture
def stair(chromium: Browser, room: Room) -> Iterator[tuple[Console, MapApi]]:
    """A page that shows one cell, from the side, by height."""
    with room.api as api, chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
        api.create_map(STAIR, CreateMap(geometry=SMALL))
        push_cell(api, 0, FIRST)
        found = tab(context, room)
        found.open(f"#map={STAIR}{SIDEWAYS}")
        found.log_in()
        found.settled()
        yield found, api


def push_cell(api: MapApi, n: int, cell: tuple[int, int, int]) -> None:
    cells = {cell_key(cell): surface_evidence(n, SMALL)}
    api.push(STAIR, pushed(n, 0, MOLE, cells=cells, scans=SCANS))
    until(lambda: len(api.log(STAIR)) == n + 1, "the commit is folded")


def heights(console: Console) -> list[float]:
    """The legend's ends."""
    legend = console.page.get_by_role("region", name="Legend")
    return [float(legend.get_by_label(f"{end} end").input_value()) for end in ("Lower", "Upper")]


def told_heights(room: Room) -> list[float]:
    """What the ends are to be: the server's heights, less 2 % below and 1 % above."""
    edge_m = SMALL.voxel_edge_m
    stair = Room(room.folder, room.port, name=STAIR)
    z = np.sort((occupied(stair).numbers[:, 2] + 0.5) * edge_m)
    low, high = z[int(0.02 * len(z))], z[int(0.99 * (len(z) - 1))]
    return [float(low), float(high)] if high - low > 0.1 else [float(low) - 0.5, float(high) + 0.5]


def test_a_legend_that_is_locked_keeps_its_ends_when_more_comes_into_sight(
    stair: tuple[Console, MapApi], room: Room
) -> None:
    console, api = stair
    page = console.page
    before = told_heights(room)
    assert heights(console) == pytest.approx(before, abs=0.051)
    seen = voxels_at(console, PLACES)
    assert len(seen) > 10
    places = [PLACES[n] for n in seen]
    colours = colours_at(console, places)
    page.get_by_role("button", name="Auto").click()
    console.until("c.look.ranges.height", "the legend is locked")
    push_cell(api, 1, NEXT)
    console.until("c.cells.all.size === 2", "the page hears of another cell")
    console.settled()
    after = told_heights(room)
    assert after[1] > before[1] + 0.5
    assert heights(console) == pytest.approx(before, abs=0.051)
    still = [n for n, voxel in voxels_at(console, places).items() if voxel == seen[PLACES.index(places[n])]]
    assert len(still) > 10
    assert (colours_at(console, places)[still] == colours[still]).all()
    page.get_by_role("button", name="Locked").click()
    console.settled()
    assert heights(console) == pytest.approx(after, abs=0.051)
    assert np.mean((colours_at(console, places)[still] != colours[still]).any(axis=1)) > 0.95
    push_cell(api, 2, LAST)
    console.until("c.cells.all.size === 3", "the page hears of one more")
    console.settled()
    assert heights(console) == pytest.approx(told_heights(room), abs=0.051), "it goes on to follow"
    assert heights(console)[1] > after[1] + 0.5
    page.get_by_role("button", name="Auto").hover()
    page.mouse.down()
    push_cell(api, 3, BEYOND)
    console.until("c.cells.all.size === 4", "the page hears of a fourth")
    console.settled()
    page.mouse.up()
    console.until("c.look.ranges.height", "a press on the button was a click, though the legend changed")


def test_a_map_is_shown_cell_by_cell_where_all_at_once_takes_long(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=VIEW) as context:
        console = tab(context, room)
        held: list[Route] = []
        console.page.route("**/main/views", lambda route: held.append(route))
        console.open()
        console.log_in()
        console.until("c && c.cells.firstPictureMs !== null", "the first picture")
        assert len(held) == 1
        console.settled()
        assert console.tell("c.cells.drawn") > 0
        held[0].abort()


def test_what_the_server_has_ready_is_shown_after_one_request(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=VIEW) as context:
        first = tab(context, room)
        first.open()
        first.log_in()
        first.settled()  # what was not ready is from now on
    with chromium.new_context(viewport=VIEW) as context:
        second = tab(context, room)
        asked: list[str] = []
        second.page.on("request", lambda request: asked.append(request.url))
        second.open()
        second.log_in()
        second.until("c && c.cells.firstPictureMs !== null", "the first picture")
        coarse = [url for url in asked if f".view?depth={COARSE}" in url]
        assert coarse == [] and sum(url.endswith("/main/views") for url in asked) == 1
        second.settled()
        assert second.tell("c.cells.drawn") > 0
