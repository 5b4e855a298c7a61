"""The commands as a user runs them: a real server, real files; each command once at least in a process of its own."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from itertools import islice
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.console.browsing import VIEW, browser, skip_without_page, tab
from tests.console.casting import occupied, picks_met_first
from tests.console.room import LOOPBACK, Room
from tests.fixtures.commands import cairn, record_room, served, wait_for_fold
from tests.fixtures.forked_command import ForkedCommand, start_command
from tests.fixtures.pages import DOCS, commands_of, programs_of
from tests.fixtures.server.live import free_port

from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_map.files.cell_folder import read_cells, read_head

pytestmark = pytest.mark.processes

COMMAND_S = 300
PLACES, PICKS = 100, 50
"""That are asked for, and voxels that are found there at least."""
VOXEL_M = "0.08"


def typed(*arguments: object, folder: Path, code: int = 0) -> str:
    """The same in a process of its own, which takes a second to start."""
    command = [sys.executable, "-m", "cairn_client.main", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=COMMAND_S, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout if code == 0 else done.stderr


def test_a_command_is_forked_unless_its_environment_counts_at_its_start(tmp_path: Path) -> None:
    changed = os.environ | {"PYTHONHASHSEED": "7"}
    for env, kind in ((os.environ, ForkedCommand), (changed, subprocess.Popen)):
        process = start_command(["--version"], env=env, stderr=2, folder=tmp_path)
        said, _ = process.communicate(timeout=COMMAND_S)
        assert isinstance(process, kind) and process.returncode == 0 and said.startswith("cairn ")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """One for all tests, each of which has maps of its own."""
    with served("--data", tmp_path_factory.mktemp("server")) as url:
        # Its kernels are there: commands take it without, but `cairn doctor` says so.
        end_s = time.monotonic() + COMMAND_S
        while httpx.get(f"{url}/readyz").status_code != 200 and time.monotonic() < end_s:
            time.sleep(0.2)
        yield url


@pytest.fixture(scope="module")
def room_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_room(tmp_path_factory.mktemp("recording") / "room")


def digests(map_url: str, folder: Path, name: str) -> dict[str, bytes]:
    """The folded cells as `export --cells` writes them, without what the server's compressor may choose."""
    wait_for_fold(map_url)
    cairn("map", "export", map_url, "--cells", name, folder=folder)
    layer = read_head(folder / name).layer
    return {str(cell.key): cell.digest for cell in read_cells(folder / name, layer)}


