"""Boards with tags: corners where they are, in every spectrum and in part, no worse than OpenCV's; plain refusals."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from tests.board_finding.empty_images import KINDS, SMALL, empty_image
from tests.fixtures.calib.board_images import COLOUR, THERMAL, TOF, Floats, Image, Spectrum
from tests.fixtures.calib.coded_sheets import (
    BIT_PX,
    aprilgrid_sheet,
    charuco_sheet,
    sheet_picture,
    sheet_pose,
    sheet_truth,
)
from tests.fixtures.lengths import length

from cairn_calib.board.board import Board
from cairn_calib.board.corner_detection import grey
from cairn_calib.board.corners import Corners, Detection
from cairn_calib.corner_search.coded_search import coded_candidates
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_map.errors import BadInputError

TAG36H11 = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822)
"""First codes of AprilTag's own table, from the upper left bit to the lower right one; a set bit is white."""
APRILGRID = Board(pattern="aprilgrid", columns=12, rows=10, pitch_m=0.078, tag_m=0.06, dictionary="36h11")
CHARUCO = Board(pattern="charuco", columns=8, rows=5, pitch_m=0.05, tag_m=0.0375, dictionary="5x5_100")
SHEETS = {
    "aprilgrid": (aprilgrid_sheet(6, 5, tag_m=0.06, spacing=0.3, family=cv2.aruco.DICT_APRILTAG_36H11), APRILGRID),
    "charuco": (charuco_sheet((9, 6), square_m=0.05, marker=0.75, family=cv2.aruco.DICT_5X5_100), CHARUCO),
}
RANGES = {"colour": (COLOUR, (0.3, 2.2)), "thermal": (THERMAL, (0.25, 0.75)), "tof": (TOF, (0.15, 0.35))}


@dataclass(frozen=True)
class Shot:
    """One image of a sheet, and where its points are."""

    image: Image
    at: Floats
    in_view: np.ndarray[tuple[int], np.dtype[np.bool_]]


def shots(name: str, spectrum: Spectrum, range_m: tuple[float, float], count: int, *, seed: int) -> Iterator[Shot]:
    rng = np.random.default_rng(seed)
    sheet, _ = SHEETS[name]
    size = [spectrum.camera.width, spectrum.camera.height]
    for _ in range(count):
        T = sheet_pose(rng, spectrum, sheet, range_m=range_m)
        at = sheet_truth(spectrum, T, sheet)
        yield Shot(sheet_picture(spectrum, T, sheet, rng), at, ((at > 8) & (at < np.array(size) - 9)).all(axis=1))


def search(image: Image, board: Board) -> Detection:
    return coded_candidates(grey(image), board, polarity="vote", upright=False, pointed=None).likely


def found(image: Image, board: Board) -> Corners:
    detection = search(image, board)
    assert detection.corners is not None, [str(attempt) for attempt in detection.attempts]
    return detection.corners


def rms(error: Floats) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def test_the_sheet_of_the_tests_has_the_tags_of_apriltags_own_table_upright() -> None:
    sheet = SHEETS["aprilgrid"][0]
    left, top = (sheet.origin_px + np.array([0.5, 4 * 13 + 0.5]) * BIT_PX).astype(int)
    for tag, code in enumerate(TAG36H11):
        bits = sheet.print[top : top + 120 : BIT_PX, left + 156 * tag : left + 156 * tag + 120 : BIT_PX]
        assert bits.shape == (10, 10)
        assert bits[:2].sum() + bits[-2:].sum() + bits[:, :2].sum() + bits[:, -2:].sum() == 0
        assert int("".join(str(int(bit)) for bit in bits[2:-2, 2:-2].ravel()), 2) == code


@pytest.mark.parametrize("name", SHEETS)
def test_points_of_a_board_are_those_of_its_sheet(name: str) -> None:
    sheet, board = SHEETS[name]
    assert np.abs(board.points() - sheet.points_m).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
