"""The pages for newcomers: their commands run as written, in the page's order, against real servers and small inputs.

The operator's page and the programs of the page about Python are run in tests/test_commands.py.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.foreign_rigs import ROS2_ECHO
from tests.fixtures.calib.thermal_images import SIZE, black_bodies
from tests.fixtures.client.live_server import wait_until
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import robot_in
from tests.fixtures.commands import cairn, record_room, served
from tests.fixtures.fusion import cloud_forms
from tests.fixtures.fusion.bags import recorded, small_recording, write_bag
from tests.fixtures.fusion.pose_forms import kitti
from tests.fixtures.pages import DOCS, ROOT, commands_of
from tests.fixtures.server.live import free_port
from tests.fixtures.sim.drive import record_drive

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.errors import DeniedError
from cairn_map.evidence.grid import Geometry
from cairn_sim.robots.heads import full_head

pytestmark = pytest.mark.processes

Command = tuple[str, ...]
Action = Callable[[], None]

NEAR: Command = ("--max-range", "1.5")
"""Fewer voxels of 1 cm to map."""
SHORTENED: dict[str, Command] = {
    "experiment --output experiment": ("--stops", "1", "--scale", "0.1", "--resolutions", "16", "4"),
    "experiment --stops 2 --resolutions 8 4": (
        *("--stops", "1", "--scale", "0.05", "--resolutions", "16", "--robot", "tof", "--output", "short"),
    ),
    "experiment --recording labs corridors": ("--resolutions", "16", "--output", "recorded"),
    "sim show building --path experiment --stop 19 --scan 18": ("--scale", "0.25"),
    "sim show moving-building --stop 3 --time 3700": ("--scale", "0.25"),
    "sim record building lab-1 --robot tof --path experiment": ("--stops", "0:1", "--truth", "none"),
    "sim record moving-building day --path labs --robot tof --rounds 3 --hours 2": ("--stops", "0:1"),
    "robot replay lab-1 --map http://127.0.0.1:8750/maps/lab": ("--voxel", "0.16"),
    "robot replay RECORDING --map http://127.0.0.1:8750/maps/shelf --voxel 0.01": NEAR,
    "robot replay RECORDING --map http://127.0.0.1:8750/maps/shelf --share 1/2 --name left": NEAR,
    "robot replay RECORDING --map http://127.0.0.1:8750/maps/shelf --share 2/2 --name right": NEAR,
}
"""Options added to commands that would take minutes; argparse takes the last of an option that is given twice."""
LISTS = "wants files of other programs: tests/cairn_calib/exchange/test_corner_lists.py"
TAGS = "wants images of sheets with tags: tests/cairn_calib/corner_search"
ELSEWHERE = {
    "calib study --output study": "takes minutes: tests/cairn_sim/study/test_study.py runs two configurations of ten",
    "calib convert-corners corners.vnl corners/left --images *-cam0.jpg --board 10x10 --square 0.0588": LISTS,
    "calib convert-corners left.mat corners/left --square 0.025": LISTS,
    "calib convert-corners corners/left corners/right corners.vnl": LISTS,
    "calib convert-corners thermal/seen.csv corners/thermal --points pins.csv --blobs 8": (
        "wants images of pins: tests/cairn_calib/exchange/test_named_points.py"
    ),
    "calib corners shots/*.png --pattern aprilgrid --board 6x6 --square 0.088 --spacing 0.3 --output corners": TAGS,
    "calib corners shots/*.png --pattern charuco --board 11x8 --square 0.03 --marker 0.022 --tags 5x5_100 "
    "--output corners": TAGS,
    "calib solve corners/depth corners/left --spectrum depth=range,left=colour --range depth --z-depth "
    "--output rig.json": "wants depth images: tests/cairn_calib/solve/test_z_depth.py",
}
"""Commands of the page for calibration engineers that are not run here: the reason, and the test that runs them."""
CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.7, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.11], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, -0.0001, -3.6e-05]
  distortion_model: radtan
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
"""Two cameras side by side as Kalibr writes them; both lenses are pinholes, since mrcal has no equidistant fisheye."""


class Page:
    """One page's commands in a scratch folder, with live servers in the places that the page names.

    `serve` starts a process that ends with the page, or when the page starts another server at the same address.
    """

    def __init__(self, folder: Path, servers: ExitStack) -> None:
        self.folder = folder
        self._servers = servers
        self._hosts: dict[str, str] = {}
        self._running: dict[str, ExitStack] = {}

    def serve(self, host: str, *options: str, folder: Path | None = None) -> None:
        """Start a server for a host of the page, in the place of the one that runs there."""
        self.stop(host)
        port = int(self._hosts[host].rpartition(":")[2]) if host in self._hosts else free_port("127.0.0.1")
        self._hosts[host] = f"http://127.0.0.1:{port}"
        running = self._running[host] = self._servers.enter_context(ExitStack())
        running.enter_context(served(*options, folder=folder or self.folder, port=port))

    def stop(self, host: str) -> None:
        if host in self._running:
            self._running.pop(host).close()

    def name(self, host: str, other: str) -> None:
        """Give a host a second name."""
        self._hosts[other] = self._hosts[host]

    def here(self, arguments: list[str]) -> list[str]:
        """Arguments with the addresses of live servers, paths of the scratch folder, and names in the place of `*`."""
        for host, address in self._hosts.items():
            arguments = [word.replace(f"http://{host}:8750", address) for word in arguments]
        arguments = [f"{self.folder}{word}" if word.startswith("/") else word for word in arguments]
        return [name for word in arguments for name in (self._matches(word) if "*" in word else [word])]

    def _matches(self, pattern: str) -> list[str]:
        """Paths of the scratch folder that a shell would put in the place of a pattern."""
        found = sorted(path.relative_to(self.folder).as_posix() for path in self.folder.glob(pattern))
        assert found, pattern
        return found

    def run(self, path: Path, *, instead: Mapping[str, Action], before: Mapping[str, Action] | None = None) -> None:
        """Run all commands of a page; `instead` and `before` are found by the whole command, as the page has it."""
        before = before or {}
        todo = {*instead, *before}
        for arguments in commands_of(path):
            command = " ".join(arguments)
            todo.discard(command)
            if command in before:
                before[command]()
            if command in instead:
                instead[command]()
            else:
                cairn(*self.here(arguments), *SHORTENED.get(command, ()), folder=self.folder)
        assert not todo, "commands that the page no longer has"


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with ExitStack() as servers:
        yield Page(tmp_path, servers)


def run_robot_until_pushed(page: Page, *arguments: str) -> None:
    """`cairn robot run` as a process that a signal ends once a commit of it is on the server."""
    command = [sys.executable, "-m", "cairn_client.main", *page.here(list(arguments))]
    with subprocess.Popen(command, cwd=page.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        assert run.stdout is not None
        lines = iter(run.stdout.readline, "")
        assert any(line.startswith("pushed ") for line in lines)
        run.send_signal(signal.SIGTERM)
        rest = "".join(lines)
    assert run.returncode == 0 and "0 commits wait" in rest, rest


def decide(topics: Path) -> None:
    """Answer what a proposed topics file leaves open: the proposed numbers are right."""
    lines = topics.read_text().splitlines()
    topics.write_text("\n".join(line for line in lines if "DECIDE" not in line))


def write_frames(folder: Path) -> None:
    """Two frames of a wall 1 m ahead, in colour and depth, as files of any other program."""
    (folder / "frames").mkdir(parents=True)
    for name in ("a", "b"):
        cv2.imwrite(str(folder / f"frames/{name}.depth.png"), np.full((48, 64), 10_000, np.uint16))
        cv2.imwrite(str(folder / f"frames/{name}.color.png"), np.full((48, 64, 3), 90, np.uint8))
        np.savetxt(folder / f"frames/{name}.pose.txt", np.eye(4))
    np.savetxt(folder / "K_color.txt", [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])


def test_commands_of_the_readme_run(page: Page) -> None:
    record_room(page.folder / "RECORDING")
    serve = lambda: page.serve("127.0.0.1", "--data", "demo/server")  # noqa: E731
    page.run(ROOT / "README.md", instead={"serve --data demo/server": serve})


def write_set(folder: Path) -> None:
    """A set as TUM publishes RGB-D: folders by name, names that are times, poses by time."""
    wall = np.full((48, 64), 5000, np.uint16)
    for n in range(3):
        for name, image in (("depth", wall), ("rgb", np.full((48, 64, 3), 80, np.uint8))):
            path = folder / "SET" / name / f"{1305031102 + n / 30 + 0.004 * (name == 'rgb'):.6f}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image)
    rows = [f"{1305031101.9 + n / 10:.6f} {0.01 * n} 0 0 0 0 0 1\n" for n in range(6)]
    (folder / "groundtruth.txt").write_text("".join(rows))


def write_clouds(folder: Path) -> None:
    """Sweeps as KITTI publishes them, and their poses."""
    poses = [cloud_forms.pose_of(0.3 * n, 0.4 * n) for n in range(3)]
    (folder / "velodyne").mkdir()
    for n, T in enumerate(poses):
        cloud_forms.kitti_bin(folder / "velodyne" / f"{n:06d}", cloud_forms.seen(T, cloud_forms.beams(2000, seed=n)))
    kitti(folder, poses)


def amend_a_walk(folder: Path, command: list[str]) -> None:
    """Amend a robot's measurement by a trajectory that is 1 m farther along x."""
    with robot_in(folder, name="state", keep_scans_bytes=1_000_000, stay=True) as robot:
        scan = scan_of(1)
        robot.observe(scan)
        robot.commit()
    T_map_rig = scan.T_map_rig.copy()
    T_map_rig[0, 3] += 1.0
    (folder / "optimised.tum").write_text(trajectory_line(scan.time_s, T_map_rig))
    assert "1 measurement of state amended, by up to 1.00 m" in cairn(*command, folder=folder)


