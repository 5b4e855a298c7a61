"""`--prior` and `--hold` of `cairn calib solve`: files of several formats, single numbers, and what is refused."""

import argparse
import json
import re
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import LENSES, SPECTRA, views_of, world, write_corner_files

from cairn_calib.cli.known_lenses import with_known
from cairn_calib.cli.main import main
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.rig import Rig, load_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_map.errors import BadInputError

PAIR = ("tof", "left")
TRUTH = world(8, seed=6, names=PAIR)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A folder with last year's rig.json, also as camera files, and the arguments of a solve of other images."""
    folder = tmp_path_factory.mktemp("known")
    (folder / "old").mkdir()
    old = [str(each) for each in write_corner_files(views_of(TRUTH, seed=5), folder / "old").values()]
    spectrum = ["--spectrum", "tof=range,left=colour"]
    assert main(["solve", *old, *spectrum, "--output", str(folder / "last.json")]) == 0
    drop = ["--drop", "calibration,T_rig_camera"]
    assert main(["convert", str(folder / "last.json"), str(folder / "{camera}.yaml"), "--format", "ros", *drop]) == 0
    paths = [str(each) for each in write_corner_files(views_of(TRUTH, seed=6), folder).values()]
    return folder, [*paths, *spectrum]


def solve(solved: tuple[Path, list[str]], output: Path, *options: str) -> Rig:
    assert main(["solve", *solved[1], "--output", str(output), *options]) == 0
    return load_rig(output)


def sigmas(rig: Rig) -> dict[tuple[str, str], float]:
    assert rig.calibration is not None and rig.calibration.covariance is not None
    known = rig.calibration.covariance
    return {(each.camera, each.name): s for each, s in zip(known.parameters, known.sigmas.tolist(), strict=True)}


def lens(rig: Rig, name: str) -> Lens:
    found = rig[name].camera
    assert isinstance(found, Lens)
    return found


