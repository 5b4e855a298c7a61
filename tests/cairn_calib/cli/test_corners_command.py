"""`cairn calib corners`: documents and pictures for every image, found or not."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.board_images import BOARD, TOF, picture, pose, truth

from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.cli.corners import main
from cairn_calib.solve.board_views import read_board_views
from cairn_map.errors import BadInputError, DamagedDataError, NotFoundError


def test_each_image_gets_a_document_and_a_picture_and_failures_name_their_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(4)
    T_camera_board = pose(rng, TOF)
    at = truth(TOF, T_camera_board)
    good, empty = tmp_path / "good.png", tmp_path / "empty.png"
    cv2.imwrite(str(good), picture(TOF, T_camera_board, rng))
    cv2.imwrite(str(empty), rng.integers(0, 60000, (144, 176)).astype(np.uint16))
    options = ["--board", "9x6", "--square", "0.05", "--output", str(tmp_path / "out")]
    assert main([str(good), str(empty), *options]) == 0
    told = capsys.readouterr().err
    assert "good.png: 54 of 54 corners" in told
    assert "found in 1 of 2 images; the others: empty.png" in told
    document = read_corner_file(tmp_path / "out" / "good.json")
    assert (document.width, document.height, document.board) == (176, 144, BOARD)
    corners = document.to_corners()
    assert corners is not None
    assert np.abs(corners.pixels - at).max() < 0.3
    nothing = read_corner_file(tmp_path / "out" / "empty.json")
    assert nothing.to_corners() is None
    assert all(attempt.stage != "found" and attempt.reason for attempt in nothing.attempts)
    assert np.asarray(cv2.imread(str(tmp_path / "out" / "good.png"))).shape[1] >= 1000
    with pytest.raises(NotFoundError, match="no board in any image"):
        main([str(empty), *options])


def test_an_image_that_repeats_another_is_left_out_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(4)
    cv2.imwrite(str(tmp_path / "t1.png"), picture(TOF, pose(rng, TOF), rng))
    (tmp_path / "t2.png").write_bytes((tmp_path / "t1.png").read_bytes())
    paths = [str(tmp_path / name) for name in ("t1.png", "t2.png")]
    assert main([*paths, "--board", "9x6", "--square", "0.05", "--output", str(tmp_path / "out")]) == 0
    assert "t2.png: no board (repeated: the same counts as t1.png" in capsys.readouterr().err
    assert read_corner_file(tmp_path / "out" / "t2.json").attempts[0].stage == "repeated"


def test_an_image_that_cannot_be_read_is_named_and_the_others_are_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(4)
    good, bad, tiny = (tmp_path / f"{name}{n}.png" for n, name in enumerate(("good", "bad", "tiny"), 1))
    cv2.imwrite(str(good), picture(TOF, pose(rng, TOF), rng))
    bad.write_bytes(good.read_bytes()[:99])
    cv2.imwrite(str(tiny), np.zeros((9, 9), np.uint8))
    out = tmp_path / "out"
    options = ["--board", "9x6", "--square", "0.05", "--output", str(out)]
    with pytest.raises(BadInputError, match=r"no such images: .*gone.png"):
        main([str(good), str(tmp_path / "gone.png"), *options])
    assert main([str(bad), str(tiny), str(good), *options]) == 0
    told = capsys.readouterr().err
    assert "bad2.png: no board (reading: " in told
    assert "found in 1 of 3 images; the others: bad2.png, tiny3.png" in told
    nothing = read_corner_file(out / "bad2.json")
    assert (nothing.attempts[0].stage, nothing.width, nothing.image_sha256) == ("reading", None, None)
    assert {path.name for path in out.glob("*.png")} == {"good1.png"}
    assert [view.frame for view in read_board_views({"tof": out}).views] == ["good-1"]
    for path in (out / "good1.json", out / "tiny3.json"):
        path.unlink()
    with pytest.raises(BadInputError, match="no image of tof could be read"):
        read_board_views({"tof": out})


def test_corners_pointed_at_by_hand_are_taken_from_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(4)
    T_camera_board = pose(rng, TOF)
    at = truth(TOF, T_camera_board)
    cv2.imwrite(str(tmp_path / "one.png"), picture(TOF, T_camera_board, rng))
    pointed = {"format": "cairn-outer-corners", "version": 1, "images": {"one.png": at[[0, 8, 53, 45]].tolist()}}
    (tmp_path / "by-hand.json").write_text(json.dumps(pointed))
    options = ["--board", "9x6", "--square", "0.05", "--output", str(tmp_path / "out"), "--outer-corners"]
    assert main([str(tmp_path / "one.png"), *options, str(tmp_path / "by-hand.json")]) == 0
    document = read_corner_file(tmp_path / "out" / "one.json")
    assert document.attempts[-1].method == "by hand"
    # What a search would have refused, here a board that goes on, is used and said.
    pointed["images"] = {"one.png": at[[0, 6, 51, 45]].tolist()}
    (tmp_path / "by-hand.json").write_text(json.dumps(pointed))
    smaller = ["--board", "7x6", *options[2:], str(tmp_path / "by-hand.json")]
    capsys.readouterr()
    assert main([str(tmp_path / "one.png"), *smaller]) == 0
    line = capsys.readouterr().err.splitlines()[0]
    assert line.startswith("one.png: 42 of 42 corners") and "; not refused, since it is pointed at: the pattern" in line
    pointed["images"] = {"one.png": at[[0, 8, 53, 45]].tolist()}
    named_alike = tmp_path / "out" / "one.json"
    named_alike.write_text(json.dumps(pointed))
    with pytest.raises(BadInputError, match="would overwrite"):
        main([str(tmp_path / "one.png"), *options, str(named_alike)])
    assert json.loads(named_alike.read_text()) == pointed
    pointed["images"] = {"one.png": [[1, 2]] * 5}
    (tmp_path / "by-hand.json").write_text(json.dumps(pointed))
    with pytest.raises(BadInputError, match="4 corners or all 54"):
        main([str(tmp_path / "one.png"), *options, str(tmp_path / "by-hand.json")])
    (tmp_path / "one.json").write_text("{}")
    with pytest.raises(DamagedDataError, match="no file of corners"):
        read_corner_file(tmp_path / "one.json")


def test_images_are_never_overwritten_by_pictures_of_them(tmp_path: Path) -> None:
    image = tmp_path / "one.png"
    cv2.imwrite(str(image), np.zeros((64, 64), np.uint8))
    before = image.read_bytes()
    with pytest.raises(BadInputError, match="would overwrite"):
        main([str(image), "--board", "9x6", "--square", "0.05", "--output", str(tmp_path)])
    assert image.read_bytes() == before
    # A folder is a still pose, and its pictures are frames.
    with pytest.raises(BadInputError, match="would overwrite"):
        main([str(tmp_path), "--board", "9x6", "--square", "0.05", "--output", str(tmp_path)])
    assert [each.name for each in tmp_path.iterdir()] == ["one.png"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--disc", "0.03"], "--disc is of discs, and a chessboard has none"),
        (["--pattern", "circles", "--disc", "0.06"], "0.05 m apart, got 0.06 m"),
        (
            ["--pattern", "circles", "--disc", "0.03"],
            "same after half a turn.*add --upright.*asymmetric circles in odd rows",
        ),
        (["--board", "8x6"], "same after half a turn.*add --upright.*one with an odd and an even side"),
    ],
)
def test_what_is_missing_of_a_board_is_named(tmp_path: Path, options: list[str], words: str) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((60, 80), np.uint8))
    given = [str(tmp_path / "a.png"), "--board", "9x6", "--square", "0.05", "--output", str(tmp_path / "out"), *options]
    with pytest.raises(BadInputError, match=words):
        main(given)
