"""The team as the server knows it: where each robot is and looks, its mode and lag, who is gone, and what is whose."""

import time
from collections.abc import Iterator
from email.utils import formatdate
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Route
from tests.console.browsing import Console, map_tab
from tests.console.room import ADMIN_TOKEN, Room
from tests.fixtures.map.made import SMALL, surface_evidence
from tests.fixtures.server.live import until
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed

from cairn_client.http.api import MapApi
from cairn_map.commits.commit import ScanPose
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.wire.messages import BranchInfo, CreateMap, MissingRequest, Register, Retract, RobotStatus

pytestmark = pytest.mark.browser

CREW = "crew"
FINCH, MAPLESS = "finch", "low-end"
PLACE = (0.1, 0.0, 0.5)
HALF = float(np.sqrt(0.5))
LOOKS_NORTH, LOOKS_SOUTH = (-HALF, 0.0, 0.0, HALF), (HALF, 0.0, 0.0, HALF)
"""Quaternions that turn the rig's z axis, along which cameras look, into +y and -y of the map."""
FROM_ABOVE = "&eye=0.1,-0.01,6&target=0.1,0,0.5"
"""North is up in the picture."""
GREY = (0x8B, 0x94, 0x9E)
LATER_S = 90
"""Longer than a robot may be quiet and still be online."""
SCANS = 64
"""Enough for the counts of `surface_evidence`."""
LAST = "c.cells.all.get('0,0,0')?.lm"
TOLD_COLOUR = """(c.cells.all.get('0,0,0').points.onBeforeRender(null, null, null, null, {}),
  c.cells.material.uniforms.uRobot.value.toArray())"""
"""Of the robot by which the cell is coloured, as the graphics card gets it."""
NEAR_PX = 100
"""The frustum is 0.9 m long, a metre 105 px."""
PROJECTED = """(() => {
  const { canvas, camera } = c.stage;
  const at = c.team.marks.get(a[0]).position.clone().fromArray(a[1]).project(camera);
  return [(at.x + 1) / 2 * canvas.clientWidth, (1 - at.y) / 2 * canvas.clientHeight];
})()"""


@pytest.fixture(scope="module")
def crew(room: Room) -> Iterator[MapApi]:
    """A map of wren's commits; mole has fetched one of them, and finch none."""
    with room.api as api:
        api.create_map(CREW, CreateMap(geometry=SMALL))
        modes = {MOLE.robot: "high-end", WREN.robot: MAPLESS, FINCH: "high-end"}
        for robot, mode in modes.items():
            incarnation = (WREN if robot == WREN.robot else MOLE).incarnation
            api.register(CREW, Register.model_validate({"robot": robot, "mode": mode, "incarnation": incarnation}))
            api.token = ADMIN_TOKEN
        push(api, 0)
        fetch_all(api)
        push(api, 1)
        push(api, 2)
        look(api, LOOKS_NORTH)
        yield api


def push(api: MapApi, n: int) -> None:
    api.push(CREW, pushed(n, n, WREN))
    until(lambda: len(api.log(CREW)) == n + 1, "the commit is folded")


def fetch_all(api: MapApi) -> None:
    """Mole says that it holds all."""
    held = MissingRequest(author=str(MOLE), cursor=api.map_info(CREW).cursor)
    assert list(api.missing(CREW, MOLE.robot, held))


def look(api: MapApi, q_map_rig: tuple[float, float, float, float]) -> None:
    """Mole tells where it is, and which way it looks."""
    now_s = time.time()
    pose = ScanPose(time_s=now_s, t_map_rig=PLACE, q_map_rig=q_map_rig)
    api.put_status(CREW, MOLE.robot, RobotStatus(time_s=now_s, pose=pose))


@pytest.fixture(scope="module")
def console(chromium: Browser, room: Room, crew: MapApi) -> Iterator[Console]:
    with map_tab(chromium, room, f"#map={CREW}{FROM_ABOVE}") as found:
        found.until("c.team.branches.length === 3", "the page knows the team")
        yield found


def told(api: MapApi, robot: str) -> BranchInfo:
    """What the server says of a robot."""
    return next(branch for branch in api.branches(CREW) if branch.branch == robot)


