"""Outlines of discs: centroids against those of the region itself, in recorded images of near, large discs."""

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.board.board import Board
from cairn_calib.board.corners import Corners
from cairn_calib.board.discs.disc_grid import find_circles
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import BoardView, BoardViews
from cairn_calib.solve.solve import solve_rig
from cairn_calib.solve.solve_plan import usual_plan

Floats = npt.NDArray[np.float64]
WIDE = Board(pattern="circles", columns=4, rows=3, pitch_m=0.09, disc_m=0.07)
ENLARGED = 6
REGION_RMS_PX = 0.15
PUBLISHED_FX_PX = 496.3


@dataclass(frozen=True)
class Wide:
    """One image of the recording, and the grid in it."""

    name: str
    image: npt.NDArray[np.uint8]
    corners: Corners
    disc_pitches: float | None


@pytest.fixture(scope="module")
def wide() -> list[Wide]:
    """All images of the recording, searched once; skips where it is not at hand."""
    folder = os.environ.get("CAIRN_TEST_DATA")
    if not folder:
        pytest.skip("CAIRN_TEST_DATA is not set")
    return [searched(path) for path in sorted((Path(folder) / "disc_grid_wide").glob("*.png"))]


def region_centroid(image: npt.NDArray[np.uint8], near: Floats) -> Floats:
    """Centroid of the dark region about a pixel: enlarged, darker than half way to the ground next to it."""
    seed = (round(float(near[0])), round(float(near[1])))
    # A first region, by a threshold of its own; grown, its rim is ground, through which a parabola goes.
    half = 130
    low = np.maximum([seed[0] - half, seed[1] - half], 0)
    part = image[low[1] : seed[1] + half, low[0] : seed[0] + half].astype(np.float32)
    middle = (seed[0] - int(low[0]), seed[1] - int(low[1]))
    inside = part[middle[1] - 4 : middle[1] + 5, middle[0] - 4 : middle[0] + 5]
    dark = float(np.median(inside))
    beside = cv2.GaussianBlur(part, (0, 0), 2.0)
    rough = (beside < dark + 0.3 * (float(np.median(part[part > dark + 40])) - dark)).astype(np.uint8)
    _, labels = cv2.connectedComponents(rough)
    region = (labels == labels[middle[1], middle[0]]).astype(np.uint8)
    ring = (cv2.dilate(region, np.ones((17, 17))) - cv2.dilate(region, np.ones((9, 9)))).astype(bool)
    y, x = np.nonzero(ring)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(np.float64)
    ground = np.linalg.lstsq(terms, part[ring].astype(np.float64), rcond=None)[0]
    core = cv2.erode(region, np.ones((9, 9))).astype(bool)
    v, u = np.nonzero(core)
    flat = np.stack([np.ones_like(u), u, v], axis=1).astype(np.float64)
    floor = np.linalg.lstsq(flat, part[core].astype(np.float64), rcond=None)[0]
    # Enlarged: pixels darker than half way between the disc's level and the ground's, in one piece.
    fine = cv2.resize(part, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
    Y, X = np.mgrid[: fine.shape[0], : fine.shape[1]].astype(np.float64)
    X, Y = (X + 0.5) / ENLARGED - 0.5, (Y + 0.5) / ENLARGED - 0.5
    level = sum(c * t for c, t in zip(ground, (1, X, Y, X * X, X * Y, Y * Y), strict=True))
    level = (level + floor[0] + floor[1] * X + floor[2] * Y) / 2
    _, labels = cv2.connectedComponents((fine < level).astype(np.uint8))
    at = labels == labels[middle[1] * ENLARGED, middle[0] * ENLARGED]
    return np.array([X[at].mean(), Y[at].mean()]) + low


def searched(path: Path) -> Wide:
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    detection = find_circles(image, WIDE, upright=True)
    assert detection.corners is not None, [str(attempt) for attempt in detection.attempts]
    return Wide(path.name, image, detection.corners, detection.disc_pitches)


@pytest.mark.recording
def test_near_large_discs_through_a_wide_lens_are_where_their_regions_are(wide: list[Wide]) -> None:
    misses = []
    for each in wide:
        assert each.corners.seen.all(), each.name
        regions = np.array([region_centroid(each.image, at) for at in each.corners.pixels])
        misses.append(each.corners.pixels - regions)
    off = np.concatenate(misses)
    assert len(off) == 7 * 12
    assert np.sqrt((off**2).mean()) < REGION_RMS_PX
    assert np.abs(off).max() < 4 * REGION_RMS_PX


@pytest.mark.recording
def test_their_calibration_is_the_published_one_where_centroids_taken_for_centres_are_far_off(
    wide: list[Wide],
) -> None:
    corners = [each.corners for each in wide]
    shown = np.median([each.disc_pitches for each in wide])
    assert shown == pytest.approx(0.78, abs=0.01)
    views = tuple(BoardView("left", f"{n}", f"{n}.png", each) for n, each in enumerate(corners))
    solution = solve_rig(BoardViews(WIDE, {"left": (1440, 1080)}, views), usual_plan({"left": Spectrum.COLOUR}))
    fx, sigma = solution.values()["left", "fx"], solution.sigmas()["left", "fx"]
    # OpenCV, on the same centroids, knows no discs.
    points = [WIDE.points().astype(np.float32)] * len(corners)
    pixels = [each.pixels.astype(np.float32) for each in corners]
    theirs = cv2.calibrateCamera(points, pixels, (1440, 1080), np.eye(3), np.zeros(5))[1][0, 0]
    assert abs(fx - PUBLISHED_FX_PX) < 3 * sigma < 3
    assert abs(theirs - PUBLISHED_FX_PX) > 5 * abs(fx - PUBLISHED_FX_PX)