@pytest.mark.parametrize("camera", RANGES)
def test_corners_of_sheets_seen_whole_and_in_part_lie_where_they_are_with_the_error_that_is_stated(
    name: str, camera: str
) -> None:
    spectrum, range_m = RANGES[camera]
    board = SHEETS[name][1]
    errors, covariances, seen, there = [], [], 0, 0
    for shot in shots(name, spectrum, range_m, length(2, long=4), seed=11):
        corners = found(shot.image, board)
        errors.append((corners.pixels - shot.at)[corners.seen])
        covariances.append(corners.covariance_px2[corners.seen])
        seen += int((corners.seen & shot.in_view).sum())
        there += int(shot.in_view.sum())
    error, covariance = np.concatenate(errors), np.concatenate(covariances)
    assert seen > 0.9 * there
    assert np.abs(error).max() < 0.5
    normalised = np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])
    assert 0.5 < normalised.std() < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_corners_are_at_least_as_many_and_as_accurate_as_opencvs(name: str) -> None:
    board = SHEETS[name][1]
    ours, theirs, counts = [], [], [0, 0]
    for shot in shots(name, COLOUR, (0.4, 2.2), length(2, long=5), seed=12):
        corners, other = found(shot.image, board), by_opencv(np.asarray(shot.image, np.uint8), name)
        both = corners.seen & np.isfinite(other[:, 0])
        ours.append((corners.pixels - shot.at)[both])
        theirs.append((other - shot.at)[both])
        counts[0] += int(corners.seen.sum())
        counts[1] += int(np.isfinite(other[:, 0]).sum())
    assert counts[0] >= counts[1] > 0
    assert rms(np.concatenate(ours)) <= rms(np.concatenate(theirs))


