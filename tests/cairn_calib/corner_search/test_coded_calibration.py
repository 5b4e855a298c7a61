"""From pictures of sheets with tags, most of them seen in part, to a camera: `cairn calib corners` and `solve`."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.board_images import TOF
from tests.fixtures.calib.coded_sheets import aprilgrid_sheet, charuco_sheet, sheet_picture, sheet_pose, sheet_truth

from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.cli.corners import main
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import read_board_views
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import CameraPlan, SolvePlan
from cairn_map.errors import BadInputError, NotFoundError

SPECTRUM = TOF
SHEETS = {
    "aprilgrid": (
        aprilgrid_sheet(6, 6, tag_m=0.06, spacing=0.3, family=cv2.aruco.DICT_APRILTAG_36H11),
        ["--board", "6x6", "--square", "0.06", "--spacing", "0.3"],
        (0.2, 0.42),
    ),
    "charuco": (
        charuco_sheet((9, 6), square_m=0.05, marker=0.75, family=cv2.aruco.DICT_5X5_100),
        ["--board", "9x6", "--square", "0.05", "--marker", "0.0375", "--tags", "5x5_100"],
        (0.2, 0.42),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_partial_views_of_a_sheet_with_tags_give_back_the_camera_that_saw_it(name: str, tmp_path: Path) -> None:
    sheet, options, range_m = SHEETS[name]
    rng = np.random.default_rng(21)
    size, partial = np.array([SPECTRUM.camera.width, SPECTRUM.camera.height]), 0
    for n in range(20):
        T = sheet_pose(rng, SPECTRUM, sheet, range_m=range_m)
        at = sheet_truth(SPECTRUM, T, sheet)
        partial += not bool(((at > 0) & (at < size)).all())
        cv2.imwrite(str(tmp_path / f"{n:02d}.png"), sheet_picture(SPECTRUM, T, sheet, rng))
    images = sorted(str(path) for path in tmp_path.glob("*.png"))
    assert main([*images, "--pattern", name, *options, "--jobs", "1", "--output", str(tmp_path / "tof")]) == 0
    assert partial >= 6
    views = read_board_views({"tof": tmp_path / "tof"})
    assert len(views.views) >= 18
    cameras = {"tof": CameraPlan(spectrum=Spectrum.COLOUR, free=("k1", "k2"))}
    solution = solve_rig(views, SolvePlan(cameras=cameras, gauge="tof"))
    truth, sigmas = SPECTRUM.camera, solution.sigmas()
    for (owner, parameter), value in solution.values().items():
        if owner == "tof":
            expected = float(truth.intrinsics[truth.intrinsic_names.index(parameter)])
            assert abs(value - expected) < 3 * sigmas[owner, parameter], parameter


def test_options_that_contradict_the_board_are_refused_with_what_they_mean(tmp_path: Path) -> None:
    image = tmp_path / "one.png"
    cv2.imwrite(str(image), np.zeros((64, 64), np.uint8))
    for pattern, options, reason in (
        ("charuco", ["--board", "9x6", "--tags", "5x5_100"], "--marker is the edge"),
        ("charuco", ["--board", "9x6", "--marker", "0.03"], "--tags is the set"),
        ("charuco", ["--board", "9x6", "--marker", "0.06", "--tags", "5x5_100"], "apart, got 0.06 m"),
        ("charuco", ["--board", "9x6", "--marker", "0.03", "--tags", "5x5"], "there is no set of tags '5x5'"),
        ("chessboard", ["--board", "9x6", "--tags", "36h11"], "say --pattern"),
        ("chessboard", ["--board", "9x6", "--spacing", "0.3"], "--spacing is the gap"),
        ("aprilgrid", ["--board", "6x1"], "COLUMNSxROWS of tags"),
        ("aprilgrid", ["--board", "40x6"], "--board"),
    ):
        with pytest.raises(BadInputError, match=reason):
            main([str(image), "--pattern", pattern, "--square", "0.05", *options, "--output", str(tmp_path / "out")])
    with pytest.raises(NotFoundError):
        main(
            [
                str(image),
                "--pattern",
                "aprilgrid",
                "--board",
                "6x6",
                "--square",
                "0.05",
                "--output",
                str(tmp_path / "o"),
            ]
        )
    board = read_corner_file(tmp_path / "o" / "one.json").board
    assert (board.columns, board.pitch_m, board.tag_m, board.dictionary) == (12, 0.065, 0.05, "36h11")