def test_commands_of_the_page_for_robot_developers_run(page: Page) -> None:
    record_room(page.folder / "RECORDING")
    shutil.copytree(page.folder / "RECORDING", page.folder / "SPOOL" / "one")
    write_frames(page.folder / "FOLDER")
    write_clouds(page.folder)
    write_set(page.folder)
    room = small_recording(page.folder / "bagged")
    write_bag(page.folder / "bag", "mcap", lambda make: recorded(room, make)).rename(page.folder / "lab.mcap")
    page.serve("127.0.0.1", "--data", "server")
    run = "robot run SPOOL --map http://127.0.0.1:8750/maps/lab --name mole"
    amend = "robot amend state/ --trajectory optimised.tum"
    instead = {
        run: lambda: run_robot_until_pushed(page, *run.split()),
        amend: lambda: amend_a_walk(page.folder, amend.split()),
    }
    replay = "robot replay lab.mcap --topics lab.yaml --map http://127.0.0.1:8750/maps/lab --voxel 0.04"
    page.run(DOCS / "robot-developer.md", instead=instead, before={replay: lambda: decide(page.folder / "lab.yaml")})


def test_commands_of_the_page_for_administrators_run(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = page.folder
    for who in ("CAIRN_ADMIN_TOKEN", "CAIRN_ENROLMENT_TOKEN"):
        monkeypatch.setenv(who, os.urandom(24).hex())
    for who in ("CAIRN_TOKEN", "CAIRN_TOKEN_THERE"):
        monkeypatch.setenv(who, os.environ["CAIRN_ADMIN_TOKEN"])
    for name in ("backup", "field"):
        (folder / name).mkdir()
    settings = "keep_evidence_s = 604_800\ndisk_free_min_bytes = 1_000_000_000\nquotas.bytes_per_day = 1_000_000_000\n"
    for line in settings.splitlines():
        assert line in (DOCS / "administrator.md").read_text()
    (folder / "server.toml").write_text(settings)
    page.serve("HOST", "--data", "DIR")

    def lose_a_disk() -> None:
        """A robot that registers, and again from an empty folder: under another key, so it has to ask."""
        url = page.here(["http://HOST:8750/maps/lab"])[0]
        for disk, refused in (("disk", nullcontext()), ("new-disk", pytest.raises(DeniedError))):
            token = os.environ["CAIRN_ENROLMENT_TOKEN"]
            with robot_in(folder / disk, url, token=token, geometry=Geometry(), stay=True) as robot, refused:
                robot.sync()

    def serve_restored() -> None:
        page.serve("HOST", "--data", "NEW")
        page.name("HOST", "base")

    def archive() -> None:
        cairn(*page.here(["map", "create", "http://HOST:8750/maps/attic"]), folder=folder)
        cairn("serve", "archive", "attic", "attic.cairn", "--data", "NEW", folder=folder)

    def create_relay() -> None:
        command = page.here(["token", "create", "http://base:8750", "field1", "--role", "relay"])
        (folder / "field" / "field1.secret").write_text(cairn(*command, folder=folder))

    def serve_field() -> None:
        command = page.here(upstream.removeprefix("serve ").split())
        page.serve("field", *[word.replace("BASE_KEY", key_of_base()) for word in command], folder=folder / "field")
        there = page.here(["map", "info", "http://field:8750/maps/lab"])
        wait_until(lambda: _succeeds(there, folder))

    def key_of_base() -> str:
        info = cairn(*page.here(["map", "info", "http://base:8750/maps/lab", "--json"]), folder=folder)
        return str(json.loads(info)["server_key"])

    def send_backup() -> None:
        command = [sys.executable, "-m", "cairn_client.main", "serve", "backup", "--data", "DIR", "-"]
        subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, check=True, timeout=60)

    upstream = (
        "serve --data DIR --upstream http://base:8750 --upstream-token-file field1.secret --trust-server BASE_KEY"
    )
    page.run(
        DOCS / "administrator.md",
        instead={
            "serve --data DIR --settings server.toml": lambda: page.serve(
                "HOST", "--data", "DIR", "--settings", "server.toml"
            ),
            "serve backup --data DIR -": send_backup,
            "serve --data NEW": serve_restored,
            "serve archive attic attic.cairn --data DIR": archive,
            "token create http://base:8750 field1 --role relay": create_relay,
            upstream: serve_field,
            "serve --data TRIAL --port 8751": lambda: page.serve("trial", "--data", "TRIAL"),
        },
        before={"map robots admit http://HOST:8750/maps/lab mole": lose_a_disk},
    )


