"""`cairn telepresence` on a recording: one picture, a folder of pictures, and what is refused."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from tests.fixtures.server.live import Live

from cairn_client.cli.robots import telepresence as telepresence_command
from cairn_client.cli.robots.telepresence import main, publish_views
from cairn_client.cli.source_arguments import asked_source
from cairn_client.http.api import MapApi
from cairn_fusion.recording.images import read_colour
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.scan import Scan
from cairn_map.arrays import Rgb
from cairn_map.commits.ids import new_incarnation, robot_name
from cairn_map.errors import BadInputError, NotFoundError, UnreachableError
from cairn_map.wire.messages import Register
from cairn_sim.robots.record import Plan, record
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene, shipped_text


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Live]:
    with Live(tmp_path / "server") as made:
        yield made


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("telepresence") / "lab"
    plan = Plan(
        scene=load_scene("small-room"),
        robot=ROBOTS["orpheus"],
        path="west",
        scale=0.125,
        truth="none",
        speed_m_s=0.5,
        rate_hz=1.0,
        last_stop=3,
    )
    # Colour images of 160 x 120, which are shown twice as large.
    assert len(list(record(plan, folder, scene_text=shipped_text("small-room")))) == 3
    return folder


def test_one_scan_becomes_a_png(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(recording), "--output", str(tmp_path / "view.png"), "--scan", "1", "--mode", "side-by-side"]) == 0
    assert "side-by-side, scan 1 of 3" in capsys.readouterr().out
    assert read_colour(tmp_path / "view.png").shape == (240, 640, 3)


def test_all_scans_become_a_folder_with_one_scale(recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    assert main([str(recording), "--output", str(folder), "--band", "-5:40", "--scale", "-10:50"]) == 0
    pictures = [read_colour(path) for path in sorted(folder.iterdir())]
    assert len(pictures) == 3 and pictures[0].shape == (240, 320, 3)
    assert not np.array_equal(pictures[0], pictures[2])


def test_what_a_robot_sees_is_shown_to_its_team(
    recording: Path, live: Live, capsys: pytest.CaptureFixture[str]
) -> None:
    row = live.new_map()
    url = f"http://127.0.0.1:{live.port}/maps/{row.name}"
    view = [str(recording), "--publish", url, "--rate", "1000"]
    with pytest.raises(NotFoundError, match="no branch 'scout'"):
        main([*view, "--robot", "scout"])
    with MapApi(f"http://127.0.0.1:{live.port}") as api:
        api.register(row.name, Register(robot=robot_name("scout"), incarnation=new_incarnation()))
    assert main([*view, "--robot", "scout"]) == 0
    assert "scout showed 3 pictures" in capsys.readouterr().out
    with MapApi(f"http://127.0.0.1:{live.port}") as api:
        shown = cv2.imdecode(np.frombuffer(api.view(row.name, "scout"), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (240, 320, 3)
    with pytest.raises(BadInputError, match="whose view"):
        main(view)
    with MapApi("http://127.0.0.1:9") as nobody:
        assert publish_views([np.zeros((6, 8, 3), np.uint8)], nobody, "lab", "scout") == (0, 1)


def test_a_server_that_wants_no_pictures_for_now_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def put_view(name: str, branch: str, picture: bytes) -> None:
        asked.append(branch)
        if len(asked) == 2:
            raise UnreachableError("too_many_views", "30 pictures a second", retry_after_s=3600)

    with MapApi("http://127.0.0.1:9") as api:
        monkeypatch.setattr(api, "put_view", put_view)
        assert publish_views([np.zeros((6, 8, 3), np.uint8)] * 5, api, "lab", "scout") == (1, 4)
    assert len(asked) == 2


def test_what_cannot_be_is_refused_in_words(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="scans 0 to 2"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--scan", "7"])
    with pytest.raises(BadInputError, match="no camera 'nose'"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--camera", "nose"])
    with pytest.raises(BadInputError, match="lower to a higher"):
        main([str(recording), "--output", str(tmp_path / "view.png"), "--scale", "40:20"])
    with pytest.raises(BadInputError, match="cannot write"):
        main([str(recording), "--output", str(tmp_path / "none" / "view.png")])
    for wrong in (["--serve", "loud"], ["--rate", "0", "--serve", "0"], ["--scale", "warm", "--serve", "0"], []):
        with pytest.raises(SystemExit):
            main([str(recording), *wrong])


@pytest.mark.parametrize(
    ("mode", "options"),
    [
        ("map", ["--hotter", "40"]),
        ("map", ["--band", "20:30"]),
        ("map", ["--alpha", "0.3"]),
        ("map", ["--no-marker"]),
        ("side-by-side", ["--hotter", "40"]),
        ("stereo", ["--camera", "colour_left"]),
        ("colour-on-thermal", ["--layer", "depth"]),
        ("thermal-on-colour", ["--sigma", "0.1,1"]),
    ],
)
def test_what_a_mode_would_not_show_is_refused(recording: Path, tmp_path: Path, mode: str, options: list[str]) -> None:
    with pytest.raises(BadInputError, match=f"--mode {mode} does not show {options[0]}"):
        main([str(recording), "--mode", mode, *options, "--output", str(tmp_path / "view.png")])


class WithGaps:
    """A recording, of some of whose scans there is no colour image."""

    def __init__(self, source: ScanSource, gaps: list[int]) -> None:
        self.name, self.rig = source.name, source.rig
        self._source, self._gaps = source, gaps

    def __len__(self) -> int:
        return len(self._source)

    def scan(self, index: int) -> Scan:
        scan = self._source.scan(index)
        return replace(scan, colour={}) if index in self._gaps else scan


@pytest.fixture
def gaps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Scans without colour images; to be filled in."""
    missing: list[int] = []

    def opened(*args: Any, **options: Any) -> WithGaps:
        return WithGaps(asked_source(*args, **options), missing)

    monkeypatch.setattr(telepresence_command, "asked_source", opened)
    return missing