def lag_of(branch: BranchInfo) -> str:
    """A lag in words: sizes in thousands of bytes, with a digit after the point below ten of them."""
    assert branch.behind is not None
    assert branch.behind_bytes is not None
    assert branch.behind_bytes < 999_500
    kilobytes = branch.behind_bytes / 1000
    size = f"{branch.behind_bytes} B" if kilobytes < 1 else f"{kilobytes:.{1 if kilobytes < 10 else 0}f} kB"
    return f"{branch.behind} commit{'' if branch.behind == 1 else 's'} ({size}) behind"


def colour_of(console: Console, robot: str) -> npt.NDArray[np.int64]:
    """The robot's colour, as the dot before its name has it."""
    text = console.tell(
        'getComputedStyle(document.querySelector(`[data-robot="${a[0]}"] .dot`)).backgroundColor', robot
    )
    return np.array([int(part) for part in text.removeprefix("rgb(").removesuffix(")").split(",")])


def row_of(console: Console, robot: str) -> Locator:
    """What the panel says of a robot."""
    return console.page.locator(".robot", has=console.page.locator(f'[data-robot="{robot}"]'))


def drawn_in(console: Console, colour: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """(N, 2) pixels right of and below mole's place that have a colour, as far as its mark reaches."""
    console.settled()
    picture = console.picture().astype(np.int64)
    rows, columns = np.nonzero((np.abs(picture - np.asarray(colour)) <= 2).all(axis=2))
    middle = np.rint(console.tell(PROJECTED, MOLE.robot, PLACE)).astype(np.int64)
    off = np.stack([columns, rows], axis=1) - middle
    return off[np.abs(off).max(axis=1) <= NEAR_PX]


def test_how_each_robot_takes_part_and_how_far_it_is_behind_is_the_servers(console: Console, crew: MapApi) -> None:
    rows = {name: row_of(console, name) for name in (MOLE.robot, WREN.robot, FINCH)}
    for name, row in rows.items():
        row.locator(".mode").get_by_text(told(crew, name).mode, exact=True).wait_for()
    behind = told(crew, MOLE.robot)
    assert behind.cursor is not None
    missed = [entry for entry in crew.log(CREW) if entry.seq > cursor_from_text(behind.cursor).seq]
    assert (behind.behind, behind.behind_bytes) == (2, sum(entry.size_bytes for entry in missed))
    rows[MOLE.robot].get_by_text(lag_of(behind)).wait_for()
    rows[WREN.robot].get_by_text("keeps no map").wait_for()
    rows[FINCH].get_by_text("never fetched").wait_for()
    push(crew, 3)
    rows[MOLE.robot].get_by_text(lag_of(told(crew, MOLE.robot))).wait_for()
    fetch_all(crew)
    rows[MOLE.robot].get_by_text("level with the map").wait_for()
    assert told(crew, MOLE.robot).behind == 0


def test_a_robot_is_drawn_where_it_is_and_looks_and_grey_when_it_is_gone(console: Console, crew: MapApi) -> None:
    status = told(crew, MOLE.robot).status
    assert status is not None
    assert status.pose is not None
    assert console.tell("c.team.marks.get('mole').position.toArray()") == pytest.approx(status.pose.t_map_rig)
    colour = colour_of(console, MOLE.robot)
    # The dot of its label keeps the robot's colour, whoever is online.
    dots = "[...document.querySelectorAll('.label .dot')].map((dot) => (dot.style.visibility = a[0]))"
    console.tell(dots, "hidden")
    seen = {"north": drawn_in(console, colour)}
    look(crew, LOOKS_SOUTH)
    console.until("c.team.marks.get('mole').ahead.y < 0", "it turned round")
    seen["south"] = drawn_in(console, colour)
    for way, pixels in seen.items():
        down = pixels[:, 1] * (1 if way == "south" else -1)
        assert down.max() > 70, "it looks so far ahead"
        assert down.min() > -40, "and not back"
        assert np.linalg.norm(pixels, axis=1).min() < 5, "from where it is"
    assert len(drawn_in(console, GREY)) == 0
    row = row_of(console, MOLE.robot)
    row.get_by_text("online").wait_for()
    console.page.route(f"**/maps/{CREW}/**", later)
    console.tell("c.team.refresh()")
    row.get_by_text("offline").wait_for()
    row.get_by_text("seen 1 min ago").wait_for()
    console.page.locator(".label.offline", has_text="mole").wait_for()
    assert console.tell("c.team.marks.get('mole').position.toArray()") == pytest.approx(PLACE)
    grey, was = ({(x, y) for x, y in pixels.tolist()} for pixels in (drawn_in(console, GREY), seen["south"]))
    assert len(grey & was) > 0.9 * len(grey | was), "but for its label"
    assert len(drawn_in(console, colour)) == 0
    console.page.unroute(f"**/maps/{CREW}/**")
    console.tell(dots, "visible")
    look(crew, LOOKS_NORTH)
    row.get_by_text("online").wait_for()
    assert console.errors == []


def later(route: Route) -> None:
    """As if the server had heard of nobody for so long: its clock goes on, and what it tells is as it was."""
    answer = route.fetch()
    date = formatdate(time.time() + LATER_S, usegmt=True)
    route.fulfill(response=answer, headers={**answer.headers, "date": date})


def test_what_a_retract_leaves_has_the_colour_of_who_brought_it(console: Console, crew: MapApi) -> None:
    colours = {name: (colour_of(console, name) / 255).tolist() for name in (MOLE.robot, WREN.robot)}
    console.page.keyboard.press("Shift+6")
    commit = pushed(0, 0, MOLE, cells={KEYS[0]: surface_evidence(0, SMALL)}, scans=SCANS)
    crew.push(CREW, commit)
    console.until(f"c.book.robotAt({LAST}) === 'mole'", "mole added to the cell")
    console.settled()
    assert console.tell(TOLD_COLOUR) == pytest.approx(colours[MOLE.robot])
    crew.retract(CREW, Retract(commits=[str(commit.id)]))
    console.until(f"c.book.isOut({LAST}) && c.cells.all.get('0,0,0').held?.lm === {LAST}", "that is taken out")
    assert console.tell(TOLD_COLOUR) == pytest.approx(colours[WREN.robot])
    console.page.reload()
    console.settled()
    console.until(f"c.book.isOut({LAST}) && c.cells.all.get('0,0,0').held?.lm === {LAST}", "the page asks again")
    assert console.tell(TOLD_COLOUR) == pytest.approx(colours[WREN.robot])
    assert console.errors == []


def stand(api: MapApi, robot: str, place: tuple[float, float, float]) -> None:
    """A robot tells where it is."""
    now_s = time.time()
    pose = ScanPose(time_s=now_s, t_map_rig=place, q_map_rig=LOOKS_NORTH)
    api.put_status(CREW, robot, RobotStatus(time_s=now_s, pose=pose))


@pytest.mark.parametrize("place", [PLACE, (0.1, 2.6, 0.5)], ids=["middle", "upper edge"])
def test_labels_of_robots_at_one_place_stand_in_a_stack(
    console: Console, crew: MapApi, place: tuple[float, float, float]
) -> None:
    robots = (FINCH, MOLE.robot, WREN.robot)
    for robot in robots:
        stand(crew, robot, place)
        console.until(f"c.team.marks.get('{robot}')?.position?.y === {place[1]}", f"{robot} is there")
    console.settled()
    boxes = labels(console)
    assert set(boxes) == set(robots)
    host = console.page.locator(".host").bounding_box()
    assert host
    column = sorted(boxes.values(), key=lambda box: box["y"])
    for above, below in pairwise(column):
        assert 0 < below["y"] - above["y"] - above["height"] < 5, "next to each other, and none over another"
    assert column[0]["y"] >= host["y"]
    assert len({round(box["x"]) for box in column}) == 1, "beside where they are"
    own_y = column[0 if place[1] > PLACE[1] else -1]["y"]
    assert boxes[FINCH]["y"] == own_y, "the first by name stands at its own place"
    stand(crew, MOLE.robot, (place[0] - 1.5, place[1], place[2]))
    console.until(f"c.team.marks.get('mole').position.x < {place[0] - 1}", "mole goes away")
    console.settled()
    assert labels(console)[MOLE.robot]["y"] == pytest.approx(own_y, abs=1)


def labels(console: Console) -> dict[str, FloatRect]:
    """Where the labels are that are seen."""
    found = console.page.locator(".label:visible").all()
    return {label.inner_text(): box for label in found if (box := label.bounding_box())}
