"""What the page saves, and the lines that it shows for a terminal and for Python: copied, they bring the same file."""

import os
import subprocess
import sys
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Download
from tests.console.browsing import VIEW, Console, tab
from tests.console.casting import occupied
from tests.console.room import ADMIN_TOKEN, MAP, Room

from cairn_server.views.export_tickets import TICKETS_OF_TOKEN_MAX

pytestmark = pytest.mark.browser

BEGINNINGS = {
    "PLY": b"ply\n",
    "PCD": b"# cairn",
    "LAZ": b"LASF",
    "NPZ": b"PK",
    "OctoMap .ot": b"# Octomap OcTree file\n",
    "OctoMap .bt": b"# Octomap OcTree binary file\n",
}
KEPT = """URL.createObjectURL = ((make) => (blob) => {
  window.kept = (window.kept ?? 0) + 1;
  return make(blob);
})(URL.createObjectURL)"""


def test_every_kind_of_file_is_saved_and_the_lines_bring_the_same(
    chromium: Browser, room: Room, tmp_path: Path
) -> None:
    with chromium.new_context(viewport=VIEW) as context:
        console = tab(context, room)
        console.open()
        console.log_in()
        console.settled()
        console.errors.clear()  # the browser tells that a stranger was refused
        voxels = occupied(room)
        console.page.get_by_label("Band from, °C").fill("15")
        console.page.get_by_label("Band to, °C").fill("22.5")
        console.page.locator("#band-on").check()
        console.page.get_by_label("Ceiling").fill("150")
        panel = console.page.get_by_role("region", name="Take away")
        panel.get_by_text("15 to 22.5 °C").wait_for()
        saved = {name: _saved(console, name) for name in BEGINNINGS}
        command, program = panel.locator("pre").all_inner_texts()
        assert console.errors == []
    for name, beginning in BEGINNINGS.items():
        assert saved[name].startswith(beginning)
    assert "--hotter=15 --colder=22.5" in command
    kelvin = voxels.temperature_k
    assert 0 < _points(saved["PLY"]) < np.isfinite(kelvin).sum()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    env = {**os.environ, "CAIRN_TOKEN": ADMIN_TOKEN, "PATH": path}
    for number, line in enumerate((["bash", "-c", command], [sys.executable, "-c", program])):
        folder = tmp_path / str(number)
        folder.mkdir()
        subprocess.run(line, cwd=folder, env=env, timeout=60, check=True)
        assert (folder / f"{MAP}.ply").read_bytes() == saved["PLY"]


def test_the_browser_saves_what_the_page_never_held(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=VIEW) as context:
        console = tab(context, room)
        console.page.add_init_script(KEPT)
        console.open()
        console.log_in()
        console.settled()
        console.page.get_by_label("Ceiling").fill("150")
        for name in BEGINNINGS:
            found = _download(console, name)
            assert "ticket=" in found.url
            assert ADMIN_TOKEN not in found.url
            by_token = _export(room, httpx.URL(found.url).copy_remove_param("ticket"))
            assert found.path().read_bytes() == by_token.content
            points = int(by_token.headers["Cairn-Points"])
            console.page.get_by_text(f": {points:,} points".replace(",", "\u202f")).wait_for()
        assert console.page.evaluate("window.kept") is None


def test_why_nothing_is_saved_stands_on_the_page(chromium: Browser, room: Room) -> None:
    with chromium.new_context(viewport=VIEW) as context:
        console = tab(context, room)
        console.open()
        console.log_in()
        console.settled()
        asked = [_ticket(room) for _ in range(TICKETS_OF_TOKEN_MAX)]
        downloads: list[str] = []
        console.page.on("download", lambda found: downloads.append(found.url))
        panel = console.page.get_by_role("region", name="Take away")
        panel.get_by_role("button", name="PLY").click()
        panel.locator(".error", has_text=f"at most {TICKETS_OF_TOKEN_MAX} downloads").wait_for()
        assert downloads == []
        for ticket in asked:
            assert _export(room, httpx.URL(f"{room.url}/maps/{MAP}/main/export", params={"ticket": ticket})).is_success
        _saved(console, "PLY")
        panel.locator(".hint", has_text=" points").wait_for()


def _ticket(room: Room) -> str:
    headers = {"Authorization": f"Bearer {ADMIN_TOKEN}"}
    answer = httpx.post(f"{room.url}/maps/{MAP}/main/export/tickets", json={}, headers=headers)
    return str(answer.raise_for_status().json()["ticket"])


def _export(room: Room, url: httpx.URL) -> httpx.Response:
    return httpx.get(url, headers={"Authorization": f"Bearer {ADMIN_TOKEN}"}).raise_for_status()


def _download(console: Console, name: str) -> Download:
    panel = console.page.get_by_role("region", name="Take away")
    with console.page.expect_download() as found:
        panel.get_by_role("button", name=name).click()
    return found.value


def _saved(console: Console, name: str) -> bytes:
    return _download(console, name).path().read_bytes()


def _points(ply: bytes) -> int:
    return int(ply.partition(b"element vertex ")[2].partition(b"\n")[0])