def _succeeds(command: list[str], folder: Path) -> bool:
    """True if a command ends well."""
    try:
        cairn(*command, folder=folder)
    except AssertionError:
        return False
    return True


@pytest.mark.slow
def test_commands_of_the_page_about_the_experiment_run(page: Page) -> None:
    for name in ("labs", "corridors"):
        record_room(page.folder / name)
    page.serve("127.0.0.1", "--data", "server")
    page.run(DOCS / "paper-experiment.md", instead={})


@pytest.mark.slow
@pytest.mark.recording
@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_commands_of_the_page_for_calibration_engineers_run(page: Page) -> None:
    folder, chess = page.folder, Path(os.environ["CAIRN_TEST_DATA"]) / "opencv_stereo_chess"
    (folder / "camchain.yaml").write_text(CAMCHAIN)
    (folder / "info.yaml").write_text(ROS2_ECHO)
    for name in ("shots", "left", "right"):
        (folder / name).mkdir()
    for number in (1, 2, 3, 4, 5, 6):
        for side in ("left", "right"):
            shutil.copy(chess / f"{side}{number:02}.jpg", folder / side)
    for number in (1, 2):
        image = cv2.imread(str(chess / f"left{number:02}.jpg"))
        assert image is not None
        cv2.imwrite(str(folder / f"shots/{number}.png"), image)
    head = full_head(scale=0.5)
    record_drive(folder / "drive-1", head, scans=2)
    black_bodies(folder, np.random.default_rng(3), celsius=(10.0, 35.0, 60.0, 90.0)).rename(folder / "blackbody.csv")
    thermal = camera_from_field_of_view(SIZE[1], SIZE[0], horizontal_deg=60)
    camera = Rig(name="head", cameras={"thermal_left": mount_camera(Spectrum.THERMAL, thermal, np.eye(4))})

    def find_corners_of_the_right() -> None:
        assert "# and right/*.jpg" in (DOCS / "calibration-engineer.md").read_text()
        options = ("--board", "9x6", "--square", "0.025", "--output", "corners/right")
        cairn(*page.here(["calib", "corners", "right/*.jpg", *options]), folder=folder)

    def copy_rig(*names: str) -> None:
        for name in names:
            shutil.copy(folder / "rig.json", folder / name)

    def write_lenses() -> None:
        copy_rig("last-year.json", "rig-march.json", "rig-april.json")
        for name, form in (("{camera}.yaml", "opencv"), ("{camera}.cameramodel", "mrcal")):
            cairn("calib", "convert", "rig.json", name, "--format", form, "--drop", "calibration", folder=folder)
        (folder / "left.yaml").rename(folder / "factory.yaml")

    def write_rig(rig: Rig) -> None:
        (folder / "rig.json").write_bytes(rig.to_json())

    def write_recalibrated() -> None:
        moved = {name: mount_camera(m.spectrum, m.camera, m.transform @ step) for name, m in head.cameras.items()}
        (folder / "recalibrated.json").write_bytes(Rig(name="head", cameras=moved).to_json())

    step = np.eye(4)
    step[0, 3] = 0.02
    page.serve("127.0.0.1", "--data", "server")
    page.run(
        DOCS / "calibration-engineer.md",
        instead=dict.fromkeys(ELSEWHERE, lambda: None),
        before={
            "calib solve corners/left corners/right --spectrum colour --output rig.json --report report.html": (
                find_corners_of_the_right
            ),
            "calib report rig.json corners/left corners/right --output again.html": write_lenses,
            "calib verify rig.json drive-1 --output verified": lambda: write_rig(head),
            "calib thermal fit blackbody.csv calibrated.json --rig rig.json --camera thermal_left": (
                lambda: write_rig(camera)
            ),
            "reprocess cairn-mole --rig recalibrated.json --dry-run": write_recalibrated,
        },
    )