def test_a_held_file_keeps_its_numbers_and_the_report_comes_again(
    solved: tuple[Path, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    last = load_rig(solved[0] / "last.json")
    rig = solve(solved, tmp_path / "rig.json", "--hold", f"left={solved[0]}/last.json")
    assert lens(rig, "left") == lens(last, "left") and lens(rig, "tof") != lens(last, "tof")
    assert {name for camera, name in sigmas(rig) if camera == "left"} == {"rx", "ry", "rz", "tx", "ty", "tz"}
    # A rig says what was held, so that its report needs no option.
    report = ["report", str(tmp_path / "rig.json"), *solved[1][:2], "--output", str(tmp_path / "r.html")]
    assert main(report) == 0
    assert "comes from these corners" in capsys.readouterr().out
    # All lenses of a file; of one number.
    rig = solve(solved, tmp_path / "rig.json", "--hold", f"{solved[0]}/last.json")
    assert [lens(rig, name) for name in PAIR] == [lens(last, name) for name in PAIR]
    rig = solve(solved, tmp_path / "rig.json", "--hold", "left.k3=0", "--hold", "left.cx=640.5")
    assert lens(rig, "left").distortion[4] == 0.0 and lens(rig, "left").centre_px[0] == 640.5
    assert {("left", "k3"), ("left", "cx")}.isdisjoint(sigmas(rig)) and ("left", "cy") in sigmas(rig)


def test_priors_of_a_rig_of_another_program_and_of_a_data_sheet_sharpen_a_lens(
    solved: tuple[Path, list[str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = sigmas(solve(solved, tmp_path / "rig.json"))
    rig = solve(solved, tmp_path / "rig.json", "--prior", f"{solved[0]}/last.json")
    assert all(sigmas(rig)[camera, "fx"] < 0.85 * plain[camera, "fx"] for camera in PAIR)
    told = capsys.readouterr().out
    assert re.search(r"known before: fx, fy, .* of left \(.*last.json\), [0-2]\.\d sigma off\n", told)
    rig = solve(solved, tmp_path / "rig.json", "--prior", f"left={solved[0]}/left.yaml+-0.1")
    assert sigmas(rig)["left", "fx"] < 0.9 * plain["left", "fx"]
    fx = LENSES["left"].focal_px[0]
    options = ["--prior", f"left.fx={fx}+-0.5", "--prior", "left.tx=-0.1+-1e-4", "--report", str(tmp_path / "r.html")]
    rig = solve(solved, tmp_path / "rig.json", *options)
    assert sigmas(rig)["left", "fx"] < 0.5 and sigmas(rig)["left", "tx"] < 1e-4
    known = json.loads((tmp_path / "r.json").read_text())["known"]
    assert [each["names"] for each in known] == [["fx"], ["tx"]] and known[0]["enlarged"] == 1.0
    assert "known before" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_file_s_pixels_are_as_good_as_stated(solved: tuple[Path, list[str]]) -> None:
    args = argparse.Namespace(prior=[f"left={solved[0]}/left.yaml+-0.5"], hold=[])
    plan = usual_plan({name: SPECTRA[name] for name in PAIR})
    (known,) = with_known(plan, args, {name: (LENSES[name].width, LENSES[name].height) for name in PAIR}).known
    left = lens(load_rig(solved[0] / "last.json"), "left")
    assert known.names == left.intrinsic_names and known.values == pytest.approx(left.intrinsics)
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 40), np.linspace(0, 959, 30)), axis=-1).reshape(-1, 2)
    J = left.projection(left.unproject(grid)).by_intrinsics
    covariance = J @ known.covariance @ np.swapaxes(J, 1, 2)
    # Of one axis, over the image, whose very corners are a little less certain than the grid that it is held to.
    assert np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 2) == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--prior", "left=FOLDER/left.yaml"], r"does not say how certain its lens is: .*left.yaml\+-0.5, or --hold"),
        (["--hold", "left=FOLDER/left.yaml+-1"], r"\+-PX is of --prior"),
        (
            ["--hold", "tof=FOLDER/left.yaml"],
            r"left.yaml is of 1280 x 960 pixels, the images are of 176 x 144",
        ),
        (["--hold", "left=FOLDER/last.json#right"], "has no camera right, but tof, left"),
        (["--prior", "left.fx=1330"], r"is left.fx=VALUE\+-SIGMA, such as left.fx=1330\+-5, got left.fx=1330"),
        (["--prior", "left.fx=1330+-0"], r"is left.fx=VALUE\+-SIGMA"),
        (["--hold", "left.tx=0.1"], "a place takes a --prior, of another camera than tof"),
        (["--prior", "tof.tx=0.1+-0.1"], "a place takes a --prior, of another camera than tof"),
        (["--prior", "left.k6=0+-0.1"], "k6 of left is held"),
        (["--hold", "left=FOLDER/last.json", "--prior", "left.fx=1330+-1"], "fx of left is held"),
        (["--hold", "middle=rig.json"], "CAM one of tof, left"),
        (["--hold", "left.kk=1"], "CAM=FILE or CAM.NAME=VALUE"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    solved: tuple[Path, list[str]], tmp_path: Path, options: list[str], words: str
) -> None:
    named = [each.replace("FOLDER", str(solved[0])) for each in options]
    with pytest.raises(BadInputError, match=words):
        main(["solve", *solved[1], "--output", str(tmp_path / "rig.json"), *named])


def test_a_single_camera_that_is_held_leaves_nothing_to_solve(solved: tuple[Path, list[str]], tmp_path: Path) -> None:
    options = ["--spectrum", "colour", "--output", str(tmp_path / "rig.json"), "--hold", f"{solved[0]}/last.json"]
    with pytest.raises(BadInputError, match="nothing is left to solve"):
        main(["solve", solved[1][1], *options])


def test_a_camera_info_as_ros_prints_it_is_a_known_lens(solved: tuple[Path, list[str]], tmp_path: Path) -> None:
    left = lens(load_rig(solved[0] / "last.json"), "left")
    (fx, fy), (cx, cy) = left.focal_px, left.centre_px
    message = {
        "header": {"frame_id": "left_optical_frame"},
        **{"height": left.height, "width": left.width, "distortion_model": "plumb_bob"},
        **{"d": list(left.distortion), "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]},
    }
    lines = (f"{name}: {json.dumps(value)}" for name, value in message.items())
    (tmp_path / "info.yaml").write_text("\n".join(lines) + "\n---\n")
    rig = solve(solved, tmp_path / "rig.json", "--hold", f"left={tmp_path}/info.yaml#left_optical_frame")
    assert lens(rig, "left") == left
