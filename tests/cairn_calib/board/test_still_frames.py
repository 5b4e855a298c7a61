"""Frames of one still pose are averaged: less noise, and a refusal where the board moved."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.board_images import TOF, Floats, picture, pose, truth

from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.board.still_frames import read_still
from cairn_calib.cli.corners import main
from cairn_map.errors import BadInputError, NotFoundError

NOISY = replace(TOF, noise=900.0)
OPTIONS = ("--board", "9x6", "--square", "0.05", "--output")
FRAMES = 9


def frames(folder: Path, T_camera_board: Floats, *, sideways_m: float = 0.0) -> None:
    rng = np.random.default_rng(1)
    folder.mkdir()
    for n in range(FRAMES):
        moved = T_camera_board.copy()
        moved[0, 3] += sideways_m * n / FRAMES
        cv2.imwrite(str(folder / f"{n}.png"), picture(NOISY, moved, rng))


def test_corners_of_a_mean_are_as_certain_as_they_say(tmp_path: Path) -> None:
    T = pose(np.random.default_rng(6), TOF)
    frames(tmp_path / "pose1", T)
    one = tmp_path / "pose1" / "0.png"
    assert main([str(tmp_path / "pose1"), str(one), *OPTIONS, str(tmp_path / "out")]) == 0
    mean, single = (read_corner_file(tmp_path / "out" / f"{name}.json") for name in ("pose1", "0"))
    assert (mean.image, mean.frames, single.frames) == ("pose1", FRAMES, 1)
    assert mean.image_sha256 != single.image_sha256
    of_mean, of_one = mean.to_corners(), single.to_corners()
    assert of_mean is not None
    assert of_one is not None
    error = of_mean.pixels - truth(TOF, T)
    root = np.linalg.cholesky(of_mean.covariance_px2)
    assert 0.75 < np.linalg.solve(root, error[..., None]).std() < 1.3
    sigmas = [np.sqrt(np.nanmedian(each.covariance_px2[:, 0, 0])) for each in (of_one, of_mean)]
    assert sigmas[0] / sigmas[1] == pytest.approx(np.sqrt(FRAMES), rel=0.25)


def test_a_board_that_moves_between_frames_is_refused_and_has_no_vote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    T = pose(np.random.default_rng(6), TOF)
    pixel_m = T[2, 3] / TOF.camera.focal_px[0]
    frames(tmp_path / "pose1", T, sideways_m=1.5 * pixel_m)
    with pytest.raises(NotFoundError, match="no board in any image"):
        main([str(tmp_path / "pose1"), *OPTIONS, str(tmp_path)])
    assert "polarity" not in capsys.readouterr().err
    last = read_corner_file(tmp_path / "pose1.json").attempts[-1]
    assert last.stage == "stillness"
    assert "moved by 0.7" in last.reason or "moved by 0.8" in last.reason


def test_a_folder_must_hold_images_of_one_size(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="must hold the frames"):
        read_still(tmp_path)
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((20, 20), np.uint8))
    assert read_still(tmp_path).frames == 1
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(BadInputError, match="other frames"):
        read_still(tmp_path)
