"""What the page shows is what is known: no cold where nothing was measured, ages in hours, old pictures called old."""

import re

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.console.browsing import Console
from tests.console.casting import occupied
from tests.console.room import GEOMETRY, MAP, Room

pytestmark = pytest.mark.browser

WARM = 2
"""Flag of a voxel whose temperature was measured: decode/pack.ts."""
GREY_SPREAD_MAX = 16
"""Largest difference of a bare surface's red, green and blue; the palette's coldest colour has 38 when shaded most."""
PLACES = [[x, y] for x in range(150, 560, 15) for y in range(80, 420, 15)]
PICKED_FLAGS = "a[0].map(([x, y]) => { const p = c.picker.at(x, y); return p ? p.cell.bytes[12 * p.row + 7] : -1; })"
SLOW_LINK_MS, EVERY_MS = 600, 100
SHOW_OFTEN = f"""() => {{
  const {{ api, console: c }} = window.cairn;
  const ask = api.ask.bind(api);
  api.ask = async (path, options) => {{
    await new Promise((resolve) => setTimeout(resolve, {SLOW_LINK_MS}));
    return ask(path, options);
  }};
  const told = c.team.signs.get("scout");
  window.showing = setInterval(() => c.team.hear({{ ...told, view_s: Date.now() / 1000 }}), {EVERY_MS});
}}"""


def test_what_has_no_temperature_is_grey_and_not_cold(console: Console) -> None:
    console.page.keyboard.press("Shift+2")
    console.page.get_by_label("Ceiling").fill("120")
    console.page.locator(".host canvas").focus()
    console.page.keyboard.press("t")
    console.settled()
    flags = np.array(console.tell(PICKED_FLAGS, PLACES))
    x, y = np.array(PLACES).T
    spread = np.ptp(console.picture()[y, x].astype(int), axis=1)
    is_bare, is_warm = (flags >= 0) & (flags & WARM == 0), (flags >= 0) & (flags & WARM != 0)
    assert min(is_bare.sum(), is_warm.sum()) > 30
    # A pixel beside an edge may be the neighbour's.
    assert np.mean(spread[is_bare] <= GREY_SPREAD_MAX) > 0.9
    assert np.mean(spread[is_warm] > GREY_SPREAD_MAX) > 0.9
    console.page.get_by_label("Ceiling").fill("200")
    console.page.locator(".host canvas").focus()


def test_ages_are_told_as_time_by_the_commits_own_clocks(console: Console, room: Room) -> None:
    with room.api as api:
        times = {entry.seq: entry.captured_s[1] for entry in api.log(MAP) if entry.captured_s}
    told = dict(console.tell("[...c.cells.all.values()].map(({ lm }) => [lm, c.cells.ageOf(lm)])"))
    assert len(set(told.values())) > 1
    for seq, age_s in told.items():
        when_s = times[max(entry for entry in times if entry <= seq)]  # a retract states no time
        assert age_s == pytest.approx(max(times.values()) - when_s)
    console.page.keyboard.press("Shift+5")
    legend = console.page.get_by_role("region", name="Legend")
    legend.get_by_text("before the newest measurement").wait_for()
    unit = re.search(r"Age by cell, (seconds|minutes)", legend.inner_text())
    assert unit
    highest = float(legend.get_by_label("Upper end").input_value()) * {"seconds": 1, "minutes": 60}[unit[1]]
    assert highest == pytest.approx(max(told.values()), abs=3)
    hours = console.tell(
        "(c.book.add([{ ...c.strip.entries.get(1), seq: 0, captured_s: [a[0], a[0]] }]), c.cells.ageOf(0))",
        max(times.values()) - 7200,
    )
    assert hours == pytest.approx(7200)


def test_the_hottest_place_is_the_servers(console: Console, room: Room) -> None:
    voxels = occupied(room)
    console.page.keyboard.press("h")
    console.settled()
    console.page.keyboard.press("x")
    said = console.page.locator(".flag").inner_text()
    found = re.fullmatch(r"Hottest: (\S+) °C at (\S+), (\S+), (\S+) m", said)
    assert found, said
    celsius, *place = map(float, found.groups())
    assert celsius + 273.15 == pytest.approx(np.nanmax(voxels.temperature_k), abs=0.15)
    corners = voxels.numbers * GEOMETRY.voxel_edge_m
    (row,) = np.nonzero((np.abs(corners + GEOMETRY.voxel_edge_m / 2 - place) < 0.011).all(axis=1))[0]
    assert voxels.temperature_k[row] == pytest.approx(celsius + 273.15, abs=0.15)


