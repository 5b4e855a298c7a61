"""The controls that turn the view and the look: each does to the picture, or to the map, what it says."""

import numpy as np
import numpy.typing as npt
import pytest
from tests.console.browsing import Console

ON_PICTURE = """c.cells.tightBoxes.flatMap(({ min, max }) => Array.from({ length: 8 }, (_, n) =>
  min.clone().set(n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z)
    .project(c.stage.camera).toArray().slice(0, 2)))"""
"""Corners of the boxes around what is drawn of each cell; the picture goes from -1 to 1."""


def ahead(console: Console) -> npt.NDArray[np.float64]:
    """Unit vector along which the eye looks."""
    view = console.tell("c.stage.view")
    way = np.subtract(view["target"], view["eye"])
    return np.array(way / np.linalg.norm(way))


def test_the_camera_goes_where_its_buttons_say(console: Console) -> None:
    camera = console.page.get_by_role("region", name="Camera")
    bounds = "[c.cells.tightBounds.min.toArray(), c.cells.tightBounds.max.toArray()]"
    low, high = np.array(console.tell(bounds))
    camera.get_by_role("button", name="Top").click()
    console.settled()
    assert ahead(console)[2] < -0.99
    assert np.abs(console.tell(ON_PICTURE)).max() <= 1, "all of the map is in the picture"
    camera.get_by_role("button", name="Walk").click()
    eye = np.array(console.tell("c.stage.view.eye"))
    assert ((eye > low) & (eye < high)).all(), "inside of the map"
    assert abs(ahead(console)[2]) < 1e-6, "level"
    stands = min(
        (np.array(place) for place in console.tell("[...c.team.marks.values()].map((m) => m.position.toArray())")),
        key=lambda place: float(np.linalg.norm(place - eye)),
    )
    assert eye - stands == pytest.approx(np.array([0, 0, 0.6]), abs=1e-6)
    camera.get_by_role("button", name="All").click()
    console.settled()
    assert np.abs(console.tell(ON_PICTURE)).max() <= 1
    assert -0.9 < ahead(console)[2] < -0.1


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
