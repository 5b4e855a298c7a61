"""Pictures of the report that judge a lens: where it was seen, and whether it makes straight lines straight."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import BOARD, COLOUR, exact_pixels, world

from cairn_calib.board.corner_file import corner_file
from cairn_calib.board.corner_pictures import BAND_PX, resampled, write_picture
from cairn_calib.board.corners import Attempt, Corners, Detection
from cairn_calib.report.report_images import ReportImage
from cairn_calib.report.straight_lines import board_lines, pinhole_view, rms_off, straight_figure
from cairn_calib.report.validity import convex_hull, hull_area, is_inside
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens

WIDE = FisheyeCamera(
    width=640, height=480, focal_px=(200.0, 201.0), centre_px=(318.0, 242.0), distortion=(0.05, -0.01, 0.0, 0.0)
)


def test_a_hull_is_opencvs_and_holds_what_is_between_its_points() -> None:
    rng = np.random.default_rng(2)
    for count in (3, 4, 10, 200):
        points = rng.uniform(0, 100, (count, 2)).round(2)
        hull = convex_hull(points)
        theirs = cv2.convexHull(points.astype(np.float32))[:, 0]
        assert sorted(hull.round(2).tolist()) == sorted(theirs.astype(float).round(2).tolist())
        assert hull_area(hull) == pytest.approx(cv2.contourArea(theirs), rel=1e-4)
        weights = rng.dirichlet(np.ones(count), 50)
        assert is_inside(hull, weights @ points).all()
        assert not is_inside(hull, points + 200).any()


def corners_of(lens: Lens) -> Corners:
    """A board that fills most of the image of a lens, exact."""
    x, y = np.meshgrid(np.linspace(-0.35, 0.35, 7), np.linspace(-0.25, 0.25, 6))
    board = BOARD.model_copy(update={"pitch_m": 0.1})
    pixels = lens.project(np.stack([x, y, np.full_like(x, 0.6)], axis=-1).reshape(-1, 3))
    pixels[7] = np.nan
    covariance = np.where(np.isfinite(pixels[:, 0])[:, None, None], 0.01 * np.eye(2), np.nan)
    return Corners(board, pixels, covariance)


@pytest.mark.parametrize("lens", [COLOUR, WIDE])
def test_undistorted_rows_and_columns_are_straight(lens: Lens) -> None:
    corners = corners_of(lens)
    bent = board_lines(corners, corners.pixels)
    assert len(bent) == 13 and rms_off(bent) > 0.5
    straight = board_lines(corners, pinhole_view(lens).project(lens.unproject(corners.pixels)))
    assert rms_off(straight) < 1e-6


@pytest.mark.parametrize("lens", [COLOUR, WIDE])
def test_the_undistorted_picture_shows_each_ray_where_a_pinhole_does(lens: Lens, tmp_path: Path) -> None:
    # Each pixel of the picture says along which slope it looks.
    x, y = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    rays = lens.unproject(np.stack([x, y], axis=-1).astype(np.float64))
    slopes = rays[..., :2] / np.where(rays[..., 2:] > 0, rays[..., 2:], np.nan)
    shades = np.clip(np.nan_to_num(128 + 80 * slopes, nan=0), 0, 255)
    image = np.stack([shades[..., 0], shades[..., 1], np.zeros_like(shades[..., 0])], axis=-1).astype(np.uint8)
    picture = np.concatenate([np.zeros((BAND_PX, lens.width, 3), np.uint8), image])
    write_picture(tmp_path / "a.png", picture)
    corners = corners_of(lens)
    found = Detection(corners, (Attempt("saddles", 1, "found", ""),))
    document = corner_file(
        found, corners.board, image="a.png", sha256=None, size=(lens.width, lens.height), polarity="normal"
    )
    assert straight_figure(lens, [ReportImage(document, None)]) is None
    figure = straight_figure(lens, [ReportImage(document, None, tmp_path / "a.png")])
    assert figure is not None and "undistorted" in figure.caption
    data = re.search(r"base64,([^\"]+)\"", figure.svg)
    assert data is not None
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_COLOR).astype(np.float64)
    view = pinhole_view(lens)
    assert shown.shape == (view.height, view.width, 3)
    where = np.array([[0.0, 0.0], [0.2, 0.1], [-0.2, 0.15], [0.25, -0.2], [-0.3, -0.2]])
    pixels = view.project(np.concatenate([where, np.ones((5, 1))], axis=1)).round().astype(int)
    for (slope_x, slope_y), (column, row) in zip(where, pixels, strict=True):
        np.testing.assert_allclose(shown[row, column, :2], 128 + 80 * np.array([slope_x, slope_y]), atol=5)


def test_what_no_picture_shows_is_grey(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", np.full((BAND_PX + 20, 30, 3), 255, np.uint8))
    at = np.full((4, 4, 2), np.nan)
    data = resampled(tmp_path / "a.png", (30, 20), at)
    assert data is not None
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).max() < 220
    assert resampled(tmp_path / "none.png", (30, 20), at) is None


def test_simulated_boards_have_straight_rows_too() -> None:
    truth = world(1, seed=6, names=("left",))
    pixels = exact_pixels(truth, "left")[0]
    covariance = np.where(np.isfinite(pixels[:, 0])[:, None, None], np.eye(2), np.nan)
    corners = Corners(BOARD, pixels, covariance)
    assert rms_off(board_lines(corners, pinhole_view(COLOUR).project(COLOUR.unproject(pixels)))) < 1e-6
