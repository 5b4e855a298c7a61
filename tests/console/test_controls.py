"""The controls that turn the view and the look: each does to the picture, or to the map, what it says."""

import numpy as np
import numpy.typing as npt
import pytest
from tests.console.browsing import Console
from tests.console.casting import first_met, occupied
from tests.console.conftest import Room
from tests.console.room import GEOMETRY

EYES_M = 1.6

ON_PICTURE = """c.cells.tightBoxes.flatMap(({ min, max }) => Array.from({ length: 8 }, (_, n) =>
  min.clone().set(n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z)
    .project(c.stage.camera).toArray().slice(0, 2)))"""
"""Corners of the boxes around what is drawn of each cell; the picture goes from -1 to 1."""
LET_GO = """() => {
  const { api, console: { team } } = window.cairn;
  const ask = api.ask.bind(api);
  api.ask = async (path, options) => {
    const answer = await ask(path, options);
    if (path.includes("/main/render")) {
      team.follow(null);
      team.tick("colour", 0);
      window.letGo = true;
    }
    return answer;
  };
}"""
"""Of the robot that is followed, when its picture came and is not on the page yet."""


def ahead(console: Console) -> npt.NDArray[np.float64]:
    """Unit vector along which the eye looks."""
    view = console.tell("c.stage.view")
    way = np.subtract(view["target"], view["eye"])
    return np.array(way / np.linalg.norm(way))


def test_the_camera_goes_where_its_buttons_say(console: Console) -> None:
    camera = console.page.get_by_role("region", name="Camera")
    camera.get_by_role("button", name="Top").click()
    console.settled()
    assert ahead(console)[2] < -0.99
    assert np.abs(console.tell(ON_PICTURE)).max() <= 1, "all of the map is in the picture"
    camera.get_by_role("button", name="All").click()
    console.settled()
    assert np.abs(console.tell(ON_PICTURE)).max() <= 1
    assert -0.9 < ahead(console)[2] < -0.1


def test_who_walks_stands_on_the_floor_and_looks_where_most_is_seen(console: Console, room: Room) -> None:
    views = []
    for _ in range(2):
        for key in ("h", "w"):
            console.page.keyboard.press(key)
            console.settled()
        views.append(console.tell("c.stage.view"))
    assert views[0] == views[1]
    eye, way = np.array(views[0]["eye"]), ahead(console)
    assert way[2] == pytest.approx(0, abs=1e-6), "level"
    edge_m = GEOMETRY.voxel_edge_m
    boxes = np.asarray(occupied(room).numbers * edge_m, np.float64)
    below = (np.abs(boxes[:, :2] + edge_m / 2 - eye[:2]) <= edge_m).all(axis=1)
    assert np.abs(boxes[below, 2] + edge_m - (eye[2] - EYES_M)).min() < 1e-6, "over something that is known"
    assert eye[2] - EYES_M < 2 * edge_m, "which is the floor"
    robots = np.array(console.tell("[...c.team.marks.values()].map((m) => m.position.toArray())"))
    assert np.linalg.norm(robots[:, :2] - eye[:2], axis=1).min() < 1
    mine = float(np.degrees(np.arctan2(way[1], way[0])))
    seen_m = [mean_sight(boxes, eye, heading) for heading in (mine, *np.arange(3.0, 360.0, 15.0).tolist())]
    assert seen_m[0] > 0.85 * max(seen_m)
    assert seen_m[0] > 1.2 * np.mean(seen_m[1:])


def mean_sight(boxes: npt.NDArray[np.float64], eye: npt.NDArray[np.float64], heading_deg: float) -> float:
    """How far one sees on the average within 30 degrees to the sides, and 25 up and down, m; into a hole: nothing."""
    edges = np.full((len(boxes), 1), GEOMETRY.voxel_edge_m)
    found = []
    for heading in np.radians(heading_deg + np.arange(-30, 31, 10)):
        for up in np.radians(np.arange(-25, 26, 10)):
            ray = np.array([np.cos(heading) * np.cos(up), np.sin(heading) * np.cos(up), np.sin(up)])
            n, _ = first_met(boxes, edges, eye, ray)
            found.append(0.0 if n is None else float(np.linalg.norm(boxes[n] - eye)))
    return float(np.mean(found))


def test_who_is_followed_stays_in_the_middle(console: Console) -> None:
    console.page.get_by_title("Follow scout").click()
    place = np.array(console.tell("c.team.marks.get('scout').position.toArray()"))
    view = console.tell("c.stage.view")
    assert view["target"] == pytest.approx(place)
    assert np.linalg.norm(np.subtract(view["eye"], place)) == pytest.approx(np.hypot(3, 2.2))
    told = console.tell("c.team.signs.get('scout')")
    pose = told["status"]["pose"]
    step = np.array([0.5, -0.25, 0.0])
    moved = told | {"status": told["status"] | {"pose": pose | {"t_map_rig": (place + step).tolist()}}}
    console.tell("c.team.hear(a[0])", moved)
    after = console.tell("c.stage.view")
    assert after["target"] == pytest.approx(place + step)
    assert after["eye"] == pytest.approx(view["eye"] + step)
    console.tell("c.team.hear(a[0])", told)
    console.page.locator(".host canvas").focus()
    console.page.keyboard.press("Escape")
    assert console.page.get_by_title("Follow scout").get_attribute("aria-pressed") == "false"


def test_a_robot_may_be_let_go_while_its_picture_comes(console: Console) -> None:
    console.page.evaluate(LET_GO)
    console.page.get_by_title("Follow scout").click()
    console.until("window.letGo && !c.team.fromPose.busy", "a picture came")
    console.settled()
    assert console.page.locator("figure.seen:visible").count() == 0
    assert console.errors == []