def by_opencv(image: np.ndarray[tuple[int, int], np.dtype[np.uint8]], name: str) -> Floats:
    """(N, 2) the points of a sheet by OpenCV's own detectors, refined by `cornerSubPix`; NaN where it finds none."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    if name == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((9, 6), 0.05, 0.0375, dictionary)
        detector = cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)
        corners, ids, _, _ = detector.detectBoard(image)
        places = np.full((40, 2), np.nan)
        places[np.asarray(ids).ravel()] = np.asarray(corners).reshape(-1, 2)
        return places
    parameters.markerBorderBits = 2
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    tags, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    places = np.full((10, 12, 2), np.nan)
    for tag, corners in zip(np.asarray(ids).ravel().tolist(), tags, strict=True):
        row, column = 2 * (4 - tag // 6), 2 * (tag % 6)
        # OpenCV's tags stand on their heads.
        lower_right, lower_left, upper_left, upper_right = np.asarray(corners).reshape(4, 2)
        places[row : row + 2, column : column + 2] = [[upper_left, upper_right], [lower_left, lower_right]]
    return places.reshape(-1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_a_negative_gives_the_same_corners_under_the_same_names_and_votes_for_reversed(name: str) -> None:
    board = SHEETS[name][1]
    (shot,) = shots(name, TOF, (0.3, 0.3), 1, seed=3)
    negative = (65535 - shot.image.astype(np.int64)).astype(np.uint16)
    both = [
        coded_candidates(grey(image), board, polarity="vote", upright=False, pointed=None)
        for image in (np.asarray(shot.image, np.uint16), negative)
    ]
    assert [each.vote for each in both] == ["normal", "reversed"]
    first, second = (each.likely.corners for each in both)
    assert first is not None
    assert second is not None
    assert np.nanmax(np.abs(first.pixels - second.pixels)) < 1e-2
    assert (
        coded_candidates(grey(negative), board, polarity="normal", upright=False, pointed=None).likely.corners is None
    )


@pytest.mark.slow
def test_a_board_of_before_opencv_4_6_is_known_by_its_tags() -> None:
    sheet = charuco_sheet((9, 6), square_m=0.05, marker=0.75, family=cv2.aruco.DICT_5X5_100, is_legacy=True)
    rng = np.random.default_rng(5)
    T = sheet_pose(rng, COLOUR, sheet, range_m=(0.9, 0.9))
    corners = found(sheet_picture(COLOUR, T, sheet, rng), CHARUCO)
    assert corners.seen.sum() > 35
    assert np.nanmax(np.abs(corners.pixels - sheet_truth(COLOUR, T, sheet))) < 0.1


@pytest.mark.slow
def test_a_lens_that_bends_the_sheet_hides_little_of_it() -> None:
    lens = FisheyeCamera(
        width=1280,
        height=960,
        focal_px=(420.0, 420.0),
        centre_px=(640.0, 480.0),
        distortion=(-0.02, 0.005, -0.002, 0.0),
    )
    spectrum, (sheet, board) = replace(COLOUR, camera=lens), SHEETS["aprilgrid"]
    rng = np.random.default_rng(2)
    for _ in range(3):
        T = sheet_pose(rng, spectrum, sheet, range_m=(0.3, 0.7))
        corners, at = found(sheet_picture(spectrum, T, sheet, rng), board), sheet_truth(spectrum, T, sheet)
        assert corners.seen.sum() > 0.85 * board.count
        assert np.nanmax(np.abs(corners.pixels - at)) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_tags_of_a_dozen_pixels_are_read_where_opencv_reads_none(name: str) -> None:
    board = SHEETS[name][1]
    for shot in shots(name, TOF, {"aprilgrid": (0.5, 0.55), "charuco": (0.42, 0.46)}[name], 3, seed=5):
        corners = found(shot.image, board)
        assert corners.seen.sum() > 0.75 * shot.in_view.sum()
        assert np.nanmax(np.abs(corners.pixels - shot.at)) < 0.4


@cache
def shot_of(name: str) -> Image:
    """One image of a sheet, seen whole."""
    (sheet, _), rng = SHEETS[name], np.random.default_rng(4)
    return sheet_picture(COLOUR, sheet_pose(rng, COLOUR, sheet, range_m=(0.9, 0.9)), sheet, rng)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stated", "reason"),
    [
        ("aprilgrid", {"columns": 10}, r"lie as on a board of 6 columns of tags, and .* as on the stated one of 5"),
        ("aprilgrid", {"columns": 14}, r"lie as on a board of 6 columns of tags"),
        ("aprilgrid", {"rows": 8}, r"tags up to 29 lie as on this board, which has 24, 0 to 23: is it larger\?"),
        ("aprilgrid", {"dictionary": "25h9"}, r"tags of 36h11 are seen, and none of 25h9: say --tags 36h11"),
        ("charuco", {"columns": 7}, r"lie as on a board of 9 columns of squares"),
        ("charuco", {"rows": 4}, r"which has 22, 0 to 21: is it larger\? --board counts squares"),
        ("charuco", {"dictionary": "6x6_250"}, r"tags of 5x5_50 are seen, and none of 6x6_250: say --tags 5x5_50"),
    ],
)
def test_a_board_that_is_stated_wrongly_is_refused_with_what_is_seen(
    name: str, stated: dict[str, object], reason: str
) -> None:
    detection = search(shot_of(name), SHEETS[name][1].model_copy(update=stated))
    assert detection.corners is None
    assert detection.attempts[-1].stage == "tags"
    assert re.search(reason, detection.attempts[-1].reason), detection.attempts[-1].reason


@pytest.mark.slow
def test_the_other_kind_of_sheet_is_named() -> None:
    detection = search(shot_of("aprilgrid"), CHARUCO)
    assert detection.attempts[-1].reason.endswith("say --pattern aprilgrid --tags 36h11")
    detection = search(shot_of("charuco"), APRILGRID)
    assert detection.attempts[-1].reason.endswith("say --pattern charuco --tags 5x5_50")


@pytest.mark.slow
@pytest.mark.parametrize("name", SHEETS)
def test_no_board_is_found_in_images_without_tags(name: str) -> None:
    board = SHEETS[name][1].model_copy(update={"dictionary": "4x4_50"} if name == "charuco" else {})
    # Seeds name kinds of images. In the short form each kind is for one of the sheets.
    step = length(len(SHEETS), long=1)
    for seed in range([*SHEETS].index(name) % step, len(KINDS), step):
        _, image = empty_image(seed, sizes=SMALL)
        assert search(image, board).corners is None


@pytest.mark.slow
def test_corners_pointed_at_by_hand_are_enough_where_no_tag_is_read() -> None:
    sheet, board = SHEETS["charuco"]
    rng = np.random.default_rng(7)
    T = sheet_pose(rng, TOF, sheet, range_m=(0.4, 0.4))
    image, at = sheet_picture(TOF, T, sheet, rng), sheet_truth(TOF, T, sheet)
    outer = at[[0, 7, 39, 32]] + [[0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5]]
    corners = coded_candidates(grey(image), board, polarity="vote", upright=False, pointed=outer).likely.corners
    assert corners is not None
    assert corners.seen.sum() > 30
    assert np.nanmax(np.abs(corners.pixels - at)) < 0.4


def test_boards_with_tags_are_described_whole() -> None:
    for wrong in ({"tag_m": None}, {"dictionary": None}, {"tag_m": 0.09}, {"columns": 11}):
        with pytest.raises(ValueError, match=r"tag|AprilGrid"):
            Board.model_validate({**APRILGRID.model_dump(), **wrong})
    with pytest.raises(BadInputError, match=r"there is no set of tags '36h12'; there are 4x4_50"):
        search(np.zeros((64, 64), np.uint8), APRILGRID.model_copy(update={"dictionary": "36h12"}))