@pytest.mark.parametrize("without", [[0], [1], [2]])
def test_a_scan_without_an_image_is_told_and_left_out(
    recording: Path, live: Live, gaps: list[int], without: list[int], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    row = live.new_map()
    with MapApi(f"http://127.0.0.1:{live.port}") as api:
        api.register(row.name, Register(robot=robot_name("scout"), incarnation=new_incarnation()))
    gaps += without
    url = f"http://127.0.0.1:{live.port}/maps/{row.name}"
    assert main([str(recording), "--publish", url, "--rate", "1000", "--robot", "scout"]) == 0
    told = capsys.readouterr().out
    assert f"left out scan {without[0]}: the scan has no image of 'colour_left'" in told
    assert "scout showed 2 pictures" in told
    assert main([str(recording), "--output", str(tmp_path / "pictures")]) == 0
    assert "wrote 2 pictures" in capsys.readouterr().out
    assert f"{without[0]:06d}.png" not in {path.name for path in (tmp_path / "pictures").iterdir()}
    gaps += [0, 1, 2]
    with pytest.raises(BadInputError, match="no image"):
        main([str(recording), "--publish", url, "--rate", "1000", "--robot", "scout"])


def test_a_stream_goes_on_without_the_scans_that_have_no_image(
    recording: Path, gaps: list[int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Rgb] = []

    def show(picture: Rgb) -> None:
        shown.append(picture)
        if len(shown) == 5:
            raise KeyboardInterrupt

    gaps.append(0)
    monkeypatch.setattr(telepresence_command, "Latest", lambda: SimpleNamespace(show=show))
    monkeypatch.setattr(
        "cairn_fusion.view.mjpeg_server.stream_pictures", lambda *_, **__: nullcontext("http://127.0.0.1:0/")
    )
    with pytest.raises(KeyboardInterrupt):
        main([str(recording), "--serve", "0", "--rate", "1000"])
    assert capsys.readouterr().out.count("left out scan") == 1
    assert all(np.array_equal(shown[n], shown[n + 2]) for n in range(3)) and not np.array_equal(shown[0], shown[1])
    gaps += [1, 2]
    with pytest.raises(BadInputError, match="no image"):
        main([str(recording), "--serve", "0", "--rate", "1000"])
