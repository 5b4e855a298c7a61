"""Thirty robots: the troubled ones are seen first, and no label in the picture lies over another."""

from itertools import combinations

import pytest
from playwright.sync_api import Route
from tests.console.browsing import Console, serious

pytestmark = pytest.mark.browser

TEAM = [f"robot{n:02}" for n in range(30)]
TROUBLE = {"robot17": "! help", "robot04": "offline", "robot21": "12 % left", "robot09": "late"}
"""The gravest first; who is whole is "online"."""
ODD = 90.0
"""Seconds for which an offline robot was silent."""


def answer(route: Route, now_s: float) -> None:
    route.fulfill(json=[branch(name, now_s) for name in TEAM])


def branch(name: str, now_s: float) -> dict[str, object]:
    seen_s = now_s - (ODD if TROUBLE.get(name) == "offline" else 0)
    number = TEAM.index(name)
    place = [0.5 + 0.05 * (number % 6), 0.5 + 0.05 * (number // 6), 0.5]
    status = {
        "time_s": seen_s,
        "pose": {"time_s": seen_s, "t_map_rig": place, "q_map_rig": [0, 0, 0, 1]},
        "mode": "high-end",
        "waiting": 0,
        "waiting_bytes": 0,
        "battery": 0.12 if name == "robot21" else 0.9,
        "note": "stuck at the stairs" if name == "robot17" else "",
    }
    behind = 99 if name == "robot09" else 0
    head: dict[str, object] = {
        "branch": name,
        "mode": "high-end",
        "sensors": [],
        "cursor": None,
        "behind": behind,
        "behind_bytes": 0,
    }
    return head | {"last_seen_s": seen_s, "status": status, "view_s": None, "time_s": seen_s, "gone": False}


def test_thirty_robots_fit_with_the_troubled_first_and_labels_that_count(console: Console) -> None:
    page = console.page
    now_s = page.evaluate("Date.now() / 1000")
    page.route("**/branches", lambda route: answer(route, now_s))
    console.tell("(c.team.askAtMs = 0, null)")
    console.until("c.team.branches.length === 30", "the page knows the team")
    for name in TEAM:
        console.tell("c.team.hear(a[0])", branch(name, now_s))
    region = page.get_by_role("region", name="Robots")
    region.get_by_text("29 online, 1 offline, 1 need help, 1 low on battery, 1 late").wait_for()
    rows = region.locator("[data-robot]")
    assert [rows.nth(n).get_attribute("data-robot") for n in range(4)] == list(TROUBLE)
    for n, said in enumerate(TROUBLE.values()):
        assert said in rows.nth(n).inner_text()
        box = rows.nth(n).bounding_box()
        assert box
        assert box["y"] + box["height"] < 690, "seen without scrolling"
        assert box["height"] < 45, "one line"
    assert "stuck at the stairs" in rows.nth(0).inner_text()
    page.locator(".host canvas").focus()
    page.keyboard.press("h")
    console.settled()
    boxes = [box for label in page.locator(".label:visible").all() if (box := label.bounding_box())]
    assert boxes
    for one, other in combinations(boxes, 2):
        across = one["x"] < other["x"] + other["width"] and other["x"] < one["x"] + one["width"]
        along = one["y"] < other["y"] + other["height"] and other["y"] < one["y"] + one["height"]
        assert not (across and along), "none over another"
    counted = page.locator(".label.many:visible").first.inner_text()
    assert "robots: robot" in counted
    lines = page.locator(".leaders path").evaluate("(path) => path.getAttribute('d').split('M').length - 1")
    assert lines >= int(counted.split(" ", 1)[0])
    assert serious(console, "thirty robots") == []
