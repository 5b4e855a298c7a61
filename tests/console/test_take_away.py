"""What the page saves, and the lines that it shows for a terminal and for Python: copied, they bring the same file."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser
from tests.console.browsing import VIEW, Console, tab
from tests.console.casting import occupied
from tests.console.conftest import Room
from tests.console.room import ADMIN_TOKEN, MAP

BEGINNINGS = {
    "PLY": b"ply\n",
    "PCD": b"# cairn",
    "LAZ": b"LASF",
    "OctoMap .ot": b"# Octomap OcTree file\n",
    "OctoMap .bt": b"# Octomap OcTree binary file\n",
}


def test_every_kind_of_file_is_saved_and_the_lines_bring_the_same(
    chromium: Browser, room: Room, tmp_path: Path
) -> None:
    with chromium.new_context(viewport=VIEW) as context:  # type: ignore[arg-type]
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


def _saved(console: Console, name: str) -> bytes:
    panel = console.page.get_by_role("region", name="Take away")
    with console.page.expect_download() as found:
        panel.get_by_role("button", name=name).click()
    return Path(found.value.path()).read_bytes()


def _points(ply: bytes) -> int:
    return int(ply.partition(b"element vertex ")[2].partition(b"\n")[0])