def test_a_probability_and_a_box_hide_the_rest_and_a_shared_link_shows_the_same(console: Console) -> None:
    console.page.keyboard.press("Shift+1")
    console.page.keyboard.press("t")
    console.settled()
    whole = _picked(console)
    # To two digits, as in the link, and down: some may be as sure as can be.
    least = float(np.floor(100 * np.median(whole[:, 3]) / 255) / 100)
    assert (whole[:, 3] < 255 * least).any()
    # Around a voxel that stays, whatever tests before this one took out of the map.
    likely, reach = whole[whole[:, 3] >= 255 * least], 0.3 * np.ptp(whole[:, :3], axis=0)
    low, high = likely[len(likely) // 2, :3] - reach, likely[len(likely) // 2, :3] + reach
    console.tell("(Object.assign(c.look, a[0]), c.apply())", {"minP": least, "clip": [low.tolist(), high.tolist()]})
    console.settled()
    part = _picked(console)
    assert 0 < len(part) < len(whole)
    assert (part[:, 3] >= 255 * least - 1).all()
    assert ((part[:, :3] >= low - 1e-6) & (part[:, :3] <= high + 1e-6)).all()
    console.page.keyboard.press("Shift+2")
    address, eye = console.tell("c.address"), console.tell("c.stage.view.eye")
    console.tell("(Object.assign(c.look, { minP: 0, clip: null }), c.setField('height'))")
    console.page.keyboard.press("h")
    console.page.evaluate("(address) => { location.href = address; }", address)
    console.until("c?.look.field === 'temperature'", "the link is followed")
    console.settled()
    assert console.tell("c.look.minP") == least
    assert np.array(console.tell("c.look.clip")) == pytest.approx(np.array([low, high]), abs=0.0051)
    assert console.tell("c.stage.view.eye") == pytest.approx(eye, abs=0.01)
    console.tell("(Object.assign(c.look, { minP: 0, clip: null }), c.setField('colour'))")


def test_a_commit_without_a_time_has_no_later_ones_to_take_out(console: Console) -> None:
    later = console.page.locator("#what option[value=later]")
    for captured_s, is_disabled in (([1.0, 2.0], False), (None, True)):
        console.tell("c.strip.onChoose({ ...c.strip.entries.get(c.cells.head), captured_s: a[0] })", captured_s)
        assert later.is_disabled() == is_disabled
        console.page.get_by_role("button", name="Close").click()
        console.page.locator("dialog.retract").wait_for(state="detached")


def test_pictures_that_come_faster_than_the_link_carries_them_are_shown_and_grow_old(
    console: Console, room: Room
) -> None:
    picture = cv2.imencode(".png", np.full((30, 40, 3), 90, np.uint8))[1].tobytes()
    with room.api as api:
        api.put_view(MAP, "scout", picture)
    console.until("c.team.signs.get('scout')?.view_s", "the server tells of the picture")
    console.page.get_by_title("Follow scout").click()
    console.page.evaluate(SHOW_OFTEN)
    console.page.get_by_alt_text("What scout sees").wait_for()
    console.page.evaluate("clearInterval(window.showing)")
    console.page.get_by_text(re.compile(r"scout saw this ([3-9]|\d\d) s ago")).wait_for()
    console.page.get_by_alt_text("The map as scout would see it").wait_for()


def _picked(console: Console) -> npt.NDArray[np.float64]:
    """Centre (m) and probability (in 1/255) of what lies under the places where there is something."""
    found = console.tell(
        "a[0].map(([x, y]) => { const p = c.picker.at(x, y);"
        " return p && [...p.centre.toArray(), p.cell.bytes[12 * p.row + 3]]; })",
        PLACES,
    )
    return np.array([each for each in found if each])
