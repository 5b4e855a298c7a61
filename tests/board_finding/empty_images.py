"""Images without a board: made ones that have corners and lattices, and parts of real ones, turned and changed."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from tests.cairn_calib.board_images import TOF, picture, pose

from cairn_calib.board import Board

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Maker = Callable[[np.random.Generator, int, int], Floats]

SIZES = ((176, 144), (176, 144), (320, 240), (480, 384))
SMALL = ((112, 84),)
"""Widths and heights; small ones take a third of the time."""
FOLDERS = ("apc_shelf_rgbd", "mm5_rgbdt", "flir_radiometric")
"""Of recordings without a chessboard."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".tiff")
SMALLEST_PX = 150
REAL_MAX = 60


def noise(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Of each pixel by itself."""
    return rng.normal(128, rng.uniform(5, 60), (height, width))


def texture(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Noise with structures of some pixels."""
    soft = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), rng.uniform(0.8, 6))
    values = 128 + 45 * soft / soft.std()
    return np.where(values > 128, 190.0, 60.0) if rng.random() < 0.3 else np.asarray(values)


def windows(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Panes in a frame, each of its own brightness, at times as many as a board has cells."""
    image = np.full((height, width), rng.uniform(20, 100))
    columns, rows = int(rng.integers(4, 14)), int(rng.integers(3, 11))
    step = min(width / columns, height / rows)
    bar = rng.uniform(0, 0.3) * step
    for row in range(rows):
        for column in range(columns):
            y, x = int(step * row + bar), int(step * column + bar)
            image[y : int(step * (row + 1)), x : int(step * (column + 1))] = rng.uniform(80, 230)
    return image


def tiles(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A chequered floor that fills the image."""
    y, x = np.mgrid[:height, :width]
    step = rng.uniform(5, min(width, height) / 13)
    return np.where((np.floor(x / step) + np.floor(y / step)) % 2 == 0, 60.0, 190.0)


def bricks(rng: np.random.Generator, width: int, height: int) -> Floats:
    """Courses of bricks, each moved by half a brick."""
    y, x = np.mgrid[:height, :width]
    tall = rng.uniform(6, height / 8)
    course, joint = np.floor(y / tall), rng.uniform(1, 0.25 * tall)
    return np.where((y % tall < joint) | ((x + tall * (course % 2)) % (2 * tall) < joint), 200.0, 110.0)


def other_board(rng: np.random.Generator, width: int, height: int) -> Floats:
    """A chessboard with a row or column more or less; of a time-of-flight camera's size."""
    columns, rows = ((9, 5), (8, 6), (10, 6), (9, 7), (7, 6))[int(rng.integers(5))]
    board = Board(columns=columns, rows=rows, pitch_m=0.04)
    return np.asarray(picture(TOF, pose(rng, TOF, board=board), rng, board=board) / 60.0)


MAKERS: tuple[Maker, ...] = (noise, texture, windows, tiles, bricks, other_board)
KINDS = (*(maker.__name__ for maker in MAKERS), "real")


def real_images() -> list[Bytes]:
    """Grey images of the data folder that show no board; none where there is no such folder."""
    folder = os.environ.get("CAIRN_TEST_DATA")
    if not folder:
        return []
    paths = [path for name in FOLDERS for path in sorted((Path(folder) / name).rglob("*")) if path.suffix in SUFFIXES]
    read = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[:: max(1, len(paths) // REAL_MAX)])
    return [np.asarray(image, np.uint8) for image in read if image is not None and min(image.shape) >= SMALLEST_PX]


def empty_image(seed: int, real: list[Bytes], *, sizes: Sequence[tuple[int, int]] = SIZES) -> tuple[str, Bytes]:
    """Kind and (H, W) image of one seed: perspective, blur and noise differ."""
    rng = np.random.default_rng([seed, 23])
    kind = KINDS[seed % len(KINDS)] if real else KINDS[seed % len(MAKERS)]
    width, height = sizes[int(rng.integers(len(sizes)))]
    if kind == "real":
        image = _changed(real[int(rng.integers(len(real)))], rng, width, height)
    else:
        image = MAKERS[KINDS.index(kind)](rng, width, height)
        if kind in ("windows", "tiles", "bricks"):
            image = _tilted(image, rng)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.2)) + rng.normal(0, rng.uniform(0.5, 8), image.shape)
    return kind, np.clip(image, 0, 255).astype(np.uint8)


def _changed(image: Bytes, rng: np.random.Generator, width: int, height: int) -> Floats:
    """A part of an image, scaled, mirrored, inverted, with other contrast."""
    share = rng.uniform(0.4, 1)
    part = (int(share * image.shape[0]), int(share * image.shape[1]))
    y, x = (int(rng.integers(0, whole - side + 1)) for whole, side in zip(image.shape, part, strict=True))
    cut = cv2.resize(image[y : y + part[0], x : x + part[1]], (width, height), interpolation=cv2.INTER_AREA)
    values = np.rot90(cut, int(rng.integers(4))).astype(np.float64)
    values = values[:, ::-1] if rng.random() < 0.5 else values
    values = 255 - values if rng.random() < 0.5 else values
    return _tilted(128 + rng.uniform(0.3, 2) * (values - 128), rng)


def _tilted(image: Floats, rng: np.random.Generator) -> Floats:
    """Seen aslant: the corners of the image move by up to a tenth of it."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = (corners + rng.uniform(-0.1, 0.1, (4, 2)) * [width, height]).astype(np.float32)
    warped = cv2.warpPerspective(
        image, cv2.getPerspectiveTransform(corners, moved), (width, height), borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(warped, np.float64)
