"""`cairn calib report`: the page again with what came to rig.json since, and only from the corners that went in."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import views_of, world, write_corner_files

from cairn_calib.cli.main import main
from cairn_calib.rig.radiometry import PlanckResponse, Radiometry
from cairn_calib.rig.rig import load_rig, rig_from_json
from cairn_map.errors import BadInputError

NAMES = ("tof", "thermal-left")


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A folder with rig.json, and the folders of its corners, with a picture next to each document."""
    folder = tmp_path_factory.mktemp("solved")
    folders = write_corner_files(views_of(world(6, seed=6, names=NAMES), seed=6), folder)
    for documents in folders.values():
        for document in documents.glob("*.json"):
            cv2.imwrite(str(document.with_suffix(".png")), np.full((96, 128, 3), 90, np.uint8))
    paths = [str(each) for each in folders.values()]
    options = ["--spectrum", "tof=range,thermal-left=thermal", "--output", str(folder / "rig.json")]
    assert main(["solve", *paths, *options, "--report", str(folder / "first.html")]) == 0
    return folder, paths


def test_the_report_comes_again_with_radiometry_and_images(
    solved: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, paths = solved
    rig = load_rig(folder / "rig.json")
    first = (folder / "first.html").read_text(encoding="utf-8")
    assert "thermal-left: <b>not radiometric</b>" in first
    assert json.loads((folder / "first.json").read_text())["radiometry"] == {"thermal-left": None}
    known = Radiometry(
        response=PlanckResponse(r=3e5, b_k=1428.0), range_k=(280.0, 380.0), noise_counts=2.0, source="two black bodies"
    )
    camera = rig["thermal-left"].model_copy(update={"radiometry": known})
    (folder / "known.json").write_bytes(
        rig.model_copy(update={"cameras": {**rig.cameras, "thermal-left": camera}}).to_json()
    )
    assert main(["report", str(folder / "known.json"), *paths, "--output", str(folder / "again.html")]) == 0
    assert "comes from these corners" in capsys.readouterr().out
    page = (folder / "again.html").read_text(encoding="utf-8")
    assert "not radiometric" not in page and "two black bodies" in page
    assert page.count("data:image/jpeg;base64,") == 12 + 2 and page.count(", undistorted: straight lines") == 2
    assert page.count("Range of validity: green") == 2 and "rms 0." in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    counts = 2.0 / float(known.response.slope(280.0))
    assert f"<td>{counts:.3f}</td>" in page
    document = json.loads((folder / "again.json").read_text())
    assert document["radiometry"]["thermal-left"]["range_k"] == [280.0, 380.0]
    valid = document["cameras"]["tof"]["validity"]
    assert 0.1 < valid["image_share"] < 1 and len(valid["hull_px"]) > 3
    seen = {each["range_m"]: each["is_seen"] for each in valid["by_range"]}
    assert seen[valid["nearest_m"]] and seen[valid["farthest_m"]] and not seen[20.0]
    sigmas = [(each["inside_sigma_px"], each["outside_sigma_px"]) for each in valid["by_range"]]
    assert all(0 < inside < outside for inside, outside in sigmas)


def test_another_rig_or_other_corners_are_refused(solved: tuple[Path, list[str]], tmp_path: Path) -> None:
    folder, paths = solved
    output = ["--output", str(tmp_path / "r.html")]
    with pytest.raises(BadInputError, match=r"give another rig.*--solved-with"):
        main(["report", str(folder / "rig.json"), *paths, *output, "--solved-with", "--flat --pitch-sigma 0.01"])
    with pytest.raises(BadInputError, match=r"must be of .*cameras tof, thermal-left, got tof"):
        main(["report", str(folder / "rig.json"), paths[0], *output])
    document = json.loads((folder / "rig.json").read_text())
    document["calibration"]["inputs"][0]["sha256"] = "0" * 64
    other = tmp_path / "other.json"
    other.write_bytes(rig_from_json(json.dumps(document).encode()).to_json())
    with pytest.raises(BadInputError, match=r"was not solved from these corners: tof/"):
        main(["report", str(other), *paths, *output])
    del document["calibration"]
    other.write_bytes(rig_from_json(json.dumps(document).encode()).to_json())
    with pytest.raises(BadInputError, match="does not say how it was calibrated"):
        main(["report", str(other), *paths, *output])
    assert not (tmp_path / "r.html").exists()


def test_a_report_never_overwrites_its_rig(solved: tuple[Path, list[str]]) -> None:
    folder, paths = solved
    before = (folder / "rig.json").read_bytes()
    with pytest.raises(BadInputError, match=r"would replace .*rig.json: name it otherwise"):
        main(["report", str(folder / "rig.json"), *paths, "--output", str(folder / "rig.json")])
    # The page rig.html next to rig.json has its numbers in rig-report.json.
    assert main(["report", str(folder / "rig.json"), *paths, "--output", str(folder / "rig.html")]) == 0
    assert json.loads((folder / "rig-report.json").read_text())["format"] == "cairn-calibration-report"
    options = ["--output", str(folder / "again.json"), "--report", str(folder / "again.html")]
    assert main(["solve", *paths, "--spectrum", "tof=range,thermal-left=thermal", *options]) == 0
    assert load_rig(folder / "again.json").name == "rig"
    assert json.loads((folder / "again-report.json").read_text())["verdict"]["usable"]
    assert (folder / "rig.json").read_bytes() == before