def test_two_robots_that_share_a_recording_make_the_map_of_one(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    one, two = f"{server}/maps/one", f"{server}/maps/two"
    out = typed("robot", "replay", room_recording, "--map", one, "--voxel", VOXEL_M, folder=tmp_path)
    assert re.search(r"replayed 8 scans as 2 commits in .* scans/s\), .* 0 commits wait", out)
    assert re.search(r"ranges: \d+\.\d% of \d+ pixels are mapped", out)
    for part in ("1/2", "2/2"):
        name = f"part{part[0]}"
        typed(
            *("robot", "replay", room_recording, "--map", two, "--voxel", VOXEL_M, "--share", part, "--name", name),
            folder=tmp_path,
        )
    assert digests(two, tmp_path, "cells-two") == digests(one, tmp_path, "cells-one") != {}


def test_a_map_starts_from_a_folder_of_cells_or_from_another_map(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    source = f"{server}/maps/source"
    # Prior data are sums over all epochs: of a map without epochs, the same cells.
    cairn("map", "create", source, "--voxel", VOXEL_M, "--epoch", "none", folder=tmp_path)
    cairn("robot", "replay", room_recording, "--map", source, folder=tmp_path)
    cells = digests(source, tmp_path, "cells")
    typed("map", "create", f"{server}/maps/from-folder", "--from", "cells", folder=tmp_path)
    cairn("map", "create", f"{server}/maps/from-map", "--from", source, folder=tmp_path)
    assert digests(f"{server}/maps/from-folder", tmp_path, "a") == cells
    assert digests(f"{server}/maps/from-map", tmp_path, "b") == cells
    log = json.loads(typed("map", "log", f"{server}/maps/from-map", "--json", folder=tmp_path))
    assert [entry["id"].partition(".")[0] for entry in log] == ["initial"]
    again = cairn("map", "create", f"{server}/maps/from-folder", "--from", "cells", folder=tmp_path)
    assert "pushed before, and are not added again" in again
    assert digests(f"{server}/maps/from-folder", tmp_path, "c") == cells


def test_retracting_a_robot_leaves_the_map_of_the_others(server: str, room_recording: Path, tmp_path: Path) -> None:
    both, alone = f"{server}/maps/both", f"{server}/maps/alone"
    for url, name, part in ((both, "good", "1/2"), (both, "bad", "2/2"), (alone, "good", "1/2")):
        state = tmp_path / f"{name}-on-{url[-5:]}"
        cairn(
            *("robot", "replay", room_recording, "--map", url, "--voxel", VOXEL_M, "--share", part),
            *("--name", name, "--state", state),
            folder=tmp_path,
        )
    assert "takes out 1 commits" in typed("map", "retract", both, "--robot", "bad", folder=tmp_path)
    typed("robot", "sync", "copy", "--map", both, folder=tmp_path)  # waits for nothing, but must not fail
    expected = digests(alone, tmp_path, "expected")
    for attempt in range(100):
        if digests(both, tmp_path, f"try{attempt}") == expected:
            return
    pytest.fail("the retract was not folded")


def test_a_low_end_copy_holds_only_the_cells_near_a_place(server: str, room_recording: Path, tmp_path: Path) -> None:
    url = f"{server}/maps/near"
    cairn("robot", "replay", room_recording, "--map", url, "--voxel", VOXEL_M, folder=tmp_path)
    wait_for_fold(url)
    near = ("--mode", "low-end", "--near", "1,1,1", "--radius", "0.1")
    assert "1 cells," in cairn("robot", "sync", "low", "--map", url, *near, folder=tmp_path)
    whole = cairn("robot", "sync", "whole", "--map", url, "--mode", "low-end", folder=tmp_path)
    viewer = cairn("robot", "sync", "viewer", "--map", url, folder=tmp_path)
    assert whole.split(" in ")[0] == viewer.split(" in ")[0] != "1 cells"


def test_a_robot_without_a_link_keeps_its_commits_until_there_is_one(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    url = f"{server}/maps/later"
    nowhere = "http://127.0.0.1:9/maps/later"
    state = ("--state", "state", "--name", "lonely")
    out = cairn(*("robot", "replay", room_recording, "--map", nowhere, "--voxel", VOXEL_M, *state), folder=tmp_path)
    assert "2 commits wait" in out
    cairn("map", "create", url, "--voxel", VOXEL_M, folder=tmp_path)
    assert "pushed 2 commits" in cairn("robot", "sync", "state", "--map", url, folder=tmp_path)
    assert digests(url, tmp_path, "cells") != {}


def test_cells_and_maps_download_as_files_that_other_programs_read(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    url = f"{server}/maps/files"
    cairn("robot", "replay", room_recording, "--map", url, "--voxel", VOXEL_M, folder=tmp_path)
    wait_for_fold(url)
    typed("map", "get", url, "0,0,0", "-o", "cell.npz", folder=tmp_path)
    with np.load(tmp_path / "cell.npz") as arrays:
        occupied = arrays["probability"] > 0.5
        assert 290 < np.nanmedian(arrays["temperature_mean"][occupied]) < 300
        assert (arrays["centres_m"] >= 0).all() and (arrays["centres_m"] < 5.12).all()
    outputs = ("--ply", "map.ply", "--npz", "map.npz", "--picture", "map.png", "--ceiling", "1.7")
    typed("map", "export", url, *outputs, folder=tmp_path)
    head = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", head[0]).group(1))  # type: ignore[union-attr]
    assert count > 1000
    sizes_bytes = {b"float": 4, b"double": 8, b"int": 4, b"uint": 4, b"uchar": 1}
    columns = re.findall(rb"property (\w+) (\w+)", head[0])
    assert len(head[2]) == count * sum(sizes_bytes[kind] for kind, _ in columns)
    assert {b"colour_measured_s", b"temperature_measured_s"} <= {name for _, name in columns}  # its map has epochs
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_errors_name_the_cause_and_have_an_exit_code_of_their_own(server: str, tmp_path: Path) -> None:
    cairn("map", "create", f"{server}/maps/lab", folder=tmp_path)
    assert "[no_cell]" in typed("map", "get", f"{server}/maps/lab", "9,9,9", "-o", "x.ply", folder=tmp_path, code=3)
    assert "[no_map]" in cairn("map", "info", f"{server}/maps/none", folder=tmp_path, code=3)
    other = cairn("map", "create", f"{server}/maps/lab", "--voxel", "0.02", folder=tmp_path, code=4)
    assert "map lab exists with voxels of 0.04 m" in other
    assert "voxels of 0.02 m" in other
    assert "is `cairn serve` running?" in typed("map", "ls", "http://127.0.0.1:9", folder=tmp_path, code=5)
    assert "http://HOST:PORT/maps/NAME" in cairn("map", "info", server, folder=tmp_path, code=1)
    assert "looked for" in cairn("robot", "replay", ".", "--map", f"{server}/maps/lab", folder=tmp_path, code=1)


def test_a_recording_is_not_counted_twice_by_accident(server: str, room_recording: Path, tmp_path: Path) -> None:
    url = f"{server}/maps/twice"
    replay = ("robot", "replay", room_recording, "--map", url)
    cairn(*replay, "--voxel", VOXEL_M, folder=tmp_path)
    once = digests(url, tmp_path, "once")
    assert "--again" in cairn(*replay, folder=tmp_path, code=1)
    assert "voxels of 8 cm, not 2 cm" in cairn(*replay, "--voxel", "0.02", "--again", folder=tmp_path, code=1)
    assert digests(url, tmp_path, "still-once") == once
    cairn(*replay, "--again", folder=tmp_path)
    assert digests(url, tmp_path, "twice") != once


def test_after_a_replay_the_server_knows_that_the_robot_is_level(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    url = f"{server}/maps/level"
    cairn("robot", "replay", room_recording, "--map", url, "--voxel", VOXEL_M, folder=tmp_path)
    wait_for_fold(url)
    cairn("robot", "sync", "cairn-room", "--map", url, folder=tmp_path)
    assert "0 log entries since it last asked" in typed("map", "info", url, folder=tmp_path)


def test_files_that_cannot_be_written_and_cells_with_negative_numbers(
    server: str, room_recording: Path, tmp_path: Path
) -> None:
    url = f"{server}/maps/out"
    cairn("robot", "replay", room_recording, "--map", url, "--voxel", VOXEL_M, folder=tmp_path)
    wait_for_fold(url)
    assert "[bad_output]" in cairn("map", "export", url, "--ply", "no/such/x.ply", folder=tmp_path, code=1)
    assert "[bad_output]" in cairn("map", "get", url, "0,0,0", "-o", "no/such/x.ply", folder=tmp_path, code=1)
    assert "-9,0,0" in cairn("map", "get", url, "-9,0,0", "-o", "x.ply", folder=tmp_path, code=3)
    low_end = ("--mode", "low-end", "--near", "-1,0.5,1")
    assert "cells," in cairn("robot", "sync", "low", "--map", url, *low_end, folder=tmp_path)
    bent = ("--depth", "{id}.png", "--pose", "pose.txt", "--intrinsics", "9,9,9,9", "--distortion", "-0.1,0,0,0,0")
    assert "[no_frames]" in cairn("robot", "replay", "cells", "--map", url, *bent, folder=tmp_path, code=1)


def test_a_server_refuses_tokens_that_protect_nothing(tmp_path: Path) -> None:
    (tmp_path / "one").write_text("a secret of many letters")
    only = ("serve", "--port", "0", "--enrolment-token-file", "one")
    assert "[weak_tokens]" in typed(*only, folder=tmp_path, code=1)
    assert "[weak_tokens]" in cairn(*only, "--admin-token-file", "one", folder=tmp_path, code=1)


def test_the_example_robot_shares_what_it_sees(server: str, room_recording: Path, tmp_path: Path) -> None:
    cairn("map", "create", f"{server}/maps/example", folder=tmp_path)
    script = Path(__file__).parent.parent / "docs" / "examples" / "simulated_robot.py"
    command = [sys.executable, str(script), f"{server}/maps/example", str(room_recording)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=COMMAND_S, check=True)
    assert re.search(r"commit walle\.[0-9a-f]{16}\.1: \d+ cells, \d+ bytes", done.stdout)
    assert " 0 commits wait" in done.stdout


def write_labels(recording: Path, folder: Path) -> None:
    """Write the first scans of a recording again, with label images in which all is wall."""
    scans = open_recording(recording)
    with RecordingWriter(folder, scans.rig, name=folder.name) as writer:
        for scan in islice(scans, 2):
            labels = np.ones(scan.range_m.shape, np.uint8)
            writer.add(replace(scan, labels={scan.range_camera: labels}, label_names={1: "wall"}))


def test_commands_of_the_operators_page_work_in_their_order(server: str, room_recording: Path, tmp_path: Path) -> None:
    maps = f"{server}/maps/operator-"
    replay = ("robot", "replay", room_recording, "--voxel", VOXEL_M, "--name", "mole")
    write_labels(room_recording, tmp_path / "labelled")
    cairn(*replay, "--map", f"{maps}lab", folder=tmp_path)
    wait_for_fold(f"{maps}lab")
    for arguments in commands_of(DOCS / "operator.md"):
        if arguments[0] not in ("serve", "watch", "telepresence") and "--foxglove" not in arguments:
            # Those have no end, or are of a recording.
            here = [
                word.replace("http://127.0.0.1:8750/maps/", maps).replace("http://127.0.0.1:8750", server)
                for word in arguments
            ]
            cairn(*here, folder=tmp_path)


def test_programs_of_the_page_about_python_run(
    server: str, room_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"{server}/maps/python-api"
    cairn("map", "create", url, "--voxel", VOXEL_M, folder=tmp_path)
    (tmp_path / "lab-1").symlink_to(room_recording)
    names: dict[str, object] = {}
    for program in programs_of(DOCS / "python-api.md"):
        with chdir(tmp_path):
            exec(compile(program.replace("http://127.0.0.1:8750/maps/lab", url), "python-api.md", "exec"), names)
        wait_for_fold(url)
    assert len(capsys.readouterr().out.splitlines()) >= 3


@pytest.mark.parametrize("command", ["map", "robot", "serve", "demo", "experiment"])
def test_help_of_a_command_is_its_module_docstring(command: str, tmp_path: Path) -> None:
    first_line = cairn("--help", folder=tmp_path).partition(f"  {command} ")[2].splitlines()[0].strip()
    assert first_line and first_line in typed(command, "--help", folder=tmp_path)


def test_a_robot_without_the_server_extra_is_told_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "fastapi.py").write_text("raise ModuleNotFoundError('No module named fastapi', name='fastapi')\n")
    (tmp_path / "uvicorn.py").write_text("raise ModuleNotFoundError('No module named uvicorn', name='uvicorn')\n")
    done = subprocess.run(
        [sys.executable, "-m", "cairn_client.main", "serve"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=COMMAND_S,
        check=False,
    )
    assert done.returncode == 1
    assert 'pip install "cairn-robotics[server]"' in done.stderr


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The demo's folder, and what it said."""
    folder = tmp_path_factory.mktemp("demo")
    return folder / "demo", typed("demo", "--quick", "--output", "demo", folder=folder)


def test_the_demo_ends_with_maps_that_agree(demo: tuple[Path, str]) -> None:
    folder, out = demo
    assert re.search(r"all equal: server, scout, mole, late hold the same \d+ cells,\s+byte for byte", out)
    assert "every map equals one that never had it" in out
    assert (folder / "map.png").stat().st_size > 10_000
    assert (folder / "map.ply").read_bytes().startswith(b"ply\n")


def test_the_demos_map_is_in_the_browser_what_the_server_has(demo: tuple[Path, str]) -> None:
    skip_without_page()
    room = Room(demo[0], free_port(LOOPBACK), name="building")
    room.start()
    try:
        with browser() as chromium, chromium.new_context(viewport=VIEW) as context:
            console = tab(context, room)
            console.open()
            console.log_in()
            console.settled()
            assert console.picture().std() > 10
            console.page.keyboard.press("w")
            console.settled()
            assert console.picture().std() > 10
            size = console.tell("[c.stage.canvas.clientWidth, c.stage.canvas.clientHeight]")
            places = np.random.default_rng(5).integers(0, size, (PLACES, 2))
            with room.api as api:
                geometry = api.map_info(room.name).geometry
            assert picks_met_first(console, occupied(room), geometry, places) >= PICKS
            assert console.errors[1:] == []  # the browser tells of the 401 before
    finally:
        room.stop()


@pytest.mark.recording
@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_two_robots_on_a_real_recording_make_the_map_of_one(server: str, tmp_path: Path) -> None:
    recording = Path(os.environ["CAIRN_TEST_DATA"]) / "apc_shelf_rgbd"
    one, two = f"{server}/maps/shelf-one", f"{server}/maps/shelf-two"
    cairn("robot", "replay", recording, "--map", one, "--voxel", "0.01", "--name", "single", folder=tmp_path)
    for part in ("1/2", "2/2"):
        name = f"part{part[0]}"
        cairn(
            *("robot", "replay", recording, "--map", two, "--voxel", "0.01", "--share", part, "--name", name),
            folder=tmp_path,
        )
    assert digests(two, tmp_path, "cells-two") == digests(one, tmp_path, "cells-one") != {}


@pytest.mark.recording
@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_a_folder_of_frames_described_by_options_makes_the_map_of_its_importer(server: str, tmp_path: Path) -> None:
    recording = Path(os.environ["CAIRN_TEST_DATA"]) / "apc_shelf_rgbd"
    ids = ("--frames", "000000,000007")
    options = ("--depth", "frames/frame-{id}.depth.png", "--colour", "frames/frame-{id}.color.png")
    options += ("--pose", "frames/frame-{id}.pose.txt", "--intrinsics", "K_color.txt", "--depth-units", "10000")
    for name, more in (("known", ()), ("described", options)):
        url = f"{server}/maps/{name}"
        cairn(*("robot", "replay", recording, "--map", url, "--voxel", "0.02", *ids), *more, folder=tmp_path)
    expected = digests(f"{server}/maps/known", tmp_path, "known")
    assert digests(f"{server}/maps/described", tmp_path, "described") == expected != {}
