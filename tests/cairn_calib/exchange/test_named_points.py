"""Pins, lamps and heated dots: points with names and places of their own become documents that solve."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import COLOUR, THERMAL

from cairn_calib.board.board import Board, named_board
from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.cli.main import main
from cairn_calib.corner_search.blob_middle import BlobMiddle, blob_middle
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import load_rig
from cairn_map.errors import BadInputError

PLACES_CM = "-30 -20 31 -22 28 20 -29 24 0 -5 11 13 -14 2 20 -10 -5 20 -20 -12 5 -21 15 2"
PINS = {
    f"pin {n}": (float(x), float(y)) for n, (x, y) in enumerate(np.array(PLACES_CM.split(), float).reshape(-1, 2) / 100)
}
T_LEFT_THERMAL = transform_from_vector([0.02, -0.01, 0.01, 0.08, 0.05, 0.0])


def poses(count: int) -> list[np.ndarray]:
    """T_left_board of boards that are tilted in all directions."""
    rng = np.random.default_rng(4)
    result = []
    for n in range(count):
        lean = 0.5 * np.array([np.cos(2.4 * n), np.sin(2.4 * n)])
        far = rng.uniform(0.8, 1.6)
        at = [rng.uniform(-0.15, 0.15) * far, rng.uniform(-0.1, 0.1) * far, far]
        result.append(transform_from_vector([*lean, rng.uniform(-0.2, 0.2), *at]))
    return result


def pin_pixels(camera: Camera, T_camera_board: np.ndarray) -> np.ndarray:
    places = np.array([(x, y, 0.0) for x, y in PINS.values()])
    return camera.project(places @ T_camera_board[:3, :3].T + T_camera_board[:3, 3])


def painted(camera: Camera, pixels: np.ndarray, *, contrast: float, radius_px: float, seed: int) -> np.ndarray:
    """An image with a blob at each pixel, of 16 bits, with noise."""
    image = np.full((camera.height, camera.width), 20_000.0)
    y, x = np.mgrid[: camera.height, : camera.width]
    for u, v in pixels:
        near = (np.abs(x - u) < 30) & (np.abs(y - v) < 30)
        image[near] += contrast / (1 + np.exp((np.hypot(x[near] - u, y[near] - v) - radius_px) / 0.6))
    return (image + np.random.default_rng(seed).normal(0, 60, image.shape)).round().astype(np.uint16)


@pytest.mark.parametrize("contrast", [4000.0, -4000.0])
@pytest.mark.parametrize("radius_px", [1.5, 4.0, 7.0])
def test_a_blob_of_either_polarity_is_met_within_its_stated_sigma(contrast: float, radius_px: float) -> None:
    camera = Camera(width=80, height=70, focal_px=(60.0, 60.0), centre_px=(40.0, 35.0))
    rng, sigmas = np.random.default_rng(1), []
    for seed in range(40):
        true = np.array([40.0, 35.0]) + rng.uniform(-1, 1, 2)
        image = painted(camera, true[None], contrast=contrast, radius_px=radius_px, seed=seed).astype(np.float32)
        found = blob_middle(image, true + rng.uniform(-3, 3, 2), 10.0)
        assert isinstance(found, BlobMiddle) and found.is_bright == (contrast > 0)
        sigmas.append((found.pixel - true) / np.sqrt(np.diag(found.covariance_px2)))
    assert np.abs(sigmas).max() < 4
    assert np.sqrt(np.mean(np.square(sigmas))) < 1.5


def test_where_there_is_no_blob_the_reason_is_said() -> None:
    flat = np.random.default_rng(0).normal(1000, 5, (60, 80)).astype(np.float32)
    assert "stands out of the noise" in str(blob_middle(flat, (40, 30), 6.0))
    assert "near the image's border" in str(blob_middle(flat[:7, :7], (3, 3), 6.0))
    assert "outside the image" in str(blob_middle(flat, (400, 300), 6.0))
    half = flat.copy()
    half[:, 42:] += 1000
    assert "larger than 6 px" in str(blob_middle(half, (40, 30), 6.0))
    single = flat.copy()
    single[30, 40] += 25
    assert isinstance(blob_middle(single, (40, 30), 6.0), str), "a single bad pixel is no blob"


def test_pins_that_were_clicked_calibrate_two_cameras_of_opposite_polarity(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    (tmp_path / "pins.csv").write_text(
        "point,x_m,y_m\n" + "".join(f"{name},{x},{y}\n" for name, (x, y) in PINS.items())
    )
    cameras = {"left": (COLOUR, np.eye(4), -5000.0, 6.0), "thermal": (THERMAL, T_LEFT_THERMAL, 4000.0, 3.0)}
    for name, (camera, T_left_camera, contrast, radius_px) in cameras.items():
        (tmp_path / "shots" / name).mkdir(parents=True)
        rows = ["image,point,x,y"]
        for n, T_left_board in enumerate(poses(10)):
            pixels = pin_pixels(camera, np.linalg.inv(T_left_camera) @ T_left_board)
            image = painted(camera, pixels, contrast=contrast, radius_px=radius_px, seed=n)
            cv2.imwrite(str(tmp_path / "shots" / name / f"{name}{n:02d}.png"), image)
            for label, (x, y) in zip(PINS, pixels, strict=True):
                if 20 < x < camera.width - 20 and 20 < y < camera.height - 20:
                    click = np.array([x, y]) + rng.uniform(-2, 2, 2)
                    rows.append(f"{name}{n:02d}.png,{label},{click[0]:.0f},{click[1]:.0f}")
        (tmp_path / "shots" / name / "seen.csv").write_text("\n".join(rows) + "\n")
        seen = [str(tmp_path / "shots" / name / "seen.csv"), str(tmp_path / "corners" / name)]
        main(["convert-corners", *seen, "--points", str(tmp_path / "pins.csv"), "--blobs", "9"])
    document = read_corner_file(tmp_path / "corners" / "left" / "left03.json")
    assert document.board.pattern == "points" and document.board.named is not None
    assert [each.name for each in document.board.named] == list(PINS)
    at = [str(tmp_path / "corners" / name) for name in cameras]
    options = ["--spectrum", "left=colour,thermal=thermal", "--output", str(tmp_path / "rig.json")]
    main(["solve", *at, *options, "--report", str(tmp_path / "report.html")])
    rig = load_rig(tmp_path / "rig.json")
    assert "12 named points" in (tmp_path / "report.html").read_text()
    assert rig.calibration is not None and rig.calibration.covariance is not None
    sigmas = {
        (each.camera, each.name): sigma
        for each, sigma in zip(rig.calibration.covariance.parameters, rig.calibration.covariance.sigmas, strict=True)
    }
    for name, (camera, T_left_camera, _, _) in cameras.items():
        lens = rig[name].camera
        assert isinstance(lens, Camera)
        assert abs(lens.focal_px[0] - camera.focal_px[0]) < 4 * sigmas[name, "fx"] < 0.02 * camera.focal_px[0]
        assert abs(lens.centre_px[1] - camera.centre_px[1]) < 4 * sigmas[name, "cy"]
        np.testing.assert_allclose(rig[name].transform[:3, 3], T_left_camera[:3, 3], atol=0.005)


def test_a_board_of_points_is_checked() -> None:
    board = named_board(PINS)
    assert (board.columns, board.rows, board.count) == (12, 1, 12)
    places = board.points()
    assert places.min() == 0.0 and not board.has_turn_symmetry
    given = np.array(list(PINS.values()))
    np.testing.assert_allclose(places[:, :2] - places[0, :2], given - given[0], atol=1e-12)
    with pytest.raises(BadInputError, match="6 named points at least, got 5"):
        named_board(dict(list(PINS.items())[:5]))
    with pytest.raises(BadInputError, match="not all in one line"):
        named_board({str(n): (0.1 * n, 0.05 * n) for n in range(8)})
    with pytest.raises(ValueError, match="3 columns and rows at least"):
        Board(columns=2, rows=6, pitch_m=0.1)
    with pytest.raises(ValueError, match="named are the points of the pattern points"):
        Board(pattern="points", columns=12, rows=1, pitch_m=0.1)


@pytest.mark.parametrize(
    ("pins", "seen", "options", "named"),
    [
        ("point,x_m\n", "", [], "head line must name point, x_m, y_m; y_m is missing"),
        (
            None,
            "image,point,x,y\na.png,pin 99,1,2\n",
            [],
            "line 2: the board has no point 'pin 99'; it has pin 0, pin 1",
        ),
        (None, "image,point,x,y\na.png,pin 1,1,two\n", [], "line 2: could not convert"),
        (None, "image,point,x,y\na.png,pin 1,1,2\n", ["--square", "0.1"], "without --board and --square"),
        (None, "image,point,x,y\na.png,pin 1,1,2\n", ["--blobs", "5"], "a.png is not there"),
        (None, "image,point,x,y\na.png,pin 1,1,2\n", ["--blobs", "0"], "--blobs is 1 to 200 pixels"),
        (None, "image,point,x,y\na.png,pin 1,1,2\n", [], "add --size"),
    ],
)
def test_wrong_tables_of_points_say_what_to_do(
    pins: str | None, seen: str, options: list[str], named: str, tmp_path: Path
) -> None:
    rows = "".join(f"{name},{x},{y}\n" for name, (x, y) in PINS.items())
    (tmp_path / "pins.csv").write_text(pins or f"point,x_m,y_m\n{rows}")
    (tmp_path / "seen.csv").write_text(seen)
    files = [str(tmp_path / "seen.csv"), str(tmp_path / "out"), "--points", str(tmp_path / "pins.csv")]
    with pytest.raises(BadInputError, match=named):
        main(["convert-corners", *files, *options])
