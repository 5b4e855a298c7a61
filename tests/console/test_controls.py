"""The controls that turn the view and the look: each does to the picture, or to the map, what it says."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.console.browsing import Console
from tests.console.casting import first_met, occupied
from tests.console.room import GEOMETRY, Room

pytestmark = pytest.mark.browser

EYES_M = 1.6
WALK_STEPS = 40
"""More than a room is long."""
STEPPED_ON_M, LOW_M = 0.5, 0.1
"""Over the floor what is higher is in the way; and more than the floor itself."""
WAY_M = 0.5
"""A step, and half of a body at its corners."""
WALKS = """[[0, 1], [0, -1], [1, 0], [-1, 0]].map(([right, forward]) => {
  c.stage.place(a[1]);
  return Array.from({ length: a[0] }, () => (c.walk(right, forward), c.stage.view.eye));
})"""
"""Directions of a walk from one place: ahead, back, right and left."""
NEAREST_M, BEFORE_M, FAR_M = 0.3, 0.1, float(np.hypot(3, 2.2))
"""Of the eye from who is followed, and from what would be in between."""

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
      team.tick("colour", 0, []);
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


def test_nothing_stands_between_the_eye_and_who_is_followed(console: Console, room: Room) -> None:
    console.page.keyboard.press("h")
    console.settled()
    depths = "[...c.cells.all.values()].filter(({ points }) => points).map(({ depth }) => depth)"
    assert set(console.tell(depths)) == {GEOMETRY.depth}, "each voxel is shown"
    boxes = np.asarray(occupied(room).numbers * GEOMETRY.voxel_edge_m, np.float64)
    told = console.tell("c.team.signs.get('scout')")
    place = np.array(told["status"]["pose"]["t_map_rig"])
    met = {}
    for heading in np.radians(np.arange(0, 360, 45) + 5):
        back = np.array([-3 * np.cos(heading), -3 * np.sin(heading), 2.2]) / FAR_M
        met[heading] = met_m(boxes, place, back)
        away = eye_of(console, told, place, heading) - place
        expected = max(met[heading] - BEFORE_M, NEAREST_M) if met[heading] < FAR_M else FAR_M
        np.testing.assert_allclose(away, expected * back, atol=0.002)
    heading = min(met, key=lambda heading: met[heading])
    assert NEAREST_M + BEFORE_M < met[heading] < FAR_M
    back = np.array([-3 * np.cos(heading), -3 * np.sin(heading), 2.2]) / FAR_M
    close = place + (met[heading] - 0.2) * back
    assert np.linalg.norm(eye_of(console, told, close, heading) - close) == pytest.approx(NEAREST_M, abs=1e-6)
    console.page.get_by_label("Ceiling").fill("0")
    away = eye_of(console, told, place, heading) - place
    assert np.linalg.norm(away) == pytest.approx(FAR_M), "what is not shown is not in the way"
    console.page.get_by_label("Ceiling").fill("200")
    console.tell("c.team.hear(a[0])", told)
    console.tell("c.team.follow(null)")


def met_m(boxes: npt.NDArray[np.float64], eye: npt.NDArray[np.float64], ray: npt.NDArray[np.float64]) -> float:
    """How far it is to the voxel that a ray meets first, m."""
    n, _ = first_met(boxes, np.full((len(boxes), 1), GEOMETRY.voxel_edge_m), eye, ray)
    if n is None:
        return float(np.inf)
    return float(np.minimum((boxes[n] - eye) / ray, (boxes[n] + GEOMETRY.voxel_edge_m - eye) / ray).max())


def eye_of(
    console: Console, told: dict[str, Any], place: npt.NDArray[np.float64], heading: float
) -> npt.NDArray[np.float64]:
    """Where the eye follows scout from, at a place and looking level, rad from +x to +y."""
    s, c = np.sin(heading / 2) * np.sqrt(0.5), np.cos(heading / 2) * np.sqrt(0.5)
    pose = told["status"]["pose"] | {"t_map_rig": place.tolist(), "q_map_rig": [-s, c, s, c]}
    console.tell("c.team.follow(null)")
    console.tell("c.team.hear(a[0])", told | {"status": told["status"] | {"pose": pose}})
    console.tell("c.team.follow('scout')")
    return np.array(console.tell("c.stage.view")["eye"])


def test_a_robot_may_be_let_go_while_its_picture_comes(console: Console) -> None:
    console.page.evaluate(LET_GO)
    console.page.get_by_title("Follow scout").click()
    console.until("window.letGo && !c.team.fromPose.busy", "a picture came")
    console.settled()
    assert console.page.locator("figure.seen:visible").count() == 0
    assert console.errors == []


def test_who_walks_goes_as_far_as_the_walls_let(console: Console, room: Room) -> None:
    page, edge_m = console.page, GEOMETRY.voxel_edge_m
    page.keyboard.press("h")
    page.keyboard.press("w")
    console.settled()
    start = console.tell("c.stage.view")
    page.keyboard.press("s")
    step = np.subtract(console.tell("c.stage.view.eye"), start["eye"])[:2]
    assert step @ ahead(console)[:2] < 0 and np.linalg.norm(step) > 0.1, "a step back, along a wall if there is one"
    corners = np.asarray(occupied(room).numbers * edge_m, np.float64)
    stopped = 0
    for path in np.array(console.tell(WALKS, WALK_STEPS, start)):
        assert min(away_from(corners, eye, STEPPED_ON_M) for eye in path) > 0, "never in a wall"
        if (path[-1] == path[-2]).all():
            stopped += 1
            # Where the next step leads down, what lies lower is in the way, too.
            assert away_from(corners, path[-1], LOW_M) <= WAY_M + edge_m, "something is in the way"
    assert stopped > 0
    assert ahead(console)[2] == pytest.approx(0, abs=1e-6), "still level"
    eye, way = console.tell("c.stage.view.eye"), ahead(console)
    page.keyboard.press("ArrowLeft")
    assert console.tell("c.stage.view.eye") == pytest.approx(eye, abs=1e-6), "who looks around stays where they are"
    assert np.degrees(np.arccos(ahead(console) @ way)) == pytest.approx(6, abs=0.1)
    page.keyboard.press("Escape")
    assert console.tell("[c.walker.isOn, c.stage.controls.enabled]") == [False, True]


def away_from(corners: npt.NDArray[np.float64], eye: npt.NDArray[np.float64], over_m: float) -> float:
    """Level distance from the middle of a body to the nearest voxel so high over the floor, m; its eyes are here."""
    half_m = GEOMETRY.voxel_edge_m / 2
    body = (corners[:, 2] + 2 * half_m > eye[2] - EYES_M + over_m) & (corners[:, 2] < eye[2])
    off = np.maximum(np.abs(corners[body, :2] + half_m - eye[:2]) - half_m, 0)
    return float(np.hypot(*off.T).min())


def test_back_undoes_a_flight_and_a_reload_keeps_the_view(console: Console) -> None:
    page = console.page
    console.tell("c.setField('height')")
    page.keyboard.press("t")
    console.settled()
    page.get_by_label("Floor").fill("40")
    above, floor = console.tell("c.stage.view.eye"), console.tell("c.look.floorM")
    page.locator(".host canvas").focus()
    page.keyboard.press("h")
    console.settled()
    assert console.tell("c.stage.view.eye") != above
    page.go_back()
    console.until(f"Math.abs(c.stage.view.eye[2] - {above[2]}) < 0.01", "the eye is above again")
    assert console.tell("c.look.floorM") == pytest.approx(floor, abs=0.006)
    page.reload()
    console.settled()
    assert console.tell("c.stage.view.eye") == pytest.approx(above, abs=0.006)
    assert console.tell("[c.look.field, c.look.floorM]") == ["height", pytest.approx(floor, abs=0.006)]
    assert "boxes" not in console.tell("c.address")
    page.get_by_label("Floor").fill("0")
    page.locator(".host canvas").focus()
    console.tell("c.setField('colour')")


def test_a_double_click_brings_the_eye_there(console: Console) -> None:
    page = console.page
    page.keyboard.press("h")
    console.settled()
    place = console.tell("c.picker.at(350, 320)?.point.toArray()")
    before = np.linalg.norm(np.subtract(console.tell("c.stage.view.eye"), place))
    page.locator(".host canvas").dblclick(position={"x": 350, "y": 320})
    console.settled()
    view = console.tell("c.stage.view")
    assert view["target"] == pytest.approx(place, abs=0.02)
    assert np.linalg.norm(np.subtract(view["eye"], place)) < 0.7 * before
