"""Polarity of a camera from a board's margin: whether it sees dark as bright; cameras then agree on the order."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.board_finding.trials import SPECTRA, trial
from tests.fixtures.calib.board_images import BOARD, DISCS, THERMAL, TOF, picture, pose, truth

from cairn_calib.board.corner_detection import find_chessboard, grey
from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.board.corner_pictures import BAND_PX, overlay
from cairn_calib.board.polarity import Vote, count_votes, margin_polarity, reverse_corners
from cairn_calib.cli.corners import main


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("tof", 12), ("thermal", 3), ("colour", 1)])
def test_margins_vote_for_the_polarity_whichever_way_the_board_is_held(name: str, count: int) -> None:
    assert name in SPECTRA
    for seed in range(50, 50 + count):
        each = trial(name, seed)
        corners = find_chessboard(each.image, BOARD).corners
        assert corners is not None
        assert margin_polarity(grey(each.image), corners) == each.polarity
        assert margin_polarity(grey(each.image), reverse_corners(corners)) == each.polarity


def test_corners_named_from_the_other_end_are_those_of_the_other_polarity() -> None:
    each = trial("tof", 50)
    normal, other = (find_chessboard(each.image, BOARD, polarity=way).corners for way in ("normal", "reversed"))
    assert normal is not None
    assert other is not None
    assert np.array_equal(reverse_corners(normal).pixels, other.pixels)
    assert np.array_equal(reverse_corners(normal).covariance_px2, other.covariance_px2)


def test_a_vote_needs_a_clear_majority() -> None:
    assert count_votes(["normal", None, "normal", "normal", "reversed"]) == Vote(3, 1)
    assert Vote(3, 1).polarity == "normal"
    assert Vote(0, 1).polarity == "reversed"
    assert Vote(2, 1).polarity is None
    assert Vote(0, 0).polarity is None


def test_images_of_a_thermal_camera_are_found_reversed_without_being_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(8)
    ats = []
    for n in range(2):
        T = pose(rng, THERMAL)
        ats.append(truth(THERMAL, T))
        cv2.imwrite(str(tmp_path / f"{n}.png"), picture(THERMAL, T, rng))
    images = [str(tmp_path / f"{n}.png") for n in range(2)]
    options = ["--board", "9x6", "--square", "0.05", "--output", str(tmp_path / "out")]
    # Of this one there is no margin to look at: it has no vote, but the others' order, also in its picture.
    x, y = np.clip(ats[1].min(axis=0) - 8, 0, None).astype(int)
    right, bottom = (ats[1].max(axis=0) + 8).astype(int)
    cut = np.asarray(cv2.imread(images[1], cv2.IMREAD_ANYDEPTH))[y:bottom, x:right]
    cv2.imwrite(str(tmp_path / "2.png"), cut)
    assert main([*images, str(tmp_path / "2.png"), *options]) == 0
    assert "polarity reversed: 0 for normal, 2 for reversed of 3 images" in capsys.readouterr().err
    ats.append(ats[1] - [x, y])
    drawn = np.asarray(cv2.imread(str(tmp_path / "out" / "2.png")))
    again = overlay(cut.astype(np.float32), read_corner_file(tmp_path / "out" / "2.json").to_corners(), title="")
    assert np.array_equal(drawn[BAND_PX:], again[BAND_PX:])
    for n, at in enumerate(ats):
        document = read_corner_file(tmp_path / "out" / f"{n}.json")
        corners = document.to_corners()
        assert document.polarity == "reversed"
        assert corners is not None
        assert np.abs(corners.pixels - at).max() < 0.5
    assert main([*images, *options, "--polarity", "normal"]) == 0
    corners = read_corner_file(tmp_path / "out" / "0.json").to_corners()
    assert corners is not None
    assert np.abs(corners.pixels[::-1] - ats[0]).max() < 0.5


def test_bright_discs_are_found_without_being_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(2)
    image = picture(TOF, pose(rng, TOF, board=DISCS, tilt_deg=30), rng, board=DISCS)
    cv2.imwrite(str(tmp_path / "one.png"), 20000 - image)
    options = ["--board", "4x11", "--square", "0.05", "--pattern", "asymmetric-circles", "--disc", "0.03"]
    assert main([str(tmp_path / "one.png"), *options, "--output", str(tmp_path / "out")]) == 0
    assert "polarity reversed: 0 for normal, 1 for reversed of 1 images" in capsys.readouterr().err
    assert read_corner_file(tmp_path / "out" / "one.json").polarity == "reversed"


def test_the_diameter_of_discs_is_seen_where_it_is_not_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(11)
    cv2.imwrite(str(tmp_path / "one.png"), picture(THERMAL, pose(rng, THERMAL, board=DISCS), rng, board=DISCS))
    options = ["--board", "4x11", "--square", "0.05", "--pattern", "asymmetric-circles", "--polarity", "reversed"]
    main([str(tmp_path / "one.png"), *options, "--output", str(tmp_path / "out")])
    assert "as 1 image show" in capsys.readouterr().err
    assert read_corner_file(tmp_path / "out" / "one.json").board.disc_m == pytest.approx(0.03, rel=0.04)
    main([str(tmp_path / "one.png"), *options, "--disc", "0.04", "--output", str(tmp_path / "out")])
    assert "warning: --disc says 0.04 m" in capsys.readouterr().err
