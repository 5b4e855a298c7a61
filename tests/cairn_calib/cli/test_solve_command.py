"""`cairn calib solve`: from folders of corner documents to rig.json, a report and its JSON."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import ranges_of, views_of, world, write_corner_files

from cairn_calib.cli.main import main
from cairn_calib.rig.rig import Spectrum, load_rig
from cairn_calib.solve.board_views import read_board_views
from cairn_map.errors import BadInputError

PAIR = ("tof", "left")


@pytest.mark.slow
def test_folders_of_corners_become_a_rig_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pattern_m = 0.006 * np.random.default_rng(0).normal(size=(144, 176))
    truth = world(8, seed=6, names=PAIR, bias=(0.02, 0.0, 0.0, 0.0), pattern_m=pattern_m, has_amplitude=True)
    folders = write_corner_files(views_of(truth, seed=6), tmp_path)
    for name in ("range", "amplitude"):
        (tmp_path / name).mkdir()
    for each in ranges_of(truth, "tof", seed=6, sigma_m=0.006):
        counts = np.nan_to_num(1000 * each.range_m).round().astype(np.uint16)
        cv2.imwrite(str(tmp_path / "range" / f"tof{each.frame}.png"), counts)
        assert each.amplitude is not None
        cv2.imwrite(str(tmp_path / "amplitude" / f"tof{each.frame}.png"), each.amplitude)
    report = tmp_path / "report.html"
    paths = [str(folder) for folder in folders.values()]
    options = ["--spectrum", "tof=range,left=colour", "--output", str(tmp_path / "rig.json"), "--report", str(report)]
    options += ["--range", str(tmp_path / "range"), "--amplitude", str(tmp_path / "amplitude")]
    assert main(["solve", *paths, *options, "--modulation-mhz", "15", "--name", "head"]) == 0
    told = capsys.readouterr()
    assert re.search(r"left +8 images +\d+ points +0 outliers +noise 0\.1", told.out)
    assert re.search(r"tof ranges: 8 images +\d+ pixels.*, amplitude; pixels differ by \d\.\d mm", told.out)
    assert re.search(r"^usable: where a pixel of tof appears in left is known to 0\.\d+ px", told.out, re.MULTILINE)
    assert "note: tof: no corner lies near the image's corners" in told.err
    assert re.search(r"note: tof: board pixels from .* of wave 4 of its circular error, left out", told.err)
    rig = load_rig(tmp_path / "rig.json")
    assert rig["tof"].spectrum is Spectrum.RANGE
    assert rig["left"].transform[:3, 3] == pytest.approx(truth.T_rig_camera("left")[:3, 3], abs=0.02)
    assert rig.calibration is not None
    assert rig.calibration.gauge == "tof"
    named = [each.name.partition("/")[0] for each in rig.calibration.inputs]
    assert [named.count(what) for what in ("tof", "left", "range", "amplitude")] == [8, 8, 8, 8]
    bias = rig["tof"].range_bias
    assert bias is not None and bias.by_amplitude is not None and bias.wiggle is None
    assert bias.pixel_offsets is not None
    files = [str(tmp_path / name) for name in ("rig.json", "tof.cameramodel")] + ["--camera", "tof"]
    with pytest.raises(BadInputError, match=r"cameras\.tof\.range_bias"):
        main(["convert", *files])
    assert main(["convert", *files, "--drop", "range_bias,calibration"]) == 0
    page = report.read_text(encoding="utf-8")
    assert "Ranges of tof" in page and "more at half the usual amplitude, mm" in page
    assert "Left out, for the images do not determine it: circular error." in page
    assert "Offsets of the pixels" in page
    assert not re.search(r"(src|href)=(?!\"#)", page)
    document = json.loads(report.with_suffix(".json").read_text())
    offset = next(each for each in document["parameters"] if each["name"] == "offset_m")
    assert bias.offset_m == pytest.approx(offset["value"])
    units = {each["name"]: each["unit"] for each in document["parameters"]}
    named = ("fx", "k1", "rx", "tx", "warp_x", "scale", "offset_m", "faint_m")
    assert [units[name] for name in named] == ["px", "1", "rad", "m", "m", "1", "m", "m"]
    assert bias.covariance[0, 0] == pytest.approx(offset["sigma"] ** 2)
    assert abs(offset["value"] - 0.02) < 4 * offset["sigma"] < 0.02
    assert {each["kind"] for each in document["warnings"]} >= {"tof_edge", "range_wiggle"}
    assert document["ranges"]["pixels"]["pattern_sigma_m"] == pytest.approx(0.006, rel=0.1)
    assert document["ranges"]["harmonics"] == [] and document["ranges"]["modulation_hz"] == 15e6
    assert document["cameras"]["left"]["images"][0]["rms_px"] < 0.3
    again = ["report", str(tmp_path / "rig.json"), *paths, "--output", str(tmp_path / "again.html")]
    told_with = f"--range {tmp_path}/range --amplitude {tmp_path}/amplitude --modulation-mhz 15"
    assert main([*again, "--solved-with", told_with]) == 0
    assert json.loads((tmp_path / "again.json").read_text())["ranges"] == document["ranges"]
    with pytest.raises(BadInputError, match=r"not solved from these corners: (amplitude|range)/"):
        main(again)
    # Of a rig of before range images had digests, its range bias tells.
    older = json.loads((tmp_path / "rig.json").read_text())
    older["calibration"]["inputs"] = older["calibration"]["inputs"][:16]
    (tmp_path / "rig.json").write_text(json.dumps(older))
    with pytest.raises(BadInputError, match=r"give another rig than .*rig.json, inf sigma off.*--range DIR"):
        main(again)


def test_two_range_images_of_one_frame_are_refused(tmp_path: Path) -> None:
    folders = write_corner_files(views_of(world(3, seed=6, names=PAIR), seed=6), tmp_path)
    (tmp_path / "range").mkdir()
    for name in ("tof_001", "tof-001"):
        cv2.imwrite(str(tmp_path / "range" / f"{name}.png"), np.full((144, 176), 1500, np.uint16))
    options = ["--spectrum", "tof=range,left=colour", "--output", str(tmp_path / "rig.json")]
    with pytest.raises(BadInputError, match=r"tof-001.png and .*tof_001.png are range images of one frame"):
        main(["solve", *map(str, folders.values()), *options, "--range", str(tmp_path / "range")])


def test_what_belongs_to_range_images_is_not_asked_without_them(tmp_path: Path) -> None:
    folders = write_corner_files(views_of(world(3, seed=6, names=PAIR), seed=6), tmp_path)
    options = [
        *map(str, folders.values()),
        "--spectrum",
        "tof=range,left=colour",
        "--output",
        str(tmp_path / "rig.json"),
    ]
    with pytest.raises(BadInputError, match="add --range"):
        main(["solve", *options, "--modulation-mhz", "15"])
    with pytest.raises(BadInputError, match=r"0\.1 to 10000 MHz, got 15e\+06|got 1\.5e\+07"):
        main(["solve", *options, "--range", str(tmp_path), "--modulation-mhz", "15000000"])
    with pytest.raises(BadInputError, match="no range images"):
        main(["solve", *options, "--range", str(tmp_path), "--modulation-mhz", "15"])


def test_what_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    views = views_of(world(3, seed=6, names=PAIR), seed=6)
    folders = write_corner_files(views, tmp_path)
    assert len(read_board_views(folders).views) == 6
    with pytest.raises(BadInputError, match=r"--spectrum does not say what left sees"):
        main(["solve", *map(str, folders.values()), "--spectrum", "tof=range", "--output", str(tmp_path / "rig.json")])
    with pytest.raises(BadInputError, match="no corner documents"):
        read_board_views({"tof": tmp_path})
    extra = folders["tof"] / "tof-001.json"
    document = (folders["tof"] / "tof001.json").read_text()
    extra.write_text(document)
    with pytest.raises(BadInputError, match="are of one frame, 001: say with --frame REGEX"):
        read_board_views(folders)
    # A document without corners collides with none.
    extra.write_text(json.dumps({**json.loads(document), "corners": []}))
    assert len(read_board_views(folders).views) == 6
    extra.unlink()
    other = folders["left"] / "left002.json"
    other.write_text(other.read_text().replace('"columns":7', '"columns":8'))
    with pytest.raises(BadInputError, match="are of two boards"):
        read_board_views(folders)


def renumber(folder: Path, names: list[str]) -> None:
    """Give the documents of a folder other names, in their order."""
    for path, name in zip(sorted(folder.glob("*.json")), names, strict=True):
        path.rename(path.with_name(f"{name}.json"))


def test_images_of_different_moments_are_not_paired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = write_corner_files(views_of(world(6, seed=6, names=PAIR), seed=6), tmp_path)
    # The same number once, but no moment: 200 of the one and 0200 of the other.
    renumber(folders["tof"], [f"{n}" for n in range(200, 206)])
    renumber(folders["left"], [f"{n:04d}" for n in range(200, 206)])
    options = [*map(str, folders.values()), "--spectrum", "tof=range,left=colour"]
    options += ["--output", str(tmp_path / "rig.json")]
    with pytest.raises(BadInputError, match=r"no board was seen by left together with tof.*say with --frame REGEX"):
        main(["solve", *options])
    assert "frames that both saw: tof and left 0\n" in capsys.readouterr().out
    renumber(folders["left"], ["200", "301", "302", "303", "304", "305"])
    with pytest.raises(BadInputError, match="left and tof saw the board together in one frame alone, 200"):
        main(["solve", *options])
    assert not (tmp_path / "rig.json").exists()


def test_an_expression_pairs_names_that_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = write_corner_files(views_of(world(6, seed=6, names=PAIR), seed=6), tmp_path)
    renumber(folders["tof"], [f"{n}-of-6" for n in range(1, 7)])
    renumber(folders["left"], [f"left0{n}" for n in range(1, 7)])
    options = [*map(str, folders.values()), "--spectrum", "tof=range,left=colour"]
    options += ["--output", str(tmp_path / "rig.json")]
    assert main(["solve", *options, "--frame", "0*([1-6])"]) == 0
    assert "frames that both saw: tof and left 6\n" in capsys.readouterr().out
