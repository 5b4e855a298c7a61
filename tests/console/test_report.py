"""The report, pictures of marks and links to findings: what leaves the page, and may be proven later."""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, Console, findings_of_axe, tab
from tests.console.hot_room import GEOMETRY, SPOTS, centre_m, commit_of
from tests.console.hot_room import room as hot_room
from tests.console.room import ADMIN_TOKEN, Room
from tests.fixtures.server.deadline import until

from cairn_client.http.api import MapApi
from cairn_client.http.attachment_copy import send_attachment
from cairn_map.commits.attachment import Attachment
from cairn_map.wire.mark_messages import MarkRequest, MarkText
from cairn_map.wire.messages import CreateMap

pytestmark = pytest.mark.browser

STORE = "store"
PAGE = b"<!doctype html><script>document.title = 'owned'</script>"
BROKEN = b"\x89PNG\r\n\x1a\n" + b"no picture at all"
MAGENTA = [255, 0, 255, 255]
SAID = {
    "page": "is not a picture",
    "broken": "cannot be read as a picture",
    "other": "is not the picture that the mark names",
}
PIXEL = """() => {
  const canvas = document.querySelector(".attached canvas");
  return [...canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data];
}"""


def png() -> bytes:
    done, data = cv2.imencode(".png", np.full((60, 80, 3), MAGENTA[:3], np.uint8))
    assert done
    return data.tobytes()


def put(api: MapApi, name: str, data: bytes) -> str:
    """A mark with an attachment; its key."""
    attachment = Attachment(sha256=hashlib.sha256(data).hexdigest(), size_bytes=len(data))
    text = MarkText(kind="person", name=name, place_m=(1.0, 1.0, 0.5), attachment=attachment)
    receipt = api.put_mark(STORE, MarkRequest(mark=text))
    send_attachment(api, STORE, attachment, data)
    assert receipt.key
    return receipt.key


@pytest.fixture(scope="module")
def keys(room: Room) -> dict[str, str]:
    """Marks by name, each with an attachment: a picture, a web page, what only begins like a picture, and another's."""
    with room.api as api:
        api.create_map(STORE, CreateMap(geometry=GEOMETRY))
        commit = commit_of(hot_room(), 0)
        api.push(STORE, commit)
        until(lambda: any(entry.id == str(commit.id) for entry in api.log(STORE)), "the room is folded")
        return {
            n: put(api, n, d)
            for n, d in (("photo", png()), ("page", PAGE), ("broken", BROKEN), ("other", png() + b"."))
        }


@pytest.fixture(scope="module")
def desk(chromium: Browser, room: Room, keys: dict[str, str]) -> Iterator[Console]:
    with chromium.new_context(viewport=VIEW, color_scheme="dark") as context:
        found = tab(context, room)
        other = hashlib.sha256(png() + b".").hexdigest()
        found.page.route(f"**/attachments/{other}", lambda route: route.fulfill(body=png(), content_type="image/png"))
        found.open(f"#map={STORE}&find=mark+{keys['photo']}")
        found.log_in()
        found.settled()
        found.until(f"c.findings.all.length === {len(SPOTS) + len(keys)} && c.plan.plan", "all is listed")
        found.errors.clear()  # the browser tells of the 401 before
        yield found


def test_a_link_to_a_finding_chooses_it_and_its_picture_is_painted(desk: Console) -> None:
    desk.page.locator(".attached canvas").wait_for()
    assert desk.page.locator(".find[aria-pressed=true]").inner_text().split("\n")[1] == "photo"
    assert desk.page.evaluate(PIXEL) == MAGENTA
    desk.page.get_by_role("region", name="Findings").get_by_role("button", name="Link").click()
    assert "find=mark+" in desk.page.get_by_role("dialog", name="Share").inner_text()
    desk.page.keyboard.press("Escape")


@pytest.mark.parametrize("name", list(SAID))
def test_what_is_not_the_picture_that_a_mark_names_is_words_and_never_a_page(desk: Console, name: str) -> None:
    desk.page.locator(".find", has_text=name).click()
    desk.page.locator(".attached").get_by_text(SAID[name]).wait_for()
    assert desk.page.locator(".attached canvas, .attached img, iframe, object, embed").count() == 0
    assert "owned" not in desk.page.title()
    assert desk.errors == []


def test_a_link_to_a_finding_that_went_says_so_and_shows_no_other(desk: Console) -> None:
    desk.tell("c.findings.seek('spot 99,99,99')")
    desk.tell("(c.findings.sought.endMs = 0, null)")
    desk.page.get_by_text("is not in the map, or not any more").wait_for()


def test_a_report_has_plan_findings_and_pictures_in_a_zone_and_a_digest_that_the_server_confirms(
    desk: Console, room: Room
) -> None:
    page = desk.page
    page.get_by_role("region", name="Findings").get_by_role("button", name="Report").click()
    report = page.get_by_role("dialog", name="Report")
    report.get_by_role("heading", name="Proof").wait_for()
    with room.api as api:
        info, cells = api.map_info(STORE), api.cell_index(STORE)
    lines = "".join(f"{','.join(map(str, entry.cell))} {entry.digest}\n" for entry in cells.cells)
    said = report.inner_text()
    digest = hashlib.sha256(lines.encode()).hexdigest()
    assert digest in said
    if shutil.which("jq"):
        # One cell a page: the printed command reads on to the index's end.
        command = report.locator("pre").inner_text().replace("limit=10000", "limit=1")
        env = {**os.environ, "CAIRN_TOKEN": ADMIN_TOKEN}
        done = subprocess.run(["bash", "-c", command], env=env, capture_output=True, text=True, check=True, timeout=60)
        assert done.stdout.split()[0] == digest
        assert len(cells.cells) > 1
    assert str(info.cursor) in said
    rows = report.locator("tbody tr")
    assert rows.count() == desk.tell("c.findings.all.length")
    (hottest, _), *_ = SPOTS.values()
    assert [float(each) for each in rows.first.locator("td").nth(3).inner_text().split(", ")] == pytest.approx(
        centre_m(hottest[len(hottest) // 2]), abs=0.2
    )
    assert report.locator(".storey canvas").count() == 1
    assert report.locator(".picture canvas").count() == 1
    when = rows.last.locator("td").nth(7)
    stated = datetime.strptime(when.inner_text(), "%Y-%m-%d %H:%M:%S UTC").replace(tzinfo=UTC)
    report.get_by_label("Times in").select_option("Asia/Tokyo")
    assert when.inner_text().startswith(stated.astimezone(ZoneInfo("Asia/Tokyo")).strftime("%Y-%m-%d %H:%M:%S GMT+9"))
    assert findings_of_axe(desk, "report") == []
    page.emulate_media(media="print")
    assert report.is_visible()
    assert not page.locator(".console").is_visible()
    assert not report.get_by_role("button", name="Print").is_visible()
    page.emulate_media(media="screen")
    page.keyboard.press("Escape")
    report.wait_for(state="detached")
    assert desk.errors == []
