"""`cairn calib solve`: from folders of corner documents to rig.json, a report and its JSON."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cairn_calib.simulated_views import BOARD, ranges_of, views_of, world

from cairn_calib.board_views import BoardViews, frame_of, read_board_views
from cairn_calib.calib_command import main
from cairn_calib.corner_file import corner_file
from cairn_calib.corners import Attempt, Detection
from cairn_calib.rig import Spectrum, load_rig
from cairn_map.errors import BadInputError

PAIR = ("tof", "left")


def written(views: BoardViews, folder: Path) -> dict[str, Path]:
    """The views as corner documents, a folder for each camera."""
    for view in views.views:
        (folder / view.camera).mkdir(exist_ok=True)
        found = Detection(view.corners, (Attempt("saddles", 1, "found", ""),))
        size = views.sizes_px[view.camera]
        document = corner_file(found, BOARD, image=view.image, data=b"", size=size, polarity="normal")
        name = f"{Path(view.image).stem}.json"
        (folder / view.camera / name).write_text(document.model_dump_json(), encoding="utf-8")
    return {name: folder / name for name in views.cameras}


def test_folders_of_corners_become_a_rig_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = world(8, seed=6, names=PAIR, bias=(0.02, 0.0, 0.0, 0.0))
    folders = written(views_of(truth, seed=6), tmp_path)
    (tmp_path / "range").mkdir()
    for each in ranges_of(truth, "tof", seed=6, sigma_m=0.006):
        counts = np.nan_to_num(1000 * each.range_m).round().astype(np.uint16)
        cv2.imwrite(str(tmp_path / "range" / f"tof{each.frame}.png"), counts)
    report = tmp_path / "report.html"
    paths = [str(folder) for folder in folders.values()]
    options = ["--spectrum", "tof=range,left=colour", "--output", str(tmp_path / "rig.json"), "--report", str(report)]
    assert main(["solve", *paths, *options, "--range", str(tmp_path / "range"), "--name", "head"]) == 0
    told = capsys.readouterr()
    assert re.search(r"left +8 images +\d+ points +0 outliers +noise 0\.1", told.out)
    assert "warning: tof: no corner lies near the image's corners" in told.err
    rig = load_rig(tmp_path / "rig.json")
    assert rig["tof"].spectrum is Spectrum.RANGE
    assert rig["left"].transform[:3, 3] == pytest.approx(truth.T_rig_camera("left")[:3, 3], abs=0.02)
    assert rig.calibration is not None
    assert rig.calibration.gauge == "tof"
    assert len(rig.calibration.inputs) == 16
    bias = rig["tof"].range_bias
    assert bias is not None
    files = [str(tmp_path / name) for name in ("rig.json", "tof.cameramodel")] + ["--camera", "tof"]
    with pytest.raises(BadInputError, match=r"cameras\.tof\.range_bias"):
        main(["convert", *files])
    assert main(["convert", *files, "--drop", "range_bias,calibration"]) == 0
    page = report.read_text(encoding="utf-8")
    assert "range offset, mm" in page
    assert not re.search(r"(src|href)=", page)
    document = json.loads(report.with_suffix(".json").read_text())
    offset = next(each for each in document["parameters"] if each["name"] == "offset_m")
    assert bias.offset_m == pytest.approx(offset["value"])
    assert bias.covariance[0, 0] == pytest.approx(offset["sigma"] ** 2)
    assert abs(offset["value"] - 0.02) < 4 * offset["sigma"] < 0.02
    assert {each["kind"] for each in document["warnings"]} >= {"tof_edge"}
    assert document["cameras"]["left"]["images"][0]["rms_px"] < 0.3


def test_frames_go_by_the_last_number_in_a_name() -> None:
    assert frame_of("left03") == frame_of("2026-11-21_tof_3") == "000003"
    assert frame_of("corner") == "corner"


def test_what_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    views = views_of(world(3, seed=6, names=PAIR), seed=6)
    folders = written(views, tmp_path)
    assert len(read_board_views(folders).views) == 6
    with pytest.raises(BadInputError, match=r"--spectrum does not say what left sees"):
        main(["solve", *map(str, folders.values()), "--spectrum", "tof=range", "--output", str(tmp_path / "rig.json")])
    with pytest.raises(BadInputError, match="no corner documents"):
        read_board_views({"tof": tmp_path})
    extra = folders["tof"] / "again-001.json"
    extra.write_bytes((folders["tof"] / "tof001.json").read_bytes())
    with pytest.raises(BadInputError, match="are of one frame"):
        read_board_views(folders)
    extra.unlink()
    other = folders["left"] / "left002.json"
    other.write_text(other.read_text().replace('"columns":7', '"columns":8'))
    with pytest.raises(BadInputError, match="are of two boards"):
        read_board_views(folders)
