"""`cairn sim` as a user types it."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from cairn_fusion.recording.recording import open_recording
from cairn_map.errors import BadInputError, ConflictError
from cairn_sim.sim_command import main


def test_scene_lists_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene"]) == 0
    out = capsys.readouterr().out
    for word in ("building", "small-room", "yard", "experiment", "orpheus", "lidar", "handheld", "599 solids"):
        assert word in out


def test_scene_describes_and_copies_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "mine.toml"
    assert main(["scene", "small-room", "--write", str(copy)]) == 0
    copy.write_text(copy.read_text().replace('name = "small-room"', 'name = "mine"'))
    assert main(["scene", str(copy)]) == 0
    assert "mine: 38 solids" in capsys.readouterr().out
    with pytest.raises(BadInputError, match="there already"):
        main(["scene", "small-room", "--write", str(copy)])
    with pytest.raises(BadInputError, match="knows no path in mine"):
        main(["show", str(copy)])


def test_show_writes_a_sheet_of_every_image_and_the_scene_from_above(tmp_path: Path) -> None:
    picture = tmp_path / "view.png"
    assert main(["show", "small-room", "--scale", "0.25", "--stop", "2", "--scan", "13", "--output", str(picture)]) == 0
    sheet, plan = cv2.imread(str(picture)), cv2.imread(str(tmp_path / "view-plan.png"))
    assert sheet is not None and plan is not None
    assert sheet.shape[0] > 1100 and plan.shape[1] > 800
    # Six pictures, none of them empty.
    for row in np.array_split(sheet, 3):
        for tile in np.array_split(row, 2, axis=1):
            assert tile.std() > 10


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["tof", "lidar", "handheld"])
def test_show_knows_every_robot(robot: str, tmp_path: Path) -> None:
    assert main(["show", "yard", "--robot", robot, "--output", str(tmp_path / "view.png")]) == 0
    assert (tmp_path / "view.png").stat().st_size > 10_000


@pytest.mark.slow
def test_record_writes_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lab"
    arguments = ["record", "building", str(folder), "--robot", "tof", "--path", "labs", "--stops", "3:4", "--seed", "7"]
    assert main(arguments) == 0
    assert "1 measurements, 36 scans" in capsys.readouterr().out
    assert len(open_recording(folder)) == 36
    assert (folder / "truth" / "tof" / "000035.npz").exists()
    with pytest.raises(ConflictError, match="must be empty"):
        main(arguments)


def test_scene_says_what_moves_and_when(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene", "moving-building"]) == 0
    out = capsys.readouterr().out
    assert "lab 1 door: 3600 to 7203 s" in out and "visitor: 0 to 20 s, again every 20 s" in out


def test_show_shows_a_time(tmp_path: Path) -> None:
    arguments = ["show", "moving-yard", "--robot", "tof", "--stop", "4", "--scan", "19", "--perfect"]
    pictures = []
    for seconds in ("0", "1700", "5401"):
        picture = tmp_path / f"{seconds}.png"
        assert main([*arguments, "--time", seconds, "--output", str(picture)]) == 0
        plan = cv2.imread(str(tmp_path / f"{seconds}-plan.png"))
        assert plan is not None
        pictures.append(plan)
    # The walker is elsewhere; then the car is gone, too.
    walked, driven = ((pictures[0] != other).any(axis=2).sum() for other in pictures[1:])
    assert 0 < walked < driven


@pytest.mark.parametrize("time", ["-1", "x", "nan", "1e10"])
def test_a_time_that_is_none_is_refused(time: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["show", "moving-yard", f"--time={time}"])
    assert "seconds" in capsys.readouterr().err


def test_record_goes_on_for_hours_and_renders_only_its_stops(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "day"
    arguments = ["record", "moving-yard", str(folder), "--robot", "lidar", "--stops", "3", "--rounds", "4"]
    assert main([*arguments, "--hours", "2", "--truth", "none"]) == 0
    assert "4 measurements, 4 scans\n  goes on for 1.5 h" in capsys.readouterr().out
    recording = open_recording(folder)
    times_s = [recording.scan(n).time_s for n in range(4)]
    np.testing.assert_allclose(np.diff(times_s), 1800)


def test_a_recording_that_the_disk_has_no_room_for_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**6))
    with pytest.raises(BadInputError, match=r"takes about .* GB, .* has 0.001 GB left") as caught:
        main(["record", "small-room", str(tmp_path / "far" / "away"), "--robot", "tof"])
    assert caught.value.kind == "no_space"
    assert not (tmp_path / "far").exists()


@pytest.mark.parametrize("stops", ["x", "3-4", "-1:2", ":"])
def test_stops_that_are_none_are_refused(stops: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["record", "small-room", str(tmp_path / "a"), f"--stops={stops}"])
    assert "from 0" in capsys.readouterr().err


def test_stops_beyond_the_path_are_refused_with_how_many_there_are(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="has 8 stops"):
        main(["record", "small-room", str(tmp_path / "a"), "--stops", "50:"])
    with pytest.raises(BadInputError, match="has no stop 50"):
        main(["show", "small-room", "--stop", "50"])


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["calibration", "targets"])
def test_board_and_discs_can_be_shown_and_recorded(scene: str, tmp_path: Path) -> None:
    assert (
        main(["show", scene, "--scale", "0.25", "--stop", "1", "--scan", "12", "--output", str(tmp_path / "v.png")])
        == 0
    )
    arguments = ["record", scene, str(tmp_path / "rec"), "--scale", "0.25", "--stops", "1", "--raw"]
    assert main(arguments) == 0
    assert len(list((tmp_path / "rec" / "raw" / "thermal_left").iterdir())) == 36


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["show", "small-room", "--output", "/nowhere/x.png"],
        ["show", "small-room", "--output", "/"],
        ["scene", "small-room", "--write", "/nowhere/x.toml"],
        ["record", "small-room", "/proc/rec"],
    ],
)
def test_what_cannot_be_written_is_refused_by_name(arguments: list[str]) -> None:
    with pytest.raises(BadInputError, match=r"cannot (write|record into) /"):
        main(arguments)


def test_only_scans_that_a_stop_has_are_shown(tmp_path: Path) -> None:
    for scan in ("36", "-5"):
        with pytest.raises(BadInputError, match="no stop 1 with a scan"):
            main(["show", "small-room", "--stop", "1", "--scan", scan])
    picture = tmp_path / "v.png"
    assert main(["show", "small-room", "--robot", "tof", "--speed", "1", "--stop", "2", "--output", str(picture)]) == 0


def test_a_scene_of_the_ground_alone_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "ground.toml"
    file.write_text(
        'format = "cairn-scene"\nversion = 1\nname = "ground"\nambient_c = 20.0\n'
        '[materials]\ngrass = {colour = "#406030"}\n'
        '[areas.all]\nsolids = [{name = "ground", plane = true, at = [0, 0, 0], surface = "grass"}]\n'
    )
    assert main(["scene", str(file)]) == 0
    assert "ground: 1 solids" in capsys.readouterr().out
